"""Reading the active section: one generation, pinned (docs/protocol-shm.md, section 5)."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.shm._atomics import fence
from vtslam.common.shm.active_layout import (
    APPENDED,
    CONTROL,
    DESCRIPTION,
    LEARNED_NAME,
    ActiveLayout,
    learned_name,
    moments_name,
    read_record,
)
from vtslam.common.shm.blocks import ControlPage, Kind, State, mapped, open_file
from vtslam.common.shm.errors import DamagedBlock, GenerationGone, SectionNotResident
from vtslam.common.shm.pins import Pin
from vtslam.common.shm.records import ActiveState, AttributeMoments, SectionMoments
from vtslam.common.shm.section_columns import LEARNED_COLUMNS, TRAINED


class ActiveReader:
    """A mapped active section whose generations can be pinned.

    Args:
        folder: The block.

    Raises:
        SectionNotResident: It is not there, or not any more.
        DamagedBlock: It is something else.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        control = self._open(CONTROL, writable=True)
        try:
            self._control = ControlPage.open(folder / CONTROL, control, Kind.ACTIVE)
        finally:
            os.close(control)
        self._layout = ActiveLayout(self._control.description(DESCRIPTION))
        self._appended = self._mapped(APPENDED, self._layout.appended.file_bytes)

    @property
    def generation(self) -> int:
        """Generation of the last commit; 0 before the first."""
        return self._control.state.number

    def pinned(self, generation: int | None = None, *, with_moments: bool = False) -> "PinnedActive":
        """One commit, in place.

        Args:
            generation: Which one; None for the last.
            with_moments: Optimiser state too. No pin protects it: for nobody but the writer.

        Raises:
            SectionNotResident: The block has left memory, or has no commit yet.
            GenerationGone: Not one of the newest generations that the block keeps, or not there yet.
            NoFreePin: Too many readers.
        """
        pins = self._control.pins
        pin = Pin(pins, pins.claim())
        try:
            state = self._pinned_state(pin.entry, generation)
            if state.number == 0:
                raise SectionNotResident(f"{self._folder}: nothing was committed yet")
            name = learned_name(state.buffer)
            learned = self._mapped(name, self._layout.learned.file_bytes)
            record, facts = read_record(self._folder / name, learned)
            assert record["generation"] == state.number
            return PinnedActive(pin, self._active_state(learned, record, facts, with_moments))
        except BaseException:
            pin.release()
            raise

    def copied(self) -> ActiveState:
        """The last commit without optimiser state, its learned columns copied; images and ties never change.

        Takes no pin, so that a reader that stops for good in the middle of this holds up nobody.

        Raises:
            SectionNotResident: As :meth:`pinned`.
            GenerationGone: The writer needed the buffer meanwhile; the next try may fare better.
        """
        state = self._control.state
        if state.number == 0:
            raise SectionNotResident(f"{self._folder}: nothing was committed yet")
        learned = self._mapped(learned_name(state.buffer), self._layout.learned.file_bytes)
        gone = GenerationGone(f"{self._folder}: generation {state.number} was overwritten while it was copied")
        try:
            record, facts = read_record(self._folder, learned)
            active = self._active_state(learned, record, facts, with_moments=False)
            section = replace(active.section, gaussians=active.section.gaussians.copied())
        except DamagedBlock:
            if self._is_kept(state):
                raise
            raise gone from None
        fence()  # the columns were copied before the state is looked at again
        if not self._is_kept(state):
            raise gone
        return replace(active, section=section)

    def _is_kept(self, state: State) -> bool:
        """Whether the writer has left a state's buffer alone up to now."""
        return self.generation - state.number < max(self._layout.kept, 1)

    def _pinned_state(self, entry: int, generation: int | None) -> State:
        if generation is None:
            return self._control.pin_state(entry)
        state = self._control.pin_number(entry, generation, self._layout.kept)
        if state is None:
            raise GenerationGone(
                f"{self._folder}: generation {generation} is not one of the {self._layout.kept} newest, "
                f"the last is {self.generation}"
            )
        return state

    def frame(self, index: int) -> Frame:
        """The frame in a committed row, in place."""
        layout, offset = self._layout, self._layout.image_offset(index)
        row = layout.rows(self._appended, index + 1)[index]
        return Frame(
            frame_id=int(row["frame_id"]),
            capture_time_ns=int(row["capture_time_ns"]),
            rgb=layout.images.rgb(self._appended, offset),
            depth=layout.images.depth(self._appended, offset),
            depth_scale_m=float(layout.description["depth_scale_m"]),
            camera=layout.camera,
        )

    def _active_state(
        self, learned: npt.NDArray[np.uint8], record: npt.NDArray[Any], facts: bytes, with_moments: bool
    ) -> ActiveState:
        layout = self._layout
        section = layout.section(self._appended, learned, record)
        rows = layout.rows(self._appended, int(record["num_frames"]))
        return ActiveState(
            generation=int(record["generation"]),
            section=section,
            frames=_FramesInPlace(self, len(rows)),
            trained_rows=tuple(np.flatnonzero(rows["flags"] & TRAINED).tolist()),
            neighbour_ids=tuple(int(n) for n in record["neighbour_ids"][: int(record["num_neighbours"])]),
            moments=self._moments(record) if with_moments else None,
            facts=facts,
        )

    def _moments(self, record: npt.NDArray[Any]) -> SectionMoments | None:
        number, count = int(record["moments_file"]), int(record["num_gaussians"])
        if number < 0:
            return None
        layout = self._layout.moments
        area = self._mapped(moments_name(number), layout.file_bytes)
        attributes = [
            AttributeMoments(
                m=layout.column(area, f"m_{name}", count),
                v=layout.column(area, f"v_{name}", count),
                step_count=int(steps),
            )
            for (name, _, _), steps in zip(LEARNED_COLUMNS, record["step_counts"], strict=True)
        ]
        return SectionMoments(colors=attributes[0], log_radii=attributes[1], opacity_logits=attributes[2])

    def _open(self, name: str, *, writable: bool) -> int:
        try:
            return open_file(self._folder / name, writable=writable)
        except FileNotFoundError as error:
            raise SectionNotResident(f"{self._folder}: not in the map store") from error

    def _mapped(self, name: str, length: int) -> npt.NDArray[np.uint8]:
        fd = self._open(name, writable=False)
        try:
            return mapped(fd, length, writable=False)
        finally:
            os.close(fd)


class _FramesInPlace(Sequence[Frame]):
    """The frames of the first rows; each is made when it is asked for, as most readers want the last one alone."""

    def __init__(self, reader: ActiveReader, count: int) -> None:
        self._reader, self._rows = reader, range(count)

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Frame, ...]: ...
    def __getitem__(self, index: int | slice) -> Frame | tuple[Frame, ...]:
        if isinstance(index, slice):
            return tuple(self._reader.frame(row) for row in self._rows[index])
        return self._reader.frame(self._rows[index])


class PinnedActive:
    """One generation of the active section, its arrays read-only and in place until :meth:`release`.

    Attributes:
        state: The generation.
    """

    def __init__(self, pin: Pin, state: ActiveState) -> None:
        self._pin, self.state = pin, state

    def release(self) -> None:
        """Let the writer have the buffer again; the arrays must not be used any more."""
        self._pin.release()


def learned_buffers(folder: Path) -> list[int]:
    """Buffers that an active block has files of."""
    names = (LEARNED_NAME.fullmatch(name) for name in os.listdir(folder))
    return sorted(int(name[1]) for name in names if name)

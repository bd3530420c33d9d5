"""Writing the active section: rows appended, learned columns by generation (docs/protocol-shm.md, section 5)."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common import failpoints
from vtslam.common.frame import Frame
from vtslam.common.section import SectionFrame
from vtslam.common.shm.active_layout import (
    APPENDED,
    CONTROL,
    DESCRIPTION,
    RECORD,
    RECORD_BYTES,
    ActiveLayout,
    description_of,
    learned_name,
    moments_name,
    read_record,
    write_record,
)
from vtslam.common.shm.active_reader import ActiveReader, learned_buffers
from vtslam.common.shm.blocks import CONTROL_BYTES, ControlPage, Kind, State, make_file, open_file, reserve
from vtslam.common.shm.errors import MapStoreFull, SharedMemoryError, SharedMemoryFull
from vtslam.common.shm.growing_file import Admission, GrowingFile
from vtslam.common.shm.records import MAX_FACTS_BYTES, MAX_NEIGHBOURS, ActiveSpec, ActiveState, Commit, SectionMoments
from vtslam.common.shm.section_columns import LEARNED_COLUMNS, TIE_COLUMNS, TRAINED, packed_rows

_MAX_FREE_BUFFERS = 1  # kept for the next commit; more are given back


def make_active_block(folder: Path, spec: ActiveSpec, admit: Admission) -> None:
    """Make the files of an empty active section in a new folder; raises MapStoreFull or SharedMemoryFull."""
    layout = ActiveLayout(description_of(spec)[0])
    admit(str(folder), CONTROL_BYTES + layout.table_bytes)
    folder.mkdir(mode=0o700)
    control = make_file(folder / CONTROL, CONTROL_BYTES)
    try:
        reserve(folder / CONTROL, control, 0, CONTROL_BYTES)
        ControlPage.write(
            folder / CONTROL,
            control,
            Kind.ACTIVE,
            file_bytes=CONTROL_BYTES,
            pins=spec.pins,
            description=description_of(spec),
        )
    finally:
        os.close(control)
    appended = make_file(folder / APPENDED, layout.appended.file_bytes)
    try:
        reserve(folder / APPENDED, appended, 0, layout.table_bytes)
    finally:
        os.close(appended)


class ActiveWriter:
    """The one writer of an active section; made by `MapStore.create_active` and `MapStore.adopt_active`.

    Args:
        folder: The block.
        admit: Asked before memory is reserved.
        take_over: Go on after another writer; raises WriterAlive if that one lives.
    """

    def __init__(self, folder: Path, admit: Admission, *, take_over: bool) -> None:
        self._folder, self._admit = folder, admit
        control = open_file(folder / CONTROL, writable=True)
        try:
            self._control = ControlPage.open(folder / CONTROL, control, Kind.ACTIVE)
        finally:
            os.close(control)
        self._layout = ActiveLayout(self._control.description(DESCRIPTION))
        failpoints.reach("shm.adopt.before_epoch")
        self._state = self._control.take_over() if take_over else self._control.state
        failpoints.reach("shm.adopt.after_epoch")
        self._learned: dict[int, GrowingFile] = {}
        self._moments: dict[int, GrowingFile] = {}
        self._num_frames, self._num_gaussians, self._moments_file = 0, 0, -1
        if self._state.number:
            self._take_counts()
        self._trim()
        failpoints.reach("shm.adopt.after_trim")
        self._appended = GrowingFile(folder / APPENDED, self._layout.appended, admit, rows_reserved=self._num_gaussians)
        self._images_reserved = self._num_frames
        self._beside = ThreadPoolExecutor(1)

    @property
    def section_id(self) -> int:
        """The section."""
        return int(self._layout.description["section_id"])

    @property
    def generation(self) -> int:
        """Generation of the last commit; 0 before the first."""
        return self._state.number

    @property
    def num_frames(self) -> int:
        """Frames committed."""
        return self._num_frames

    def last_frame(self) -> Frame:
        """The frame committed last, in place; there must be one."""
        return ActiveReader(self._folder).frame(self._num_frames - 1)

    def state(self) -> ActiveState | None:
        """The last commit, images and ties in place (they never change), the rest copied; None before the first."""
        if not self._state.number:
            return None
        reader = ActiveReader(self._folder)
        held = reader.pinned(with_moments=True)
        try:
            return _detached(held.state)
        finally:
            held.release()

    def commit(self, commit: Commit) -> int:
        """Make a frame's changes visible, all at once; the new generation.

        Raises:
            ValueError: The commit does not continue the last one, or is larger than the block allows.
            MapStoreFull, SharedMemoryFull: No memory; the former commit stays, and this one can be tried again.
            StaleWriter: Another process has taken over.
        """
        rows = self._checked_rows(commit)
        buffer = self._spare_buffer()
        moments_file = -1 if commit.moments is None else (0 if self._moments_file == 1 else 1)
        failpoints.reach("shm.commit.before_reserve")
        learned = self._reserved(commit, buffer, moments_file)
        failpoints.reach("shm.commit.after_reserve")
        with self._written_beside(partial(self._write_moments, commit.moments, moments_file)):
            self._append(commit, rows)
            self._write_learned(learned, commit)
        failpoints.reach("shm.commit.after_moments")
        self._write_record(learned, commit, moments_file)
        failpoints.reach("shm.commit.before_flip")
        new = State(epoch=self._state.epoch, number=self._state.number + 1, buffer=buffer)
        self._control.remember(new)
        self._control.publish(self._state, new)
        failpoints.reach("shm.commit.after_flip")
        self._state, self._moments_file = new, moments_file
        self._num_frames, self._num_gaussians = len(rows), commit.section.gaussians.count
        self._trim()
        failpoints.reach("shm.commit.after_trim")
        return new.number

    def make_ready(self) -> None:
        """Reserve what the next commit will surely take, while nobody waits for it.

        What there is no memory for is left to the commit, which is then refused.
        """
        with suppress(MapStoreFull, SharedMemoryFull):
            self._reserve_images(min(self._num_frames + 1, self._layout.max_frames))
            for file in (*self._learned.values(), *self._moments.values()):
                file.ensure_rows(self._num_gaussians)

    def drop_spares(self) -> None:
        """Give back what only a further commit would need; that one takes it anew."""
        for number in set(self._moments) - {self._moments_file}:
            self._moments.pop(number).close()
            (self._folder / moments_name(number)).unlink(missing_ok=True)
        self._trim(keep=0)

    def require_current(self) -> None:
        """Raise StaleWriter if another process has taken over."""
        self._control.publish(self._state, self._state)

    def close(self) -> None:
        """Give the descriptors back; the block stays."""
        for file in (self._appended, *self._learned.values(), *self._moments.values()):
            file.close()
        self._beside.shutdown()

    # --- taking over ------------------------------------------------------------------------------------------------

    def _take_counts(self) -> None:
        """Counts of the last commit, and its files open for writing."""
        path = self._folder / learned_name(self._state.buffer)
        fd = open_file(path, writable=True)
        try:
            record, _ = read_record(path, _head_of(fd))
        finally:
            os.close(fd)
        self._num_frames, self._num_gaussians = int(record["num_frames"]), int(record["num_gaussians"])
        self._moments_file = int(record["moments_file"])

    # --- checking ---------------------------------------------------------------------------------------------------

    def _checked_rows(self, commit: Commit) -> npt.NDArray[Any]:
        """The frame table as records, if the commit continues the last one."""
        section, layout = commit.section, self._layout
        first = self._num_frames
        if (section.section_id, section.camera) != (self.section_id, layout.camera):
            raise ValueError(f"{self._folder}: the commit is of section {section.section_id} or another camera")
        if len(section.frames) != first + len(commit.new_frames) or len(section.frames) > layout.max_frames:
            raise ValueError(
                f"{self._folder}: expected {first} frames, the new ones and at most {layout.max_frames}, "
                f"got {len(section.frames)} with {len(commit.new_frames)} new"
            )
        if not self._num_gaussians <= section.gaussians.count <= layout.max_gaussians:
            raise ValueError(
                f"{self._folder}: expected {self._num_gaussians} to {layout.max_gaussians} Gaussians, "
                f"got {section.gaussians.count}"
            )
        if len(commit.facts) > MAX_FACTS_BYTES or len(commit.neighbour_ids) > MAX_NEIGHBOURS:
            raise ValueError(
                f"{self._folder}: expected at most {MAX_FACTS_BYTES} bytes of facts and {MAX_NEIGHBOURS} neighbours, "
                f"got {len(commit.facts)} and {len(commit.neighbour_ids)}"
            )
        if commit.moments is not None and not layout.description["with_moments"]:
            raise ValueError(f"{self._folder}: made without optimiser state, got some")
        for stored, new in zip(section.frames[first:], commit.new_frames, strict=True):
            self._check_frame(stored, new.frame.frame_id, new.frame.depth, new.frame.depth_scale_m)
        table = layout.rows(self._appended.area, first)
        rows = packed_rows(
            section.frames,
            lambda row: bool(table[row]["flags"] & TRAINED) if row < first else commit.new_frames[row - first].trained,
        )
        if rows[:first].tobytes() != table.tobytes():
            raise ValueError(f"{self._folder}: rows of the frame table that were committed have changed")
        return rows

    def _check_frame(
        self, stored: SectionFrame, frame_id: int, depth: npt.NDArray[np.uint16], depth_scale_m: float
    ) -> None:
        if stored.frame_id != frame_id or depth_scale_m != self._layout.description["depth_scale_m"]:
            raise ValueError(f"{self._folder}: frame {frame_id} is not that of the frame table, {stored.frame_id}")
        if stored.view_depth is not None and not np.array_equal(stored.view_depth, depth):
            raise ValueError(f"{self._folder}: the depth kept of frame {frame_id} is not the frame's")

    # --- writing ----------------------------------------------------------------------------------------------------

    @contextmanager
    def _written_beside(self, write: Callable[[], None]) -> Iterator[None]:
        """Let a large part be written in another thread meanwhile; it has been once this ends."""
        written = self._beside.submit(write)
        try:
            yield
        finally:
            wait([written])
        written.result()

    def _spare_buffer(self) -> int:
        """A buffer that no kept generation is in and nobody has pinned."""
        taken = self._control.pinned_buffers() | self._kept_buffers()
        free = [buffer for buffer in sorted(self._learned) if buffer not in taken]
        # Pins hold at most as many buffers as there are pins, so the count has an end.
        return free[0] if free else next(buffer for buffer in range(256) if buffer not in taken)

    def _reserve_images(self, frames: int) -> None:
        """Space for the images of so many frames of the section."""
        layout = self._layout
        for row in range(self._images_reserved, frames):
            self._appended.reserve(layout.image_offset(row), layout.images.frame_bytes)
            self._images_reserved = row + 1

    def _reserved(self, commit: Commit, buffer: int, moments_file: int) -> GrowingFile:
        """Space for all that the commit writes; the buffer it writes to."""
        count, layout = commit.section.gaussians.count, self._layout
        self._reserve_images(len(commit.section.frames))
        self._appended.ensure_rows(count)
        if moments_file >= 0:
            if moments_file not in self._moments:
                path = self._folder / moments_name(moments_file)
                path.unlink(missing_ok=True)  # a former writer's
                self._moments[moments_file] = GrowingFile(path, layout.moments, self._admit)
            self._moments[moments_file].ensure_rows(count)
        if buffer not in self._learned:
            self._learned[buffer] = self._new_buffer(buffer)
        self._learned[buffer].ensure_rows(count)
        return self._learned[buffer]

    def _new_buffer(self, buffer: int) -> GrowingFile:
        path = self._folder / learned_name(buffer)
        path.unlink(missing_ok=True)  # a former writer's
        file = GrowingFile(path, self._layout.learned, self._admit)
        try:
            file.reserve(0, RECORD_BYTES)
        except BaseException:
            path.unlink()
            raise
        return file

    def _append(self, commit: Commit, rows: npt.NDArray[Any]) -> None:
        area, layout, first = self._appended.area, self._layout, self._num_frames
        layout.rows(area, len(rows))[first:] = rows[first:]
        failpoints.reach("shm.commit.after_frames")
        for row, new in enumerate(commit.new_frames, start=first):
            layout.images.write(area, layout.image_offset(row), new.frame)
        failpoints.reach("shm.commit.after_images")
        gaussians, old = commit.section.gaussians, self._num_gaussians
        for name, _, _ in TIE_COLUMNS:
            self._appended.column(name, gaussians.count)[old:] = getattr(gaussians, name)[old:]
        failpoints.reach("shm.commit.after_ties")

    def _write_moments(self, moments: SectionMoments | None, number: int) -> None:
        if moments is None:
            return
        file = self._moments[number]
        for (name, _, _), attribute in zip(LEARNED_COLUMNS, moments.in_order(), strict=True):
            file.column(f"m_{name}", attribute.m.shape[0])[:] = attribute.m
            file.column(f"v_{name}", attribute.v.shape[0])[:] = attribute.v

    def _write_learned(self, file: GrowingFile, commit: Commit) -> None:
        gaussians = commit.section.gaussians
        for name, _, _ in LEARNED_COLUMNS:
            file.column(name, gaussians.count)[:] = getattr(gaussians, name)
            if name == "colors":
                failpoints.reach("shm.commit.after_colors")
        failpoints.reach("shm.commit.after_columns")

    def _write_record(self, file: GrowingFile, commit: Commit, moments_file: int) -> None:
        section = commit.section
        record = np.zeros(1, RECORD)
        record["num_frames"], record["num_gaussians"] = len(section.frames), section.gaussians.count
        record["generation"] = self._state.number + 1
        record["T_world_section"] = section.T_world_section
        if commit.moments is not None:
            record["step_counts"] = [attribute.step_count for attribute in commit.moments.in_order()]
        record["moments_file"] = moments_file
        record["num_neighbours"] = len(commit.neighbour_ids)
        record["neighbour_ids"][0, : len(commit.neighbour_ids)] = commit.neighbour_ids
        write_record(file.area, record, commit.facts)

    def _trim(self, *, keep: int = _MAX_FREE_BUFFERS) -> None:
        """Unlink buffers that nobody needs, but for ``keep``."""
        kept = self._kept_buffers()
        others = [buffer for buffer in learned_buffers(self._folder) if buffer not in kept]
        if not others:
            return
        self._control.pins.reap()
        pinned = self._control.pinned_buffers()
        # Buffers of a former writer are not open here, and go first.
        free = sorted((b for b in others if b not in pinned), key=lambda b: (b in self._learned, -b))
        for buffer in free[: max(len(free) - keep, 0)]:
            (self._folder / learned_name(buffer)).unlink(missing_ok=True)
            if buffer in self._learned:
                self._learned.pop(buffer).close()

    def _kept_buffers(self) -> set[int]:
        return self._control.kept_buffers(self._state.number, self._layout.kept)


def _head_of(fd: int) -> npt.NDArray[np.uint8]:
    data = os.pread(fd, RECORD_BYTES, 0)
    if len(data) != RECORD_BYTES:
        raise SharedMemoryError("a buffer of learned columns is cut off")
    return np.frombuffer(data, np.uint8)


def _detached(state: ActiveState) -> ActiveState:
    """The state with learned columns and moments of its own."""
    gaussians = state.section.gaussians
    own = gaussians.with_attributes(
        colors=gaussians.colors.copy(),
        log_radii=gaussians.log_radii.copy(),
        opacity_logits=gaussians.opacity_logits.copy(),
    )
    moments = None
    if state.moments is not None:
        copies = [replace(a, m=a.m.copy(), v=a.v.copy()) for a in state.moments.in_order()]
        moments = SectionMoments(colors=copies[0], log_radii=copies[1], opacity_logits=copies[2])
    return replace(state, section=replace(state.section, gaussians=own), moments=moments)

"""The map store against a plain model in memory, over random sequences of operations."""

from pathlib import Path
from typing import Any

import pytest
from helpers.shm_sections import (
    MAX_FRAMES,
    SmallSection,
    sealed_section,
    section_bytes,
    shared_folder,
    spec_of,
    state_bytes,
)
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from vtslam.common.shm.active_reader import PinnedActive
from vtslam.common.shm.active_writer import ActiveWriter
from vtslam.common.shm.errors import GenerationGone, SectionNotResident, SectionPinned, StaleWriter
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.sealed_block import PinnedSealed

_KEPT = 2


class StoreModel(RuleBasedStateMachine):
    """Writer, readers and evictions of one process; every look is compared with what was put in."""

    def __init__(self) -> None:
        super().__init__()
        self._shared = shared_folder()
        folder: Path = self._shared.__enter__()
        self.store = MapStore(folder / "map", budget_bytes=1 << 26, pins=4)
        self.writer: ActiveWriter | None = None
        self.small, self.frames = SmallSection(section_id=0), 0
        self.sealed: dict[int, bytes] = {}
        self.active_pins: list[tuple[PinnedActive, bytes]] = []
        self.sealed_pins: list[tuple[PinnedSealed, int]] = []

    def teardown(self) -> None:
        self._shared.__exit__(None, None, None)

    @precondition(lambda self: self.writer is None)
    @rule(rows=st.sampled_from([0, 1, 50, 3000]), with_moments=st.booleans())
    def begin(self, rows: int, with_moments: bool) -> None:
        self.small = SmallSection(section_id=self.small.section_id + 1, rows=rows, with_moments=with_moments)
        spec = spec_of(self.small.section_id, with_moments=with_moments, kept_generations=_KEPT)
        self.writer, self.frames = self.store.create_active(spec), 0

    @precondition(lambda self: self.writer is not None and self.frames < MAX_FRAMES)
    @rule()
    def commit(self) -> None:
        assert self.writer is not None
        assert self.writer.commit(self.small.commit(self.frames + 1)) == self.frames + 1
        self.frames += 1

    @precondition(lambda self: self.writer is not None)
    @rule()
    def make_ready(self) -> None:
        assert self.writer is not None
        self.writer.make_ready()

    @precondition(lambda self: self.writer is not None)
    @rule()
    def take_over(self) -> None:
        former, self.writer = self.writer, self.store.adopt_active()
        assert former is not None
        assert self.writer is not None
        with pytest.raises(StaleWriter):
            former.require_current()
        if self.frames < MAX_FRAMES and self.small.rows < 3000:
            with pytest.raises(StaleWriter):
                former.commit(self.small.commit(self.frames + 1))
        state = self.writer.state()
        assert (b"" if state is None else state_bytes(state)) == self._expected(self.frames)

    @precondition(lambda self: self.writer is not None and self.frames > 0)
    @rule()
    def seal(self) -> None:
        assert self.writer is not None
        section = sealed_section(self.small, self.frames)
        self.store.seal(self.writer, section, b"sealed")
        self.writer, self.sealed[section.section_id] = None, section_bytes(section)
        self.active_pins.clear()  # of a block that is gone

    @precondition(lambda self: self.writer is not None and len(self.active_pins) < 3)
    @rule(behind=st.integers(0, 3))
    def pin_generation(self, behind: int) -> None:
        wanted = self.frames - behind
        if self.frames == 0 or not (0 <= behind < _KEPT and wanted >= 1):
            with pytest.raises((GenerationGone, SectionNotResident)):
                self.store.pinned_active(self.small.section_id, wanted)
            return
        held = self.store.pinned_active(self.small.section_id, wanted)
        self.active_pins.append((held, self._readers_view(wanted)))

    @precondition(lambda self: self.active_pins)
    @rule(data=st.data())
    def release_generation(self, data: Any) -> None:  # noqa: ANN401
        self.active_pins.pop(data.draw(st.integers(0, len(self.active_pins) - 1)))[0].release()

    @precondition(lambda self: self.sealed and len(self.sealed_pins) < 4)
    @rule(data=st.data())
    def pin_sealed(self, data: Any) -> None:  # noqa: ANN401
        section_id = data.draw(st.sampled_from(sorted(self.sealed)))
        held = self.store.pinned_sealed(section_id, verify=True)
        self.sealed_pins.append((held, section_id))
        assert section_bytes(held.section) == self.sealed[section_id]

    @precondition(lambda self: self.sealed_pins)
    @rule(data=st.data())
    def release_sealed(self, data: Any) -> None:  # noqa: ANN401
        self.sealed_pins.pop(data.draw(st.integers(0, len(self.sealed_pins) - 1)))[0].release()

    @precondition(lambda self: self.sealed)
    @rule(data=st.data())
    def evict(self, data: Any) -> None:  # noqa: ANN401
        section_id = data.draw(st.sampled_from(sorted(self.sealed)))
        if any(pinned == section_id for _, pinned in self.sealed_pins):
            with pytest.raises(SectionPinned):
                self.store.unlink_sealed(section_id, verified_on_disk=True)
        else:
            self.store.unlink_sealed(section_id, verified_on_disk=True)
            del self.sealed[section_id]

    @invariant()
    def what_is_pinned_does_not_change(self) -> None:
        for held, expected in self.active_pins:
            assert state_bytes(held.state) == expected

    @invariant()
    def the_store_knows_what_is_there(self) -> None:
        assert self.store.sealed_ids() == sorted(self.sealed)
        assert self.store.active_id() == (None if self.writer is None else self.small.section_id)
        assert self.store.used_bytes() <= self.store.budget_bytes
        last = self.store.last_commit()
        if self.frames:
            assert last is not None
            assert last.is_sealed == (self.writer is None)
            assert last.facts == (b"sealed" if last.is_sealed else self.small.facts(self.frames))
            assert last.frame.frame_id == self.small.frame(self.frames - 1).frame_id

    def _expected(self, frames: int) -> bytes:
        return self.small.expected(frames) if frames else b""

    def _readers_view(self, frames: int) -> bytes:
        small = SmallSection(section_id=self.small.section_id, rows=self.small.rows, with_moments=False)
        return small.expected(frames)


StoreModel.TestCase.settings = settings(max_examples=60, stateful_step_count=30, deadline=None, derandomize=True)
TestMapStore = StoreModel.TestCase

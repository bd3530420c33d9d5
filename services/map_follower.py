"""The map store as a process that only reads it follows it: the last commit, and the map as of then."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.view_index import ViewFacts
from vtslam.common.section import Section
from vtslam.common.shm.active_reader import ActiveReader, PinnedActive
from vtslam.common.shm.errors import SectionNotResident
from vtslam.common.shm.map_store import MapStore
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.section_map import ReadsSections, SectionMap


class StoreArchive:
    """Sealed sections from the map store, and those that left it from where it left them.

    Args:
        store: The map store.
        elsewhere: Where sections are that are not in memory.
    """

    def __init__(self, store: MapStore, elsewhere: ReadsSections) -> None:
        self._store, self._elsewhere = store, elsewhere

    def read(self, section_id: int) -> Section:
        """A finished section: a copy, so that it may leave the store."""
        try:
            held = self._store.pinned_sealed(section_id)
        except SectionNotResident:
            return self._elsewhere.read(section_id)
        try:
            return _copied(held.section).retied()
        finally:
            held.release()

    def view_depth(self, section_id: int, section_row: int) -> npt.NDArray[np.uint16]:
        """The depth uint16 [H,W] that a finished section keeps of a frame: a copy."""
        try:
            held = self._store.pinned_sealed(section_id)
        except SectionNotResident:
            return self._elsewhere.view_depth(section_id, section_row)
        try:
            depth = held.section.frames[section_row].view_depth
            assert depth is not None
            return depth.copy()
        finally:
            held.release()

    def coarse_depth(self, frame_id: int) -> CoarseDepth | None:
        """See `ReadsSections`."""
        return self._elsewhere.coarse_depth(frame_id)

    def known_views(self, first_section_id: int, end_section_id: int) -> Iterable[ViewFacts]:
        """See `ReadsSections`."""
        return self._elsewhere.known_views(first_section_id, end_section_id)


def _copied(section: Section) -> Section:
    frames = tuple(
        replace(frame, view_depth=None if frame.view_depth is None else frame.view_depth.copy())
        for frame in section.frames
    )
    return replace(section, frames=frames, gaussians=section.gaussians.copied())


class MapFollower:
    """The map as of the last commit.

    Args:
        store: The map store.
        archive: Where sealed sections come from.
        candidate_interval: Every so many frames of a section one answers overlap questions.

    Attributes:
        map: The map; the active section's arrays are the store's own, and valid until the next :meth:`refresh`.
        facts: What else was committed; None before the first commit.
        frame: The frame committed last, in place likewise; None before the first commit.
    """

    def __init__(self, store: MapStore, archive: ReadsSections, *, candidate_interval: int) -> None:
        self._store, self._archive = store, archive
        self.map = SectionMap(archive, candidate_interval=candidate_interval)
        self.facts: CommitFacts | None = None
        self.frame: Frame | None = None
        self._reader: tuple[int, ActiveReader] | None = None
        self._held: PinnedActive | None = None
        self._seen = (-1, -1)  # section and generation; after a section was sealed, the next one and 0

    @property
    def num_frames(self) -> int:
        """Frames committed."""
        return 0 if self.facts is None else self.facts.num_frames

    def refresh(self) -> bool:
        """Go on to the last commit; whether there was a new one."""
        while True:
            try:
                return self._refresh()
            except SectionNotResident:  # sealed at this moment
                self._reader = None

    def _refresh(self) -> bool:
        section_id = self._store.active_id()
        if section_id is None:
            return self._follow_sealed()
        if self._reader is None or self._reader[0] != section_id:
            self._reader = section_id, self._store.active_reader(section_id)
        reader = self._reader[1]
        if reader.generation == 0:
            return self._follow_sealed()
        if self._seen == (section_id, reader.generation):
            return False
        held = reader.pinned()
        self._take(held)
        self._seen = section_id, held.state.generation
        return True

    def _take(self, held: PinnedActive) -> None:
        state, former = held.state, self.map.active
        if former is not None and former.section_id == state.section.section_id:
            section = state.section.continued(former)
        else:
            section = state.section.retied()
        self.map.committed(section)
        self.facts, self.frame = CommitFacts.unpacked(state.facts), state.frames[-1]
        self.release()
        self._held = held

    def _follow_sealed(self) -> bool:
        """No active section, or one without a commit: the last commit is a sealed section's."""
        sealed = self._store.sealed_ids()
        if not sealed or self._seen == (sealed[-1] + 1, 0):
            return False
        last = self._store.last_commit()
        if last is None or not last.is_sealed:
            return False
        self.map.sealed(self._archive.read(last.section_id))
        self.facts, self.frame = CommitFacts.unpacked(last.facts), last.frame
        self.release()
        self._seen = last.section_id + 1, 0
        return True

    def release(self) -> None:
        """Let go of the store."""
        if self._held is not None:
            self._held.release()
            self._held = None

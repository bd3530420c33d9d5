"""The map store as a process that only reads it follows it: the last commit, and the map as of then."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.view_index import ViewFacts
from vtslam.common.rows import GrowingRows
from vtslam.common.section import Section
from vtslam.common.section_end import poses_in
from vtslam.common.shm.active_reader import ActiveReader, PinnedActive
from vtslam.common.shm.errors import GenerationGone, SectionNotResident
from vtslam.common.shm.map_store import MapStore
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.section_map import ReadsSections, SectionMap

_LOADS = 3  # a section that was loaded may leave again before it is pinned


class StoreArchive:
    """Sealed sections from the map store, where those that left it are brought back if possible.

    Args:
        store: The map store.
        elsewhere: Where sections are that are not in memory.
        load: Has a section brought into memory; false if it has to be read elsewhere.
    """

    def __init__(
        self, store: MapStore, elsewhere: ReadsSections, *, load: Callable[[int], bool] = lambda section_id: False
    ) -> None:
        self._store, self._elsewhere, self._load = store, elsewhere, load

    def read(self, section_id: int, former: Section | None = None) -> Section:
        """A finished section: a copy, so that it may leave the store.

        Args:
            section_id: The section.
            former: As it was before it was finished, if that is known: its surface is not worked out again.
        """
        for _ in range(_LOADS):
            try:
                held = self._store.pinned_sealed(section_id)
            except SectionNotResident:
                if not self._load(section_id):
                    break
                continue
            try:
                return _copied(held.section).retied(former)
            finally:
                held.release()
        return self._elsewhere.read(section_id)

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
    """What was committed last, and the map as of that commit or of one shortly before it.

    Args:
        store: The map store.
        archive: Where sealed sections come from.
        candidate_interval: Every so many frames of a section one answers overlap questions.

    Attributes:
        map: The map; the active section's arrays are the store's own, and valid until the next :meth:`go_to`.
        facts: What was committed last, beside the map; None before the first commit.
        frame: The frame committed last, in place; None before the first commit.
        poses: ``T_section_frame`` float64 [4,4] of the active section's frames up to then.
    """

    def __init__(self, store: MapStore, archive: StoreArchive, *, candidate_interval: int) -> None:
        self._store, self._archive = store, archive
        self.map = SectionMap(archive, candidate_interval=candidate_interval)
        self.facts: CommitFacts | None = None
        self.frame: Frame | None = None
        self.poses: tuple[npt.NDArray[np.float64], ...] = ()
        self._reader: tuple[int, ActiveReader] | None = None
        self._held: PinnedActive | None = None
        self._seen = (-1, -1)  # section and generation of the last commit; of a sealed section, the next one and 0
        self._at = (-1, -1)  # section and generation of the map's active section
        self._means_m: GrowingRows[np.float32] | None = None  # positions of the active section's Gaussians

    @property
    def num_frames(self) -> int:
        """Frames committed."""
        return 0 if self.facts is None else self.facts.num_frames

    @property
    def active_id(self) -> int | None:
        """The section that was committed to last, if it is not sealed."""
        return self._seen[0] if self._seen[1] > 0 else None

    @property
    def section_id(self) -> int:
        """The section that was committed to last, or the next one if that is sealed."""
        return max(self._seen[0], 0)

    def refresh(self) -> None:
        """Go on to the last commit, and the map to it."""
        while True:
            self.look()
            if self.active_id is None or self.go_to(self.active_id, self._seen[1]):
                return

    def look(self) -> None:
        """Learn of the last commit. The map stays where it is, unless a section was sealed: then it goes there."""
        while True:
            try:
                return self._look()
            except SectionNotResident:  # sealed at this moment
                self._reader = None

    def go_to(self, section_id: int, generation: int) -> bool:
        """Let the map be that of a commit of the active section; false if it is not there (yet, or any more).

        Which commits are still there, the section's writer decides (`ActiveSpec.kept_generations`).
        """
        if self._at == (section_id, generation):
            return True
        if self._seen[0] != section_id or self._reader is None or self._reader[1].generation < generation:
            return False
        try:
            held = self._reader[1].pinned(generation)
        except (GenerationGone, SectionNotResident):
            return False
        former, section = self.map.active, held.state.section
        if self._at[0] == section_id and self._at[1] < generation and former is not None and self._means_m is not None:
            section = section.continued(former, self._means_m)
        else:
            section = section.retied()
            self._means_m = GrowingRows(section.means_m)
        self.map.committed(section)
        self.release()
        self._held, self._at = held, (section_id, generation)
        return True

    def _look(self) -> None:
        section_id = self._store.active_id()
        if section_id is None:
            return self._look_at_sealed()
        if self._reader is None or self._reader[0] != section_id:
            self._reader = section_id, self._store.active_reader(section_id)
        reader = self._reader[1]
        if reader.generation == 0:
            return self._look_at_sealed()
        if self._seen == (section_id, reader.generation):
            return None
        held = reader.pinned()
        try:
            # Images are written once and stay where they are: no pin is needed to look at them.
            self.facts, self.frame = CommitFacts.unpacked(held.state.facts), held.state.frames[-1]
            self.poses = tuple(pose.copy() for pose in poses_in(held.state.section))
            self._seen = section_id, held.state.generation
        finally:
            held.release()
        return None

    def _look_at_sealed(self) -> None:
        """No active section, or one without a commit: the last commit is a sealed section's."""
        sealed = self._store.sealed_ids()
        if not sealed or self._seen == (sealed[-1] + 1, 0):
            return
        last = self._store.last_commit()
        if last is None or not last.is_sealed:
            return
        active = self.map.active
        former = active if active is not None and active.section_id == last.section_id else None
        self.map.sealed(self._archive.read(last.section_id, former))
        self.facts, self.frame, self.poses = CommitFacts.unpacked(last.facts), last.frame, ()
        self.release()
        self._means_m = None
        self._seen = self._at = last.section_id + 1, 0

    def release(self) -> None:
        """Let go of the store."""
        if self._held is not None:
            self._held.release()
            self._held = None

"""The map as tracker and mapper read it: the active section, the sealed ones, and the candidate views."""

from collections import OrderedDict
from collections.abc import Iterable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.view_index import ViewFacts, ViewIndex
from vtslam.common.section import Section

_RESIDENT_SECTIONS = 3  # sealed sections kept in memory: the previous one and the last that heads compared


class ReadsSections(Protocol):
    """Where sealed sections come from; what follows from a whole section need not be known otherwise."""

    def read(self, section_id: int) -> Section:
        """A finished section, byte for byte, with positions and surface."""
        ...

    def view_depth(self, section_id: int, section_row: int) -> npt.NDArray[np.uint16]:
        """The depth uint16 [H,W] that a finished section keeps of a frame."""
        depth = self.read(section_id).frames[section_row].view_depth
        assert depth is not None
        return depth

    def coarse_depth(self, frame_id: int) -> CoarseDepth | None:
        """The coarse depth of a candidate view, if that is at hand."""
        return None

    def known_views(self, first_section_id: int, end_section_id: int) -> Iterable[ViewFacts]:
        """Frames that keep their depth of the first sections of a range, as many as are known without reading them."""
        return ()


class SectionMap:
    """The active section, the sealed ones by way of an archive, and the candidate views.

    Args:
        archive: Where sealed sections come from.
        candidate_interval: Every so many frames of a section one answers overlap questions.

    Attributes:
        active: The section being mapped, as it was committed last; None between two sections.
    """

    def __init__(self, archive: ReadsSections, *, candidate_interval: int) -> None:
        self._archive, self._interval = archive, candidate_interval
        self._resident: OrderedDict[int, Section] = OrderedDict()
        self._views = ViewIndex(self)
        self._viewed = (0, 0)  # section and row that the views go on at
        self.active: Section | None = None

    def section(self, section_id: int) -> Section:
        """The active section or a sealed one, loaded if it is not at hand."""
        if self.active is not None and self.active.section_id == section_id:
            return self.active
        if section_id not in self._resident:
            self._keep(self._archive.read(section_id))
        self._resident.move_to_end(section_id)
        return self._resident[section_id]

    def candidate_views(self) -> ViewIndex:
        """All views that answer overlap questions, in order of time."""
        return self._views

    def view_depth(self, section_id: int, section_row: int) -> npt.NDArray[np.uint16]:
        """See `ReadsViewDepth`."""
        active = self.active
        at_hand = active if active and active.section_id == section_id else self._resident.get(section_id)
        if at_hand is None:
            return self._archive.view_depth(section_id, section_row)
        depth = at_hand.frames[section_row].view_depth
        assert depth is not None
        return depth

    def coarse_depth(self, section_id: int, section_row: int, frame_id: int) -> CoarseDepth | None:
        """See `ReadsViewDepth`."""
        return self._archive.coarse_depth(frame_id)

    def committed(self, section: Section) -> None:
        """Take over the active section after one or more of its frames were mapped."""
        self._catch_up(section.section_id)
        self.active = section
        self._add_views(section)

    def sealed(self, section: Section) -> None:
        """Take over a finished section; there is no active one then."""
        self._catch_up(section.section_id)
        self.active = None
        self._add_views(section)
        self._viewed = (section.section_id + 1, 0)
        self._keep(section)

    def _catch_up(self, section_id: int) -> None:
        """Views of sealed sections that were never seen here, as after a restart."""
        if self.active is not None and self.active.section_id < section_id:
            self.active = None  # finished meanwhile
        first = self._viewed[0]
        if self._viewed[1] == 0 and first < section_id:
            for view in self._archive.known_views(first, section_id):
                self._add_view(view)
                self._viewed = (view.section_id + 1, 0)
        while self._viewed[0] < section_id:
            missing = self._viewed[0]
            self._add_views(self.section(missing))
            self._viewed = (missing + 1, 0)

    def _add_views(self, section: Section) -> None:
        for row in range(self._viewed[1], len(section.frames)):
            stored = section.frames[row]
            if stored.view_depth is not None:
                view = ViewFacts(
                    section_id=section.section_id,
                    section_row=row,
                    frame_id=stored.frame_id,
                    T_world_camera=section.T_world_frame(row),
                    farthest=int(stored.view_depth.max()),
                    depth_scale_m=section.depth_scale_m,
                    camera=section.camera,
                )
                self._add_view(view)
        self._viewed = (section.section_id, len(section.frames))

    def _add_view(self, view: ViewFacts) -> None:
        if view.section_row % self._interval == 0:
            self._views.add(view)

    def _keep(self, section: Section) -> None:
        self._resident[section.section_id] = section
        while len(self._resident) > _RESIDENT_SECTIONS:
            self._resident.popitem(last=False)

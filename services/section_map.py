"""The map as tracker and mapper read it: the active section, the sealed ones, and the candidate views."""

from collections import OrderedDict
from typing import Protocol

from vtslam.common.overlap.selection import CandidateView
from vtslam.common.section import Section

_RESIDENT_SECTIONS = 3  # sealed sections kept in memory: the previous one and the last that heads compared


class ReadsSections(Protocol):
    """Where sealed sections come from."""

    def read(self, section_id: int) -> Section:
        """A finished section, byte for byte, with positions and surface."""
        ...


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
        self._views: list[CandidateView] = []
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

    def candidate_views(self) -> list[CandidateView]:
        """All views that answer overlap questions, in order of time."""
        return self._views

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
        while self._viewed[0] < section_id:
            missing = self._viewed[0]
            self._add_views(self.section(missing))
            self._viewed = (missing + 1, 0)

    def _add_views(self, section: Section) -> None:
        first = self._viewed[1]
        for row in range(first, len(section.frames)):
            stored = section.frames[row]
            if row % self._interval == 0 and stored.view_depth is not None:
                view = CandidateView(
                    section_id=section.section_id,
                    frame_id=stored.frame_id,
                    is_head=row == 0,
                    T_world_camera=section.T_world_frame(row),
                    depth=stored.view_depth.copy(),  # what it lies in may be a whole section's memory
                    depth_scale_m=section.depth_scale_m,
                    camera=section.camera,
                )
                self._views.append(view)
        self._viewed = (section.section_id, len(section.frames))

    def _keep(self, section: Section) -> None:
        self._resident[section.section_id] = section
        while len(self._resident) > _RESIDENT_SECTIONS:
            self._resident.popitem(last=False)

"""The mapper's turns in the order of the stream: which rule a frame gets, and with which neighbours."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.overlap.search import OverlapSearch
from vtslam.common.overlap.view_index import ViewIndex
from vtslam.common.section import Section
from vtslam.common.settings import Settings
from vtslam.common.splat.engine import Engine
from vtslam.services.mapper.core import Mapper
from vtslam.services.mapper.state import ActiveSection, CommitRecord


class MapReader(Protocol):
    """What mapping may ask of the map."""

    def section(self, section_id: int) -> Section:
        """A section, loaded if it is not at hand."""
        ...

    def candidate_views(self) -> ViewIndex:
        """All candidate views, in order of time."""
        ...


class MapperTurns:
    """Maps frames one after another; holds no state of the stream.

    Args:
        settings: The effective settings.
        engine: The rasteriser.
        map_reader: Sealed sections and candidate views.
    """

    def __init__(self, settings: Settings, engine: Engine, map_reader: MapReader) -> None:
        self._settings, self._map = settings, map_reader
        self._core = Mapper(
            settings=settings.mapper, section_settings=settings.section, engine=engine, seed=settings.seed
        )

    def map(
        self,
        frame: Frame,
        T_world_camera: npt.NDArray[np.float64],
        active: ActiveSection | None,
        *,
        section_id: int,
        row: int,
        in_time: Callable[[], bool] = lambda: True,
    ) -> tuple[ActiveSection, CommitRecord]:
        """Map the frame in ``row`` of ``section_id``, tracked at ``T_world_camera`` float64 [4,4].

        ``in_time`` says whether there is time for another step.
        """
        if row == 0:
            neighbours = self._head_neighbours(frame, T_world_camera, section_id)
            previous = self._map.section(section_id - 1) if section_id else None
            return self._core.map_head(
                frame,
                T_world_camera,
                section_id=section_id,
                neighbours=neighbours,
                previous=previous,
                in_time=in_time,
            )
        assert active is not None
        return self._core.map_regular(
            frame,
            T_world_camera,
            active,
            neighbours=self._neighbours(active),
            held_out=self._held_out(row),
            in_time=in_time,
        )

    def seal(self, active: ActiveSection) -> tuple[Section, int]:
        """Finish a section; the section and the renders spent."""
        return self._core.seal(active, neighbours=self._neighbours(active))

    def _held_out(self, row: int) -> bool:
        return self._settings.holdout > 0 and row % self._settings.holdout == 0

    def _neighbours(self, active: ActiveSection) -> list[Section]:
        return [self._map.section(i) for i in active.neighbour_ids]

    def _head_neighbours(self, frame: Frame, T_world_camera: npt.NDArray[np.float64], section_id: int) -> list[Section]:
        """The previous section and the one with the largest overlap (Eq. 2), without repetition."""
        if section_id == 0 or self._settings.mapper.neighbour_weight == 0:
            return []
        tracker = self._settings.tracker
        overlap = replace(tracker.overlap, depth_consistency=tracker.visibility_tolerance)
        search = OverlapSearch(self._map.candidate_views(), frame, T_world_camera, overlap)
        overlapping = search.largest_overlap(excluded_section_id=section_id - 1)
        ids = [section_id - 1] if overlapping is None else [section_id - 1, overlapping]
        return [self._map.section(i) for i in ids]

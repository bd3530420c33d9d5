"""The whole system in one process: frames in, poses and sections out. The cores are those of the fleet's processes."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.overlap.selection import CandidateView, largest_overlap, overlap_shares
from vtslam.common.section import Section
from vtslam.common.settings import Settings
from vtslam.common.splat.engine import Engine
from vtslam.services.mapper.core import Mapper
from vtslam.services.mapper.state import ActiveSection, CommitRecord
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.masks import mean_depth_m, world_points_m
from vtslam.services.tracker.state import ExternalPose, TrackerState, TrackResult

_RESIDENT_SECTIONS = 3  # sealed sections kept in memory: the previous one and the last that heads compared


class Archive(Protocol):
    """Where sealed sections go and come from."""

    def write(self, section: Section) -> None:
        """Keep a sealed section durably."""
        ...

    def read(self, section_id: int) -> Section:
        """A section written before, byte for byte."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameReport:
    """What happened to one frame: tracking (None for the first frame), mapping, and the section it sealed.

    Attributes:
        frame, tracking, commit: See above.
        sealed_section_id: The section that the frame ended, or None.
        seal_renders: Renders spent on ending it.
        track_s, map_s: Seconds of tracking, and of mapping with ending the section; 0 without a clock.
    """

    frame: Frame
    tracking: TrackResult | None
    commit: CommitRecord
    sealed_section_id: int | None
    seal_renders: int
    track_s: float
    map_s: float


class SectionMap:
    """The active section, the sealed ones by way of the archive, and the candidate views."""

    def __init__(self, archive: Archive, *, candidate_interval: int) -> None:
        self._archive, self._interval = archive, candidate_interval
        self._resident: OrderedDict[int, Section] = OrderedDict()
        self._views: list[CandidateView] = []
        self.active: ActiveSection | None = None

    def section(self, section_id: int) -> Section:
        """The active section or a sealed one, loaded if it is not in memory."""
        if self.active is not None and self.active.section.section_id == section_id:
            return self.active.section
        if section_id not in self._resident:
            self._keep(self._archive.read(section_id))
        self._resident.move_to_end(section_id)
        return self._resident[section_id]

    def candidate_views(self) -> list[CandidateView]:
        """All views that answer overlap questions, in order of time."""
        return self._views

    def committed(self, active: ActiveSection) -> None:
        """Take over the active section after a frame was mapped."""
        self.active = active
        section, row = active.section, len(active.section.frames) - 1
        stored = section.frames[row]
        if row % self._interval == 0 and stored.view_depth is not None:
            self._views.append(
                CandidateView(
                    section_id=section.section_id,
                    frame_id=stored.frame_id,
                    is_head=row == 0,
                    T_world_camera=section.T_world_frame(row),
                    depth=stored.view_depth,
                    depth_scale_m=section.depth_scale_m,
                    camera=section.camera,
                )
            )

    def sealed(self, section: Section) -> None:
        """Write a finished section; only then may it leave memory."""
        self._archive.write(section)
        self.active = None
        self._keep(section)

    def _keep(self, section: Section) -> None:
        self._resident[section.section_id] = section
        while len(self._resident) > _RESIDENT_SECTIONS:
            self._resident.popitem(last=False)


class System:
    """Tracker and mapper taking turns (lockstep), one frame at a time.

    Args:
        settings: The effective settings.
        engine: The rasteriser.
        archive: Where sealed sections go and come from.
        threads: Threads of the tracker's alignment.
        clock: Seconds, for the times in `FrameReport` and for ``mapper.budget_s``; nothing else depends on it.
    """

    def __init__(
        self,
        settings: Settings,
        engine: Engine,
        archive: Archive,
        *,
        threads: int,
        clock: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.settings = settings
        self._clock = clock
        self.map = SectionMap(archive, candidate_interval=settings.section.candidate_interval)
        self._tracker = Tracker(settings=settings.tracker, engine=engine, threads=threads)
        self._mapper = Mapper(
            settings=settings.mapper, section_settings=settings.section, engine=engine, seed=settings.seed
        )
        self._state = TrackerState()
        self._frames = 0

    def process(
        self,
        frame: Frame,
        *,
        prior: ExternalPose | None = None,
        known_T_world_camera: npt.NDArray[np.float64] | None = None,
    ) -> FrameReport:
        """Track and map the next frame; seals its section if it is the last of it.

        Args:
            frame: The frame.
            prior: A pose from elsewhere that tracking weighs by its covariance.
            known_T_world_camera: float64 [4,4], its pose if that is known: it is mapped there, not tracked.
        """
        section_id, row = divmod(self._frames, self.settings.section.length)
        tracking, start_s = None, self._clock()
        if self._frames > 0 and known_T_world_camera is None:
            tracking = self._tracker.track(
                frame, self.map, self._state, section_id=section_id, is_head=row == 0, prior=prior
            )
        if known_T_world_camera is not None:
            T_world_camera = known_T_world_camera
        else:
            T_world_camera = self._first_pose(prior) if tracking is None else tracking.T_world_camera
        tracked_s = self._clock()
        active, commit = self._map(frame, T_world_camera, section_id, row, self._in_time(start_s))
        self.map.committed(active)
        self._state = self._state.after(
            frame, commit.T_world_camera, tracking, mean_depth_m(frame), exposure=commit.exposure
        )
        self._frames += 1
        sealed, renders = (section_id, self._seal()) if row == self.settings.section.length - 1 else (None, 0)
        return FrameReport(
            frame=frame,
            tracking=tracking,
            commit=commit,
            sealed_section_id=sealed,
            seal_renders=renders,
            track_s=tracked_s - start_s,
            map_s=self._clock() - tracked_s,
        )

    def finish(self) -> int:
        """Seal the section that is still open, if any; returns the renders spent."""
        return 0 if self.map.active is None else self._seal()

    @staticmethod
    def _first_pose(prior: ExternalPose | None) -> npt.NDArray[np.float64]:
        return np.eye(4) if prior is None else prior.T_world_camera

    def _map(
        self,
        frame: Frame,
        T_world_camera: npt.NDArray[np.float64],
        section_id: int,
        row: int,
        in_time: Callable[[], bool],
    ) -> tuple[ActiveSection, CommitRecord]:
        if row == 0:
            neighbours = self._head_neighbours(frame, T_world_camera, section_id)
            previous = self.map.section(section_id - 1) if section_id else None
            return self._mapper.map_head(
                frame,
                T_world_camera,
                section_id=section_id,
                neighbours=neighbours,
                previous=previous,
                in_time=in_time,
            )
        active = self.map.active
        assert active is not None
        return self._mapper.map_regular(
            frame,
            T_world_camera,
            active,
            neighbours=self._neighbours(active),
            held_out=self._held_out(row),
            in_time=in_time,
        )

    def _in_time(self, start_s: float) -> Callable[[], bool]:
        """Whether a frame begun at ``start_s`` may still take steps (``mapper.budget_s``)."""
        budget_s = self.settings.mapper.budget_s
        return lambda: budget_s == 0 or self._clock() - start_s < budget_s

    def _held_out(self, row: int) -> bool:
        return self.settings.holdout > 0 and row % self.settings.holdout == 0

    def _neighbours(self, active: ActiveSection) -> list[Section]:
        return [self.map.section(i) for i in active.neighbour_ids]

    def _head_neighbours(self, frame: Frame, T_world_camera: npt.NDArray[np.float64], section_id: int) -> list[Section]:
        """The previous section and the one with the largest overlap (Eq. 2), without repetition."""
        if section_id == 0 or self.settings.mapper.neighbour_weight == 0:
            return []
        overlap = replace(self.settings.tracker.overlap, depth_consistency=self.settings.tracker.visibility_tolerance)
        views = self.map.candidate_views()
        points = world_points_m(frame, T_world_camera, frame.depth > 0)
        shares = overlap_shares(points, views, overlap)
        overlapping = largest_overlap(shares, views, excluded_section_id=section_id - 1)
        ids = [section_id - 1] if overlapping is None else [section_id - 1, overlapping]
        return [self.map.section(i) for i in ids]

    def _seal(self) -> int:
        active = self.map.active
        assert active is not None
        section, renders = self._mapper.seal(active, neighbours=self._neighbours(active))
        self.map.sealed(section)
        return renders

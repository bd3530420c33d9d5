"""The whole system in one process: frames in, poses and sections out. The cores are those of the fleet's processes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.section import Section
from vtslam.common.section_end import SectionEnd
from vtslam.common.settings import Settings
from vtslam.common.splat.engine import Engine
from vtslam.services.mapper.state import ActiveSection, CommitRecord
from vtslam.services.mapper.turns import MapperTurns
from vtslam.services.section_map import ReadsSections, SectionMap
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.masks import mean_depth_m
from vtslam.services.tracker.state import TrackerState, TrackResult, untracked_pose


class Archive(ReadsSections, Protocol):
    """Where sealed sections go and come from."""

    def write(self, section: Section) -> None:
        """Keep a sealed section durably."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Seal:
    """The end of a section: the Gaussians it ends with, and the renders spent on ending it."""

    section_id: int
    gaussians: int
    renders: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameReport:
    """What happened to one frame: tracking (None for the first frame), mapping, and the section it sealed.

    Attributes:
        frame, tracking, commit: See above.
        sealed: The end of the section that the frame was the last of, or None.
        track_s, map_s: Seconds of tracking, and of mapping with ending the section; 0 without a clock.
    """

    frame: Frame
    tracking: TrackResult | None
    commit: CommitRecord
    sealed: Seal | None
    track_s: float
    map_s: float


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
        self._archive = archive
        self.map = SectionMap(archive, candidate_interval=settings.section.candidate_interval)
        self.active: ActiveSection | None = None
        self._tracker = Tracker(settings=settings.tracker, engine=engine, threads=threads)
        self._mapper = MapperTurns(settings, engine, self.map)
        self._state = TrackerState()
        self._frames = self._num_sections = 0  # sections: those sealed

    @property
    def state(self) -> TrackerState:
        """What the tracker carries to the next frame."""
        return self._state

    def go_on_after(self, section_id: int, *, num_frames: int, state: TrackerState) -> None:
        """Begin at the end of a sealed section, with the tracker's state there, instead of at the first frame."""
        assert self._frames == 0
        self.map.sealed(self._archive.read(section_id))
        self._frames, self._num_sections, self._state = num_frames, section_id + 1, state

    def process(
        self,
        frame: Frame,
        *,
        known_T_world_camera: npt.NDArray[np.float64] | None = None,
    ) -> FrameReport:
        """Track and map the next frame; seals its section if it is the last of it.

        Args:
            frame: The frame; a pose prior that comes with it is weighed by its covariance, unless the first frame had
                neither a prior nor a known pose: its world is then its own.
            known_T_world_camera: float64 [4,4], its pose if that is known: it is mapped there, not tracked.
        """
        section_id, row = self._num_sections, 0 if self.active is None else len(self.active.section.frames)
        tracking, start_s, budget_s = None, self._clock(), self.settings.mapper.budget_s
        prior, is_first = self._state.prior_of(frame), self._frames == 0
        if known_T_world_camera is None and self._tracker.tracks(prior, is_first=is_first):
            tracking = self._tracker.track(
                frame, self.map, self._state, section_id=section_id, is_head=row == 0, prior=prior
            )
        if known_T_world_camera is not None:
            T_world_camera = known_T_world_camera
        else:
            T_world_camera = untracked_pose(frame) if tracking is None else tracking.T_world_camera
        tracked_s = self._clock()
        self.active, commit = self._mapper.map(
            frame,
            T_world_camera,
            self.active,
            section_id=section_id,
            row=row,
            in_time=lambda: budget_s == 0 or self._clock() - start_s < budget_s,
        )
        self.map.committed(self.active.section)
        self._state = self._state.after(
            frame, commit.T_world_camera, tracking, mean_depth_m(frame), exposure=commit.exposure
        )
        if is_first and known_T_world_camera is not None:
            self._state = replace(self._state, ignores_priors=False)  # whoever knows the pose knows the world
        self._frames += 1
        is_full = SectionEnd.of(self.settings, frame.camera).is_reached(self.active.section)
        sealed = self._seal() if is_full else None
        return FrameReport(
            frame=frame,
            tracking=tracking,
            commit=commit,
            sealed=sealed,
            track_s=tracked_s - start_s,
            map_s=self._clock() - tracked_s,
        )

    def finish(self) -> Seal | None:
        """Seal the section that is still open, if any."""
        return None if self.active is None else self._seal()

    def _seal(self) -> Seal:
        assert self.active is not None
        section, renders = self._mapper.seal(self.active)
        self._archive.write(section)
        self.active = None
        self._num_sections += 1
        self.map.sealed(section)
        return Seal(section_id=section.section_id, gaussians=section.gaussians.count, renders=renders)

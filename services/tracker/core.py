"""The tracker: pose of a frame by rendering view-tied Gaussians and aligning them to it (paper, section 3.3).

Pure: no bus, clock or files. Sections come from a reader the caller passes in.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.external_pose import ExternalPose
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.optim.alignment import PosePrior
from vtslam.common.overlap.search import OverlapSearch
from vtslam.common.overlap.view_index import ViewIndex
from vtslam.common.section import Section
from vtslam.common.settings import TrackerSettings
from vtslam.common.splat.engine import Engine
from vtslam.common.tracking_facts import TrackingQuality, TrackingState
from vtslam.services.tracker.masks import mean_depth_m, near_and_valid, visible_in_section
from vtslam.services.tracker.odometry import rgbd_odometry
from vtslam.services.tracker.optimisers import PoseEstimate, PoseOptimiser, make_optimiser
from vtslam.services.tracker.state import UNKNOWN_VARIANCE, TrackerState, TrackResult

_MIN_LOSSES = 5  # frames before the usual loss is known


class MapReader(Protocol):
    """What the tracker may ask of the map."""

    def section(self, section_id: int) -> Section:
        """A section, loaded if it is not in memory."""
        ...

    def candidate_views(self) -> ViewIndex:
        """All candidate views, in order of time."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracker:
    """Settings and engine of the tracker; holds no state of the stream."""

    settings: TrackerSettings
    engine: Engine
    threads: int = 1

    def tracks(self, prior: ExternalPose | None, *, is_first: bool) -> bool:
        """Whether a frame with this prior is tracked: not the first, nor one that is to be mapped at its prior."""
        return not is_first and (self.settings.enabled or prior is None)

    def track(
        self,
        frame: Frame,
        map_reader: MapReader,
        state: TrackerState,
        *,
        section_id: int,
        is_head: bool,
        guess: npt.NDArray[np.float64] | None = None,
        prior: ExternalPose | None = None,
    ) -> TrackResult:
        """Estimate the pose of ``frame``.

        Args:
            frame: The frame.
            map_reader: Sections and candidate views.
            state: What earlier frames left.
            section_id: Section the frame belongs to; a head opens it.
            is_head: Heads are tracked against an earlier, overlapping section S^o; others against their own.
            guess: ``T_world_camera`` float64 [4,4] to start from; constant velocity if None.
            prior: A pose from elsewhere, weighed by its covariance.

        Returns:
            The pose, its covariance, what it rests on and whether to trust it. Never raises on bad sensor data: a
            frame that cannot be tracked keeps its guess and is called lost.
        """
        T_guess = state.constant_velocity_guess() if guess is None else guess
        usable, rgb = self._usable(frame, state), state.exposure.removed(frame.rgb)
        candidates = self._sections_to_try(frame, T_guess, map_reader, section_id, is_head)
        attempt = self._attempt(frame, usable, candidates, T_guess, section_id, is_head, prior, rgb)
        rescued = False
        if attempt is not None and self._far_off(attempt.estimate, state) and state.previous_frame is not None:
            odometry = rgbd_odometry(state.previous_frame, frame)
            if odometry is not None:
                again = self._attempt(
                    frame,
                    usable,
                    candidates,
                    state.committed_poses[-1] @ odometry,
                    section_id,
                    is_head,
                    prior,
                    rgb,
                )
                if again is not None and again.estimate.loss.total < attempt.estimate.loss.total:
                    attempt, rescued = again, True
        return self._result(frame, attempt, T_guess, state, is_head=is_head, rescued=rescued, prior=prior)

    def _usable(self, frame: Frame, state: TrackerState) -> npt.NDArray[np.bool_]:
        """Valid and near pixels; the frame's own mean depth counts for the far filter."""
        depths = state.with_mean_depth(mean_depth_m(frame))
        return near_and_valid(frame, far_factor=self.settings.far_factor, largest_mean_depths_m=depths)

    def _sections_to_try(
        self, frame: Frame, T_guess: npt.NDArray[np.float64], map_reader: MapReader, section_id: int, is_head: bool
    ) -> list[Section]:
        """The frame's own section; for heads the earliest overlapping ones (paper, section 3.3)."""
        if not is_head:
            own = map_reader.section(section_id)
            # A head without depth leaves its section empty: the section before it still shows the scene.
            if own.gaussians.count or section_id == 0:
                return [own]
            return [map_reader.section(section_id - 1)]
        overlap = self.settings.overlap
        only_head_of = section_id - 1 if overlap.skip_previous else None
        search = OverlapSearch(map_reader.candidate_views(), frame, T_guess, overlap, only_head_of=only_head_of)
        ids = search.sections_to_pretrack(head_section_id=section_id)
        if not ids:
            return []
        # The surfaces of all of them and of the previous section count beside S^o's own: the head then agrees with
        # where it came from and with everything it closes on, sections meet without a step, and less hangs on which
        # one is chosen.
        beside = {i: map_reader.section(i) for i in sorted({*ids, section_id - 1})}  # read once: few stay at hand
        return [_with_surfaces_of(beside[i], list(beside.values())) for i in ids]

    def _attempt(
        self,
        frame: Frame,
        usable: npt.NDArray[np.bool_],
        sections: list[Section],
        T_world_guess: npt.NDArray[np.float64],
        section_id: int,
        is_head: bool,
        prior: ExternalPose | None,
        rgb: npt.NDArray[np.float32],
    ) -> "_Attempt | None":
        """Pre-track every section, keep the one with the least loss per pixel, and track against it."""
        mask = usable.astype(np.uint8)
        tried = []
        for section in sections:
            optimiser = self._optimiser(frame, section, section_id == 0, prior, rgb)
            T_guess = se3.inverse(section.T_section_camera(T_world_guess))
            if len(sections) > 1:
                estimate = optimiser.pretrack(section, mask, T_guess)
                tried.append(_Attempt(section, optimiser, estimate, estimate.T_camera_section))
            else:
                tried.append(_Attempt(section, optimiser, None, T_guess))
        if not tried:
            return None
        chosen = self._chosen(tried)
        if is_head and self.settings.visibility:
            mask = self._with_visibility(frame, usable, chosen)
        estimate = chosen.optimiser.solve(chosen.section, mask, chosen.T_camera_section)
        first = chosen.estimate_or_none.first_loss if chosen.estimate_or_none else estimate.first_loss
        spent = estimate.renders + sum(a.estimate_or_none.renders for a in tried if a.estimate_or_none)
        estimate = PoseEstimate(
            T_camera_section=estimate.T_camera_section,
            covariance=estimate.covariance,
            first_loss=first,
            loss=estimate.loss,
            renders=spent,
        )
        return _Attempt(chosen.section, chosen.optimiser, estimate, estimate.T_camera_section)

    def _chosen(self, tried: "list[_Attempt]") -> "_Attempt":
        """The earliest section whose loss per pixel comes close to the least one: early sections have drifted less."""
        if len(tried) == 1:
            return tried[0]
        limit = self.settings.overlap.loss_tolerance * min(a.estimate.loss.total for a in tried)
        return next(a for a in tried if a.estimate.loss.total <= limit)

    def _with_visibility(
        self, frame: Frame, usable: npt.NDArray[np.bool_], chosen: "_Attempt"
    ) -> npt.NDArray[np.uint8]:
        """Usable pixels that the section's frames saw; all usable ones if that leaves too little to track with."""
        T_world_camera = chosen.section.T_world_section @ se3.inverse(chosen.T_camera_section)
        visible = usable & visible_in_section(
            frame, T_world_camera, chosen.section, tolerance=self.settings.visibility_tolerance
        )
        enough = visible.mean() > self.settings.weak_covered_share
        return np.asarray((visible if enough else usable).astype(np.uint8))

    def _optimiser(
        self,
        frame: Frame,
        section: Section,
        in_first_section: bool,
        prior: ExternalPose | None,
        rgb: npt.NDArray[np.float32],
    ) -> PoseOptimiser:
        relative = None
        if prior is not None:
            relative = PosePrior(
                T_camera_map=se3.inverse(section.T_section_camera(prior.T_world_camera)),
                information=prior.information(),
            )
        return make_optimiser(
            frame,
            rgb,
            self.engine,
            self.settings,
            in_first_section=in_first_section,
            prior=relative,
            threads=self.threads,
        )

    def _far_off(self, estimate: PoseEstimate, state: TrackerState) -> bool:
        """The 50x rule: loss at the guess far above the median of past losses (docs/method.md, 2.5)."""
        if len(state.losses) < _MIN_LOSSES:
            return False
        usual = np.median(np.array(state.losses), axis=0)
        first, factor = estimate.first_loss, self.settings.rescue_factor
        return bool(
            first.pixels == 0
            or first.color > factor * max(usual[0], 1e-6)
            or first.depth_m > factor * max(usual[1], 1e-6)
        )

    def _result(
        self,
        frame: Frame,
        attempt: "_Attempt | None",
        T_guess: npt.NDArray[np.float64],
        state: TrackerState,
        *,
        is_head: bool,
        rescued: bool,
        prior: ExternalPose | None,
    ) -> TrackResult:
        # What is left when the map says nothing: the other sensor's word, else the constant-velocity guess.
        fallback = T_guess if prior is None else prior.T_world_camera
        unknown = np.eye(6) * UNKNOWN_VARIANCE if prior is None else prior.covariance
        if attempt is None:  # nothing to track against
            quality = TrackingQuality(
                color_loss=0.0, depth_loss_m=0.0, covered_share=0.0, renders=0, section_id=-1, rescued=False
            )
            return TrackResult(
                T_world_camera=fallback,
                covariance=unknown,
                quality=quality,
                state=TrackingState.LOST,
                overlap_section_id=-1,
            )
        estimate, section = attempt.estimate, attempt.section
        share = estimate.loss.pixels / (frame.camera.width * frame.camera.height)
        verdict = self._state(estimate, share, state)
        T_world_camera = section.T_world_section @ se3.inverse(estimate.T_camera_section)
        lost = verdict is TrackingState.LOST
        return TrackResult(
            T_world_camera=fallback if lost else se3.orthonormalized(T_world_camera),
            covariance=unknown if lost else estimate.covariance,
            quality=TrackingQuality(
                color_loss=estimate.loss.color,
                depth_loss_m=estimate.loss.depth_m,
                covered_share=share,
                renders=estimate.renders,
                section_id=section.section_id,
                rescued=rescued,
            ),
            state=verdict,
            overlap_section_id=section.section_id if is_head else -1,
        )

    def _state(self, estimate: PoseEstimate, covered_share: float, state: TrackerState) -> TrackingState:
        if covered_share < self.settings.lost_covered_share:
            return TrackingState.LOST
        if len(state.losses) >= _MIN_LOSSES:
            usual = np.median(np.array(state.losses), axis=0)
            worst = max(estimate.loss.color / max(usual[0], 1e-3), estimate.loss.depth_m / max(usual[1], 1e-3))
            if worst > self.settings.lost_loss_factor:
                return TrackingState.LOST
        return TrackingState.WEAK if covered_share < self.settings.weak_covered_share else TrackingState.OK


def _with_surfaces_of(section: Section, others: list[Section]) -> Section:
    for other in others:
        section = section.with_surface_of(other)
    return section


@dataclass(frozen=True, slots=True)
class _Attempt:
    """A section, its optimiser, and what it found so far."""

    section: Section
    optimiser: PoseOptimiser
    estimate_or_none: PoseEstimate | None
    T_camera_section: npt.NDArray[np.float64]

    @property
    def estimate(self) -> PoseEstimate:
        assert self.estimate_or_none is not None
        return self.estimate_or_none

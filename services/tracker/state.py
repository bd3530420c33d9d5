"""What the tracker carries from frame to frame, and what it says of a frame."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.external_pose import ExternalPose
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.messages.mapping import MAX_LOSSES, MAX_MEAN_DEPTHS, TrackerHistory
from vtslam.common.tracking_facts import TrackingQuality, TrackingState

_HISTORY_FRAMES = MAX_LOSSES  # losses remembered: enough for a stable median, bounded on endless streams
_FAR_SAMPLES = MAX_MEAN_DEPTHS  # largest mean depths kept for the far filter (docs/method.md, 2.2)
UNKNOWN_VARIANCE = 1e6  # of a pose that nothing was measured of


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackResult:
    """Pose of one frame.

    Attributes:
        T_world_camera: float64 [4,4].
        covariance: float64 [6,6] of a left twist on ``T_camera_world`` (translation m, rotation rad).
        quality: What it rests on.
        state: Whether to trust it.
        overlap_section_id: For heads, the section S^o it was tracked against; -1 otherwise.
    """

    T_world_camera: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64]
    quality: TrackingQuality
    state: TrackingState
    overlap_section_id: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackerState:
    """All that crosses a frame boundary in the tracker; a restarted tracker needs nothing else.

    Attributes:
        committed_poses: The last two committed ``T_world_camera``, older first.
        previous_frame: The last frame, for odometry.
        losses: (colour, depth) losses of past frames, newest last, bounded.
        largest_mean_depths_m: The largest per-frame mean depths, descending, bounded.
        exposure: The last frame's; the next one is taken to have the same while it is tracked.
        ignores_priors: Whether the first frame came without a pose: the world is its own, and not that of later ones'.
    """

    committed_poses: tuple[npt.NDArray[np.float64], ...] = ()
    previous_frame: Frame | None = None
    losses: tuple[tuple[float, float], ...] = ()
    largest_mean_depths_m: tuple[float, ...] = ()
    exposure: Exposure = field(default_factory=Exposure.identity)
    ignores_priors: bool = False

    @classmethod
    def resumed(
        cls,
        committed_poses: tuple[npt.NDArray[np.float64], ...],
        previous_frame: Frame | None,
        history: TrackerHistory,
        exposure: Exposure,
    ) -> "TrackerState":
        """The state of a :meth:`history` and the last commit."""
        return cls(
            committed_poses=committed_poses,
            previous_frame=previous_frame,
            losses=tuple(zip(history.color_losses, history.depth_losses_m, strict=True)),
            largest_mean_depths_m=history.largest_mean_depths_m,
            exposure=exposure,
            ignores_priors=history.ignores_priors,
        )

    def history(self) -> TrackerHistory:
        """What is not in the last commit, as messages and files keep it."""
        return TrackerHistory(
            color_losses=tuple(float(color) for color, _ in self.losses),
            depth_losses_m=tuple(float(depth) for _, depth in self.losses),
            largest_mean_depths_m=tuple(float(depth) for depth in self.largest_mean_depths_m),
            ignores_priors=self.ignores_priors,
        )

    def prior_of(self, frame: Frame) -> ExternalPose | None:
        """The pose that comes with the next frame, if there is one and its world is the map's."""
        return None if self.ignores_priors else frame.pose_prior

    def constant_velocity_guess(self) -> npt.NDArray[np.float64]:
        """T_t = T_{t-1} T_{t-2}^-1 T_{t-1}; the last pose if there is only one, the identity if there is none."""
        if not self.committed_poses:
            return np.eye(4)
        if len(self.committed_poses) == 1:
            return self.committed_poses[-1]
        older, newer = self.committed_poses
        return se3.orthonormalized(newer @ se3.inverse(older) @ newer)

    def with_mean_depth(self, mean_depth_m: float) -> tuple[float, ...]:
        """The far filter's samples with one more."""
        return tuple(sorted((*self.largest_mean_depths_m, mean_depth_m), reverse=True)[:_FAR_SAMPLES])

    def after(
        self,
        frame: Frame,
        T_world_camera: npt.NDArray[np.float64],
        result: TrackResult | None,
        mean_depth_m: float,
        *,
        exposure: Exposure | None = None,
    ) -> "TrackerState":
        """The state once ``frame`` is committed at ``T_world_camera``."""
        losses = self.losses
        if result is not None and result.state is TrackingState.OK:
            losses = (*losses, (result.quality.color_loss, result.quality.depth_loss_m))[-_HISTORY_FRAMES:]
        return TrackerState(
            committed_poses=(*self.committed_poses, T_world_camera)[-2:],
            previous_frame=frame,
            losses=losses,
            largest_mean_depths_m=self.with_mean_depth(mean_depth_m)
            if mean_depth_m > 0
            else self.largest_mean_depths_m,
            exposure=exposure or self.exposure,
            ignores_priors=self.ignores_priors if self.committed_poses else frame.pose_prior is None,
        )


def untracked_pose(frame: Frame) -> npt.NDArray[np.float64]:
    """``T_world_camera`` float64 [4,4] of a frame that is not tracked: its prior; else the identity, for the first."""
    return np.eye(4) if frame.pose_prior is None else frame.pose_prior.T_world_camera

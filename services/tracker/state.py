"""What the tracker carries from frame to frame, and what it says of a frame."""

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.messages.mapping import MAX_LOSSES, MAX_MEAN_DEPTHS, TrackerHistory

_HISTORY_FRAMES = MAX_LOSSES  # losses remembered: enough for a stable median, bounded on endless streams
_FAR_SAMPLES = MAX_MEAN_DEPTHS  # largest mean depths kept for the far filter (docs/method.md, 2.2)
UNKNOWN_VARIANCE = 1e6  # of a pose that nothing was measured of


class TrackingState(Enum):
    """How far a pose can be trusted."""

    OK = "ok"
    WEAK = "weak"  # few usable pixels
    LOST = "lost"  # no usable pixels, or the map does not agree with the frame


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingQuality:
    """Facts about one estimated pose.

    Attributes:
        color_loss: Mean over the mask of sum_c |I - I'| at the last render.
        depth_loss_m: Mean over the mask of |D - D'| at the last render.
        covered_share: Pixels in the mask over all pixels.
        renders: Renders spent.
        section_id: The section it was tracked against; -1 if none.
        rescued: Whether RGB-D odometry replaced the guess.
    """

    color_loss: float
    depth_loss_m: float
    covered_share: float
    renders: int
    section_id: int
    rescued: bool


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
class ExternalPose:
    """A pose from another sensor: float64 [4,4] and the covariance [6,6] of a left twist on ``T_camera_world``.

    Raises:
        ValueError: The pose is not rigid, or the covariance not symmetric, finite and positive semi-definite.
    """

    T_world_camera: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        c = self.covariance
        if not se3.is_rigid(self.T_world_camera):
            raise ValueError("an external pose must be a rigid motion [4,4]")
        if c.shape != (6, 6) or not np.isfinite(c).all() or not np.allclose(c, c.T):
            raise ValueError("the covariance of an external pose must be a finite, symmetric [6,6] matrix")
        if np.linalg.eigvalsh(c).min() < -1e-9 * max(float(np.abs(c).max()), 1e-30):
            raise ValueError("the covariance of an external pose must be positive semi-definite")

    def information(self) -> npt.NDArray[np.float64]:
        """The inverse covariance [6,6]; directions said to be exact get a standard deviation of a micrometre."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray((vectors / np.maximum(values, 1e-12)) @ vectors.T)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackerState:
    """All that crosses a frame boundary in the tracker; a restarted tracker needs nothing else.

    Attributes:
        committed_poses: The last two committed ``T_world_camera``, older first.
        previous_frame: The last frame, for odometry.
        losses: (colour, depth) losses of past frames, newest last, bounded.
        largest_mean_depths_m: The largest per-frame mean depths, descending, bounded.
        exposure: The last frame's; the next one is taken to have the same while it is tracked.
    """

    committed_poses: tuple[npt.NDArray[np.float64], ...] = ()
    previous_frame: Frame | None = None
    losses: tuple[tuple[float, float], ...] = ()
    largest_mean_depths_m: tuple[float, ...] = ()
    exposure: Exposure = field(default_factory=Exposure.identity)

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
        )

    def history(self) -> TrackerHistory:
        """What is not in the last commit, as messages and files keep it."""
        return TrackerHistory(
            color_losses=tuple(float(color) for color, _ in self.losses),
            depth_losses_m=tuple(float(depth) for _, depth in self.losses),
            largest_mean_depths_m=tuple(float(depth) for depth in self.largest_mean_depths_m),
        )

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
        )

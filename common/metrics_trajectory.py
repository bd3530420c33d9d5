"""Errors of an estimated trajectory: ATE after rigid alignment, RPE over one frame (docs/metrics.md)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3

Poses = npt.NDArray[np.float64]
_SEGMENT_LENGTHS_M = tuple(range(100, 900, 100))
_SEGMENT_STEP = 10  # frames


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrajectoryErrors:
    """Errors over all frames whose true pose is known.

    Attributes:
        ate_rmse_m, ate_mean_m: Root mean square and mean of ``position_error_m``.
        rpe_trans_rmse_m, rpe_rot_rmse_deg: Root mean squares over the F-1 steps; None for a single frame.
        position_error_m: float64 [F], distance of each aligned camera position from the true one; NaN where that is
            not known.
    """

    ate_rmse_m: float
    ate_mean_m: float
    rpe_trans_rmse_m: float | None
    rpe_rot_rmse_deg: float | None
    position_error_m: npt.NDArray[np.float64]


def trajectory_errors(estimated: Poses, truth: Poses) -> TrajectoryErrors:
    """ATE and RPE of ``estimated`` against ``truth``, both ``T_world_camera`` float64 [F,4,4] of the same frames.

    True poses that are not finite are not known, and left out.

    Raises:
        ValueError: Shapes differ, are not [F,4,4] with F >= 1, an estimate is not finite, or no true pose is.
    """
    _check(estimated, truth)
    T_truth_estimate = aligning_motion(estimated[:, :3, 3], truth[:, :3, 3])
    aligned = estimated[:, :3, 3] @ T_truth_estimate[:3, :3].T + T_truth_estimate[:3, 3]
    error_m = np.linalg.norm(aligned - truth[:, :3, 3], axis=1)
    trans_m, rot_rad = _step_errors(estimated, truth)
    return TrajectoryErrors(
        ate_rmse_m=_rms(error_m),
        ate_mean_m=float(np.nanmean(error_m)),
        rpe_trans_rmse_m=_rms(trans_m) if trans_m.size else None,
        rpe_rot_rmse_deg=float(np.rad2deg(_rms(rot_rad))) if rot_rad.size else None,
        position_error_m=error_m,
    )


def segment_drift_pct(estimated: Poses, truth: Poses) -> float | None:
    """The mean drift over stretches of 100, 200, ... 800 m, in percent of their length, as KITTI defines it.

    Args:
        estimated: ``T_world_camera`` float64 [F,4,4].
        truth: The same frames' true ones. A stretch begins at every 10th.

    Returns:
        The mean over all stretches; None if the drive is shorter than 100 m.

    Raises:
        ValueError: As :func:`trajectory_errors`.
    """
    _check(estimated, truth)
    steps_m = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    driven_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    drifts_pct = []
    for first in range(0, len(truth), _SEGMENT_STEP):
        for length_m in _SEGMENT_LENGTHS_M:
            last = int(np.searchsorted(driven_m, driven_m[first] + length_m))
            if last == len(truth):
                break
            motion = se3.inverse(estimated[first]) @ estimated[last]
            error = se3.inverse(se3.inverse(truth[first]) @ truth[last]) @ motion
            drifts_pct.append(100.0 * float(np.linalg.norm(error[:3, 3])) / length_m)
    return float(np.mean(drifts_pct)) if drifts_pct else None


def aligning_motion(points: npt.NDArray[np.float64], targets: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The rigid motion ``T_target_point`` [4,4] of least squares between paired points [F,3] (Umeyama, scale 1).

    Pairs with a point that is not finite are left out. For points on a line or at one place, where the rotation is not
    unique, it is one of those of least squares.
    """
    known = np.isfinite(points).all(axis=1) & np.isfinite(targets).all(axis=1)
    points, targets = points[known], targets[known]
    center, target_center = points.mean(axis=0), targets.mean(axis=0)
    u, _, vt = np.linalg.svd((targets - target_center).T @ (points - center))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = target_center - rotation @ center
    return out


def _step_errors(estimated: Poses, truth: Poses) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Translation (m) and angle (rad) of ``inverse(true step) @ estimated step``, of the steps that are known."""
    errors = []
    known = [bool(np.isfinite(T).all()) for T in truth]
    for t in (t for t in range(len(truth) - 1) if known[t] and known[t + 1]):
        true_step = se3.inverse(truth[t]) @ truth[t + 1]
        errors.append(se3.inverse(true_step) @ se3.inverse(estimated[t]) @ estimated[t + 1])
    trans_m = np.array([np.linalg.norm(error[:3, 3]) for error in errors])
    return trans_m, np.array([se3.angle_rad(error) for error in errors])


def _rms(values: npt.NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(values * values)))


def _check(estimated: Poses, truth: Poses) -> None:
    if estimated.shape != truth.shape or truth.shape[1:] != (4, 4) or len(truth) < 1:
        raise ValueError(f"expected two trajectories [F,4,4] of one length, got {estimated.shape} and {truth.shape}")
    if not (np.isfinite(estimated).all() and np.isfinite(truth).all(axis=(1, 2)).any()):
        raise ValueError("expected finite estimated poses, and true poses of which some are finite")

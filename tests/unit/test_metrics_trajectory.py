import numpy as np
import pytest

from vtslam.common.geometry import se3
from vtslam.common.metrics_trajectory import aligning_motion, segment_drift_pct, trajectory_errors


def random_walk(num_frames: int, *, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for _ in range(num_frames - 1):
        poses.append(poses[-1] @ se3.exp(np.concatenate([rng.normal(0, 0.1, 3), rng.normal(0, 0.05, 3)])))
    return np.stack(poses)


def test_no_error_of_the_truth_itself() -> None:
    truth = random_walk(30)
    errors = trajectory_errors(truth, truth)
    assert errors.ate_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert errors.rpe_trans_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert errors.rpe_rot_rmse_deg == pytest.approx(0.0, abs=1e-6)


def test_nothing_depends_on_the_world_frame() -> None:
    truth, moved = random_walk(30), random_walk(30, seed=4)
    errors = trajectory_errors(moved, truth)
    T_other_world = se3.exp(np.array([3.0, -2.0, 5.0, 1.0, 2.0, -0.5]))
    again = trajectory_errors(T_other_world @ moved, truth)
    assert errors.ate_rmse_m > 0.01
    assert again.ate_rmse_m == pytest.approx(errors.ate_rmse_m, rel=1e-12)
    assert again.ate_mean_m == pytest.approx(errors.ate_mean_m, rel=1e-12)
    assert again.rpe_trans_rmse_m == pytest.approx(errors.rpe_trans_rmse_m, rel=1e-12)
    assert again.rpe_rot_rmse_deg == pytest.approx(errors.rpe_rot_rmse_deg, rel=1e-9)


def test_known_errors_on_a_square() -> None:
    """Four corners 1 m from the centre, two opposite ones moved outwards: alignment cannot help."""
    truth = np.tile(np.eye(4), (4, 1, 1))
    truth[:, :3, 3] = [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)]
    estimated = truth.copy()
    estimated[0, 0, 3], estimated[2, 0, 3] = 1.1, -1.1
    errors = trajectory_errors(estimated, truth)
    np.testing.assert_allclose(errors.position_error_m, [0.1, 0.0, 0.1, 0.0], atol=1e-12)
    assert errors.ate_rmse_m == pytest.approx(np.sqrt(0.005))
    assert errors.ate_mean_m == pytest.approx(0.05)
    assert errors.rpe_trans_rmse_m == pytest.approx(0.1)
    assert errors.rpe_rot_rmse_deg == pytest.approx(0.0, abs=1e-12)


def test_scale_is_not_corrected() -> None:
    truth = random_walk(20)
    estimated = truth.copy()
    estimated[:, :3, 3] *= 1.1
    centred = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    expected = 0.1 * np.sqrt(np.mean(np.sum(centred**2, axis=1)))
    assert trajectory_errors(estimated, truth).ate_rmse_m == pytest.approx(expected, rel=1e-9)


def test_relative_error_of_a_constant_drift() -> None:
    """Each step turns 2 degrees and moves 3 cm too far, in the camera's frame."""
    truth = random_walk(10)
    drift = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(2.0), 0.0]))
    drift[:3, 3] = (0.03, 0.0, 0.0)
    estimated = [truth[0]]
    for t in range(9):
        estimated.append(estimated[-1] @ se3.inverse(truth[t]) @ truth[t + 1] @ drift)
    errors = trajectory_errors(np.stack(estimated), truth)
    assert errors.rpe_trans_rmse_m == pytest.approx(0.03)
    assert errors.rpe_rot_rmse_deg == pytest.approx(2.0)


def test_mirrored_points_are_not_reflected() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert se3.is_rigid(aligning_motion(points, points * (1, 1, -1)), tolerance=1e-12)


def test_single_frame_has_no_relative_error() -> None:
    errors = trajectory_errors(random_walk(1), random_walk(1))
    assert errors.ate_rmse_m == 0.0
    assert errors.rpe_trans_rmse_m is None
    assert errors.rpe_rot_rmse_deg is None


def test_camera_that_never_moved() -> None:
    truth = random_walk(10)
    errors = trajectory_errors(np.tile(np.eye(4), (10, 1, 1)), truth)
    spread = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    np.testing.assert_allclose(errors.position_error_m, np.linalg.norm(spread, axis=1), rtol=1e-12)


def test_refuses_other_lengths_and_nan() -> None:
    truth = random_walk(4)
    with pytest.raises(ValueError, match=r"of one length, got \(3, 4, 4\) and \(4, 4, 4\)"):
        trajectory_errors(truth[:3], truth)
    with pytest.raises(ValueError, match=r"got \(0, 4, 4\)"):
        trajectory_errors(truth[:0], truth[:0])
    estimated = truth.copy()
    estimated[2, 0, 3] = np.nan
    with pytest.raises(ValueError, match="finite estimated poses"):
        trajectory_errors(estimated, truth)


def test_frames_without_a_true_pose_are_left_out() -> None:
    truth = random_walk(6)
    estimated = truth.copy()
    estimated[:, 0, 3] += [0.01, -0.01, 5.0, 0.02, -0.02, 0.01]
    partly = truth.copy()
    partly[2] = np.nan
    errors = trajectory_errors(estimated, partly)
    assert np.isnan(errors.position_error_m[2])
    assert errors.ate_rmse_m < 0.03
    assert errors.rpe_trans_rmse_m is not None
    assert errors.rpe_trans_rmse_m < 0.06
    with pytest.raises(ValueError, match="of which some are finite"):
        trajectory_errors(estimated, np.full_like(truth, np.nan))


def test_drift_over_stretches_is_a_share_of_their_length() -> None:
    truth = np.tile(np.eye(4), (301, 1, 1))
    truth[:, 2, 3] = np.arange(301)
    estimated = truth.copy()
    estimated[:, 2, 3] *= 1.02
    assert segment_drift_pct(estimated, truth) == pytest.approx(2.0)
    assert segment_drift_pct(estimated[:100], truth[:100]) is None

import json

import numpy as np
import pytest

from vtslam.common import metrics
from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.metrics_trajectory import trajectory_errors
from vtslam.common.splat.engine import Rendering

KEYS = {
    "ate_rmse_m", "ate_mean_m", "rpe_trans_rmse_m", "rpe_rot_rmse_deg", "psnr_paper_db", "psnr_valid_db",
    "psnr_full_db", "psnr_heldout_db", "psnr_next_db", "psnr_last_db", "seam_db", "ssim_paper", "ms_ssim_paper",
    "depth_l1_m", "frames", "gaussians", "sections", "seconds_per_frame", "renders_per_frame", "peak_rss_mb",
    "per_frame",
}  # fmt: skip
COSTS = metrics.RunCosts(frames=10, gaussians=1234, sections=2)


def frame(index: int = 0, *, holes: bool = False) -> Frame:
    rng = np.random.default_rng(index)
    depth = rng.integers(800, 3000, (12, 16), np.uint16)
    depth[:, :8] *= not holes
    rgb = rng.integers(0, 256, (12, 16, 3), np.uint8)
    camera = Camera(width=16, height=12, fx=15.0, fy=15.0, cx=8.0, cy=6.0)
    return Frame(frame_id=index, capture_time_ns=index, rgb=rgb, depth=depth, depth_scale_m=0.001, camera=camera)


def rendering(of: Frame, *, color_error: float = 0.1, depth_error_m: float = 0.02, alpha: float = 1.0) -> Rendering:
    return Rendering(
        rgb=of.rgb_float() + np.float32(color_error),
        depth_m=of.depth_m() + np.float32(depth_error_m),
        alpha=np.full((12, 16), alpha, np.float32),
        saved=None,
    )


def test_quality_of_a_frame() -> None:
    observed = frame(5, holes=True)
    quality = metrics.frame_quality(rendering(observed), observed, section=1)
    assert (quality.frame, quality.section) == (5, 1)
    assert quality.psnr_full_db == pytest.approx(20.0, abs=1e-4)
    assert quality.psnr_valid_db == pytest.approx(20.0, abs=1e-4)
    assert quality.psnr_paper_db == pytest.approx(20.0 + 10.0 * np.log10(2.0), abs=1e-4)
    assert quality.depth_l1_m == pytest.approx(0.02, abs=1e-6)
    assert quality.ms_ssim_paper is None
    assert quality.ssim_paper is not None
    assert 0.5 < quality.ssim_paper < 1.0


def test_every_fifth_frame_counts() -> None:
    assert list(metrics.evaluated_frames(11)) == [0, 5, 10]
    assert list(metrics.evaluated_frames(0)) == []


def test_frames_of_a_seam() -> None:
    last, following = metrics.seam_frames(range(30, 60), range(60, 90))
    assert (last, following) == (range(50, 60), range(60, 70))
    last, following = metrics.seam_frames(range(4), range(4, 7))
    assert (last, following) == (range(4), range(4, 7))


def test_seam_counts_covered_pixels() -> None:
    observed = frame()
    assert metrics.seam_psnr_db(rendering(observed), observed) == pytest.approx(20.0, abs=1e-4)
    assert metrics.seam_psnr_db(rendering(observed, alpha=0.4), observed) is None


def test_seam_of_two_sections() -> None:
    seam = metrics.seam_of(3, next_db=[20.0, None, 22.0], last_db=[30.0, 32.0])
    assert seam == metrics.Seam(section=3, next_db=21.0, last_db=31.0)
    assert metrics.seam_of(3, next_db=[None], last_db=[30.0]) is None


def test_summary_holds_the_documented_keys() -> None:
    summary = metrics.summarise(evaluated=[], heldout=[], seams=[], trajectory=None, costs=COSTS)
    assert set(summary) == KEYS
    empty = {key for key, value in summary.items() if value is None}
    assert empty == KEYS - {
        "frames", "gaussians", "sections", "seconds_per_frame", "renders_per_frame", "per_frame"
    }  # fmt: skip
    assert summary["per_frame"] == []


def test_summary_by_hand() -> None:
    truth = np.tile(np.eye(4), (10, 1, 1))
    truth[:, 0, 3] = np.arange(10)
    estimated = truth.copy()
    estimated[5, 1, 3] = 0.3
    evaluated = [
        metrics.frame_quality(rendering(frame(t), color_error=error), frame(t), section=t // 5)
        for t, error in ((0, 0.1), (5, 0.01))
    ]
    heldout = [metrics.frame_quality(rendering(frame(7), color_error=0.001), frame(7), section=1)]
    trajectory = trajectory_errors(estimated, truth)
    costs = metrics.RunCosts(
        frames=10, gaussians=5, sections=2, track_s=4.0, map_s=6.0, total_s=11.0, track_renders=120, map_renders=300,
        peak_rss_mb=512.5,
    )  # fmt: skip
    seams = [metrics.Seam(section=0, next_db=25.0, last_db=30.0), metrics.Seam(section=1, next_db=21.0, last_db=34.0)]
    summary = metrics.summarise(
        evaluated=evaluated, heldout=heldout, seams=seams, trajectory=trajectory, costs=costs
    )  # fmt: skip
    assert set(summary) == KEYS
    assert summary["psnr_full_db"] == pytest.approx(30.0, abs=1e-3)
    assert summary["psnr_heldout_db"] == pytest.approx(60.0, abs=1e-2)
    assert (summary["psnr_next_db"], summary["psnr_last_db"], summary["seam_db"]) == (23.0, 32.0, 9.0)
    assert summary["ate_rmse_m"] == trajectory.ate_rmse_m
    assert summary["rpe_trans_rmse_m"] == trajectory.rpe_trans_rmse_m
    assert summary["seconds_per_frame"] == {"track": 0.4, "map": 0.6, "total": 1.1}
    assert summary["renders_per_frame"] == {"track": 12.0, "map": 30.0}
    assert summary["peak_rss_mb"] == 512.5
    records = summary["per_frame"]
    assert isinstance(records, list)
    assert [record["frame"] for record in records] == [0, 5]
    assert records[1]["position_error_m"] == trajectory.position_error_m[5]
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary

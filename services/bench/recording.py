"""What tracking, mapping or the whole system costs on a recording, and how good the result is."""

import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.config import ConfigError
from vtslam.common.metrics_trajectory import trajectory_errors
from vtslam.services.bench.comparison import median_ms
from vtslam.services.evaluation import evaluate_run
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.run_plan import RunPlan
from vtslam.services.sensor.sources.base import Source
from vtslam.services.tracker.odometry import rgbd_odometry

_COSTS = ("frames", "gaussians", "sections", "seconds_per_frame", "renders_per_frame", "peak_rss_mb")
_QUALITY = ("psnr_paper_db", "psnr_full_db", "psnr_heldout_db", "ssim_paper", "depth_l1_m", "seam_db")


def bench_system(plan: RunPlan) -> dict[str, object]:
    """Costs and quality of a whole run."""
    values, rows = _measured(plan, known_poses=None)
    frames_per_second = round(len(rows) / sum(row["total_s"] for row in rows), 3)
    kept = ("ate_rmse_m", *_QUALITY, *_COSTS)
    return {"frames_per_second": frames_per_second, **{key: values[key] for key in kept}, **_stages(rows)}


def bench_track(plan: RunPlan) -> dict[str, object]:
    """Tracking within a whole run, beside OpenCV's RGB-D odometry on the same frames in the same process."""
    values, rows = _measured(plan, known_poses=None)
    tracked_s = [row["track_s"] for row in rows[1:]]
    track_ms = median_ms(tracked_s)
    opencv_ms, opencv_ate_m = _opencv_odometry(plan.source)
    return {
        "ate_rmse_m": values["ate_rmse_m"],
        "track_ms": track_ms,
        "track_p95_ms": round(1e3 * float(np.percentile(tracked_s, 95)), 3),
        "renders_per_frame": values["renders_per_frame"],
        "lost": sum(row["state"] == "lost" for row in rows),
        "opencv_ms": opencv_ms,
        "opencv_ate_rmse_m": opencv_ate_m,
        "times_opencv": round(track_ms / opencv_ms, 3),
    }


def bench_map(plan: RunPlan) -> dict[str, object]:
    """Mapping alone, at the recording's true poses.

    Raises:
        ConfigError: The recording has no true poses.
    """
    truth = plan.source.ground_truth()
    if truth is None or not np.isfinite(truth).all():
        raise ConfigError(f"bench map: {plan.source.uri} has no true poses to map at")
    values, rows = _measured(plan, known_poses=truth)
    kept = (*_QUALITY, *_COSTS)
    return {"map_ms": _mean_ms([row["map_s"] for row in rows]), **{key: values[key] for key in kept}}


def _measured(
    plan: RunPlan, *, known_poses: npt.NDArray[np.float64] | None
) -> tuple[dict[str, object], list[dict[str, Any]]]:
    """Metrics and facts per frame of a run into a folder that is given up afterwards."""
    with TemporaryDirectory(prefix="vtslam-bench-") as folder:
        path = Path(folder) / "run"
        plan.execute(path, known_poses=known_poses)
        run = RecordedRun(path)
        return evaluate_run(run), run.rows


def _stages(rows: list[dict[str, Any]]) -> dict[str, object]:
    """Milliseconds per frame by stage, means; what is left of the total is writing."""
    means = {stage: _mean_ms([row[f"{stage}_s"] for row in rows]) for stage in ("read", "track", "map")}
    total = _mean_ms([row["total_s"] for row in rows])
    return {"stages_ms": {**means, "other": round(total - sum(means.values()), 3), "total": total}}


def _opencv_odometry(source: Source) -> tuple[float, float | None]:
    """Milliseconds per frame of frame-to-frame odometry, and the error (m) of the path it adds up to."""
    poses, seconds = [np.eye(4)], []
    previous = source.frame(0)
    for index in range(1, len(source)):
        frame = source.frame(index)
        start_s = time.perf_counter()
        motion = rgbd_odometry(previous, frame)
        seconds.append(time.perf_counter() - start_s)
        poses.append(poses[-1] if motion is None else poses[-1] @ motion)
        previous = frame
    truth = source.ground_truth()
    ate_m = (
        None if truth is None or not np.isfinite(truth).any() else trajectory_errors(np.stack(poses), truth).ate_rmse_m
    )
    return median_ms(seconds), ate_m


def _mean_ms(seconds: list[float]) -> float:
    return round(1e3 * statistics.fmean(seconds), 3)

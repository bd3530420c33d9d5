"""What a run is judged by: the keys of ``metrics.json`` and ``report.json`` (docs/metrics.md).

Errors of poses are in ``metrics_trajectory``, of images in ``metrics_images``; here is which frames count, and how
they are put together. Rendering is the caller's. A figure that has nothing to look at is None.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from vtslam.common import metrics_images as images
from vtslam.common.frame import Frame
from vtslam.common.metrics_trajectory import TrajectoryErrors
from vtslam.common.splat.engine import Rendering

EVALUATION_INTERVAL = 5  # every 5th frame, from frame 0
_TRAJECTORY_KEYS = ("ate_rmse_m", "ate_mean_m", "rpe_trans_rmse_m", "rpe_rot_rmse_deg")
SEAM_FRAMES = 10  # on each side of a seam; fewer where a section is shorter


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameQuality:
    """Quality of one frame rendered from its own section at its estimated pose; keys as in docs/metrics.md."""

    frame: int
    section: int
    psnr_paper_db: float | None
    psnr_valid_db: float | None
    psnr_full_db: float | None
    ssim_paper: float | None
    ms_ssim_paper: float | None
    depth_l1_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Seam:
    """How section ``section`` shows both sides of its end; PSNR over covered valid pixels.

    Attributes:
        section: k.
        next_db: Mean over the first frames of section k+1, rendered from section k.
        last_db: Mean over the last frames of section k, rendered from section k.
    """

    section: int
    next_db: float
    last_db: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RunCosts:
    """Counts and sums over a whole run; None where it did not record them."""

    frames: int
    gaussians: int
    sections: int
    track_s: float | None = None
    map_s: float | None = None
    total_s: float | None = None
    track_renders: int | None = None
    map_renders: int | None = None
    peak_rss_mb: float | None = None


def evaluated_frames(num_frames: int) -> range:
    """The frames that image figures are taken from."""
    return range(0, num_frames, EVALUATION_INTERVAL)


def seam_frames(section: range, following: range) -> tuple[range, range]:
    """The frames of a seam: the last ones of a section, the first ones of the following (ranges of frame numbers)."""
    return section[-SEAM_FRAMES:], following[:SEAM_FRAMES]


def frame_quality(rendering: Rendering, frame: Frame, *, section: int) -> FrameQuality:
    """Compare a rendering with the frame it shows.

    Raises:
        ValueError: Sizes differ, or the rendering is not finite.
    """
    observed, depth_m = frame.rgb_float(), frame.depth_m()
    valid = images.valid_depth(depth_m)
    return FrameQuality(
        frame=frame.frame_id,
        section=section,
        psnr_paper_db=images.psnr_paper_db(rendering.rgb, observed, valid),
        psnr_valid_db=images.psnr_db(rendering.rgb, observed, valid),
        psnr_full_db=images.psnr_db(rendering.rgb, observed),
        ssim_paper=images.ssim_paper(rendering.rgb, observed, valid),
        ms_ssim_paper=images.ms_ssim_paper(rendering.rgb, observed, valid),
        depth_l1_m=images.depth_l1_m(rendering.depth_m, depth_m),
    )


def seam_psnr_db(rendering: Rendering, frame: Frame) -> float | None:
    """One frame's share in a `Seam`: PSNR over covered valid pixels."""
    return images.covered_psnr_db(rendering.rgb, frame.rgb_float(), rendering.alpha, frame.depth_m())


def seam_of(section: int, *, next_db: Iterable[float | None], last_db: Iterable[float | None]) -> Seam | None:
    """The seam after ``section`` from its frames' `seam_psnr_db`; None where a side has no covered valid pixel."""
    following, last = _mean(next_db), _mean(last_db)
    return None if following is None or last is None else Seam(section=section, next_db=following, last_db=last)


def summarise(
    *,
    evaluated: Sequence[FrameQuality],
    heldout: Sequence[FrameQuality],
    seams: Sequence[Seam],
    trajectory: TrajectoryErrors | None,
    costs: RunCosts,
) -> dict[str, object]:
    """The content of ``metrics.json``: plain values, exactly the keys of docs/metrics.md.

    Args:
        evaluated: Quality of the `evaluated_frames`; they make ``per_frame``, with ``position_error_m``.
        heldout: Quality of the frames that were tracked but kept out of mapping.
        seams: One for each pair of consecutive sections.
        trajectory: Errors over all frames, or None without ground truth.
        costs: What the run took.
    """
    next_db, last_db = _mean(seam.next_db for seam in seams), _mean(seam.last_db for seam in seams)
    return {
        **{key: None if trajectory is None else getattr(trajectory, key) for key in _TRAJECTORY_KEYS},
        "psnr_paper_db": _mean(quality.psnr_paper_db for quality in evaluated),
        "psnr_valid_db": _mean(quality.psnr_valid_db for quality in evaluated),
        "psnr_full_db": _mean(quality.psnr_full_db for quality in evaluated),
        "psnr_heldout_db": _mean(quality.psnr_valid_db for quality in heldout),
        "psnr_next_db": next_db,
        "psnr_last_db": last_db,
        "seam_db": None if next_db is None or last_db is None else last_db - next_db,
        "ssim_paper": _mean(quality.ssim_paper for quality in evaluated),
        "ms_ssim_paper": _mean(quality.ms_ssim_paper for quality in evaluated),
        "depth_l1_m": _mean(quality.depth_l1_m for quality in evaluated),
        "frames": costs.frames,
        "gaussians": costs.gaussians,
        "sections": costs.sections,
        "seconds_per_frame": {
            "track": _per(costs.track_s, costs.frames),
            "map": _per(costs.map_s, costs.frames),
            "total": _per(costs.total_s, costs.frames),
        },
        "renders_per_frame": {
            "track": _per(costs.track_renders, costs.frames),
            "map": _per(costs.map_renders, costs.frames),
        },
        "peak_rss_mb": costs.peak_rss_mb,
        "per_frame": [_frame_record(quality, trajectory) for quality in evaluated],
    }


def _frame_record(quality: FrameQuality, trajectory: TrajectoryErrors | None) -> dict[str, object]:
    error = np.nan if trajectory is None else float(trajectory.position_error_m[quality.frame])
    return {**asdict(quality), "position_error_m": None if np.isnan(error) else error}


def _mean(values: Iterable[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None


def _per(total: float | None, frames: int) -> float | None:
    return None if total is None or frames == 0 else total / frames

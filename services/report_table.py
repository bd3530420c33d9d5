"""The figures of a run as a table for people."""

from collections.abc import Mapping
from typing import Any

_ABSENT = "-"
# Key (a dot goes into a table), digits after the point, what it says in plain words.
_ROWS: tuple[tuple[str, int, str], ...] = (
    ("ate_rmse_m", 5, "how far the estimated path is from the true one (root mean square)"),
    ("ate_mean_m", 5, "the same, on average"),
    ("rpe_trans_rmse_m", 5, "error of one step from frame to frame"),
    ("rpe_rot_rmse_deg", 4, "error of one turn from frame to frame"),
    ("psnr_full_db", 2, "likeness of the rendered images, all pixels (higher is better)"),
    ("psnr_valid_db", 2, "... pixels with depth"),
    ("psnr_paper_db", 2, "... pixels without depth set to zero, as published figures count"),
    ("psnr_heldout_db", 2, "... frames that mapping never saw"),
    ("ssim_paper", 4, "likeness of local structure, at most 1"),
    ("ms_ssim_paper", 4, "... over five scales"),
    ("depth_l1_m", 5, "error of the rendered depth, on average"),
    ("seam_db", 2, "what is lost across the end of a section (smaller is better)"),
    ("psnr_last_db", 2, "... before it"),
    ("psnr_next_db", 2, "... after it"),
    ("frames", 0, "frames tracked"),
    ("sections", 0, "sections of the map"),
    ("gaussians", 0, "Gaussians in them"),
    ("seconds_per_frame.track", 3, "time of tracking"),
    ("seconds_per_frame.map", 3, "time of mapping"),
    ("seconds_per_frame.total", 3, "time of everything"),
    ("renders_per_frame.track", 1, "renderings spent on tracking"),
    ("renders_per_frame.map", 1, "renderings spent on mapping"),
    ("peak_rss_mb", 0, "largest memory of the run"),
)


def metrics_table(values: Mapping[str, Any]) -> str:
    """The metrics as lines of key, value and meaning; a figure that there is not reads ``-``."""
    rows = [(key, _text(_value(values, key), digits), meaning) for key, digits, meaning in _ROWS]
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    return "\n".join(f"{key:<{widths[0]}}  {value:>{widths[1]}}  {meaning}" for key, value, meaning in rows)


def _value(values: Mapping[str, Any], key: str) -> float | None:
    found: Any = values
    for part in key.split("."):
        found = found[part]
    return None if found is None else float(found)


def _text(value: float | None, digits: int) -> str:
    return _ABSENT if value is None else f"{value:.{digits}f}"

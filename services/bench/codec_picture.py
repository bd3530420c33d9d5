"""The picture of ``vtslam bench codec --curves``: quality against bytes per Gaussian."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vtslam.services.report_pictures import write_picture
from vtslam.services.report_plot import ESTIMATED_COLOR, TRUE_COLOR, Line, Panel, Points, plotted

_QUALITIES = {"psnr_heldout_db": "held-out frames", "psnr_paper_db": "training frames"}
_COLORS = {"dense": ESTIMATED_COLOR, "dense_rate": TRUE_COLOR}
_DOTS = ("dense", "dense_rate")
_SIZE_PX = (480, 380)


def write_codec_picture(path: Path, found: Mapping[str, Any]) -> None:
    """Draw what :func:`vtslam.services.bench.codec.bench_codec` found with curves; raises WriteFailed."""
    panels = [_panel(found, key, words) for key, words in _QUALITIES.items()]
    write_picture(path, plotted(panels, size=_SIZE_PX))


def _panel(found: Mapping[str, Any], key: str, words: str) -> Panel:
    lines = [Line(points=_points(found["curves"][name], key), color=color) for name, color in _COLORS.items()]
    return Panel(
        title=f"{words} (blue: dense, gray: dense_rate)",
        x_label="B/Gaussian",
        y_label="dB",
        lines=lines,
        dots=_points([found[name] for name in _DOTS], key),
        equal_axes=False,
    )


def _points(rows: list[Mapping[str, Any]], key: str) -> Points:
    return np.array(
        [[row["bytes_per_gaussian"], row[key]] for row in rows if row[key] is not None], np.float64
    ).reshape(-1, 2)

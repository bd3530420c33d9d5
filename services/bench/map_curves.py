"""How good a map is after how much mapping: schedules of steps, each with a share of them, at the true poses."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vtslam.services.bench.recording import bench_map
from vtslam.services.report_pictures import write_picture
from vtslam.services.report_plot import ESTIMATED_COLOR, TRUE_COLOR, Line, Panel, Points, plotted
from vtslam.services.run_plan import RunPlan

_STEPS = ("iterations_head", "iterations_regular", "iterations_seal")
_QUALITIES = {"psnr_paper_db": "training frames", "psnr_heldout_db": "held-out frames"}
_COLORS = (ESTIMATED_COLOR, TRUE_COLOR)
_COLOR_WORDS = ("blue", "gray")
_SIZE_PX = (480, 380)
MOST_SCHEDULES = len(_COLORS)


def bench_map_curves(
    plans: Mapping[str, RunPlan], shares: Sequence[float], on_step: Callable[[], None] = lambda: None
) -> dict[str, object]:
    """Mapping time and quality by share of the steps.

    Args:
        plans: By the name of the schedule.
        shares: Of the schedule's steps on a frame and at the end of a section, each rounded, 1 at least.
        on_step: Called after each run.

    Returns:
        For each schedule, by share, the figures of `bench_map`.
    """
    curves: dict[str, object] = {}
    for name, plan in plans.items():
        rows: dict[str, object] = {}
        for share in shares:
            rows[f"{share:g}"] = bench_map(_with_share(plan, share))
            on_step()
        curves[name] = rows
    return curves


def _with_share(plan: RunPlan, share: float) -> RunPlan:
    mapper = plan.settings.mapper
    steps = {name: max(round(share * getattr(mapper, name)), 1) for name in _STEPS if getattr(mapper, name) > 0}
    return replace(plan, settings=replace(plan.settings, mapper=replace(mapper, **steps)))


def write_map_picture(path: Path, curves: Mapping[str, Any]) -> None:
    """Draw quality over milliseconds per frame (logarithm to base 10); raises WriteFailed."""
    panels = [_panel(curves, key, words) for key, words in _QUALITIES.items()]
    write_picture(path, plotted([panel for panel in panels if panel.lines], size=_SIZE_PX))


def _panel(curves: Mapping[str, Any], key: str, words: str) -> Panel:
    points = [found for rows in curves.values() if len(found := _points(rows, key))]
    names = ", ".join(f"{color}: {name}" for color, name in zip(_COLOR_WORDS, curves, strict=False))
    return Panel(
        title=f"{words} ({names})",
        x_label="log10 ms/frame",
        y_label="dB",
        lines=[Line(points=each, color=color) for each, color in zip(points, _COLORS, strict=False)],
        dots=np.concatenate([np.zeros((0, 2)), *points]),
        equal_axes=False,
    )


def _points(rows: Mapping[str, Mapping[str, Any]], key: str) -> Points:
    found = [[np.log10(row["map_ms"]), row[key]] for row in rows.values() if row[key] is not None]
    return np.array(found, np.float64).reshape(-1, 2)

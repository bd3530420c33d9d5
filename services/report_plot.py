"""A small plotter for trajectories: panels with axes, lines and dots, drawn by OpenCV."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.services.report_pictures import Picture, beside, write

Points = npt.NDArray[np.float64]

TRUE_COLOR, ESTIMATED_COLOR, HEAD_COLOR = (170, 170, 170), (200, 90, 20), (40, 120, 240)  # blue first
_GRID, _FRAME = (230, 230, 230), (120, 120, 120)
_OVERSAMPLING = 2  # drawn larger, then averaged down
_MARGIN = {"left": 64, "right": 14, "top": 30, "bottom": 44}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """Points [K,2] to join, in the panel's units."""

    points: Points
    color: tuple[int, int, int]
    width_px: int = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panel:
    """One set of axes.

    Attributes:
        title, x_label, y_label: Words (ASCII).
        lines: Drawn in order.
        dots: Points [K,2] marked on top.
        equal_axes: One unit is as long on both axes, as maps need it.
        from_zero: The vertical axis begins at 0.
    """

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]
    dots: Points
    equal_axes: bool = True
    from_zero: bool = False


def plotted(panels: Sequence[Panel], *, size: tuple[int, int]) -> Picture:
    """Panels side by side, each of ``size`` (width, height) pixels."""
    return beside([_panel(panel, size) for panel in panels])


def trajectory_plot(
    estimated_m: Points, true_m: Points | None, errors_m: Points | None, heads: Sequence[int]
) -> Picture:
    """Top view, side view and, with ground truth, the position error of every frame.

    Args:
        estimated_m: Camera positions float64 [F,3], world frame of the run (x right, y down, z forward at frame 0).
        true_m: True positions [F,3], aligned to the estimated ones, or None; those that are NaN are left out.
        errors_m: Distances [F] between them, or None; likewise.
        heads: Frames that open a section.
    """
    panels = [
        _path("top view", ("x, m", 0, 1.0), ("z, m", 2, 1.0), estimated_m, true_m, heads),
        _path("side view", ("z, m", 2, 1.0), ("up, m", 1, -1.0), estimated_m, true_m, heads),
    ]
    if errors_m is not None:
        curve = np.stack([np.arange(len(errors_m), dtype=np.float64), 1000.0 * errors_m], axis=1)
        panels.append(
            Panel(
                title="position error (dots: heads)",
                x_label="frame",
                y_label="mm",
                lines=[Line(points=_finite(curve), color=ESTIMATED_COLOR)],
                dots=_finite(curve[list(heads)]),
                equal_axes=False,
                from_zero=True,
            )
        )
    return plotted(panels, size=(480, 380))


def _path(
    title: str,
    across: tuple[str, int, float],
    up: tuple[str, int, float],
    estimated_m: Points,
    true_m: Points | None,
    heads: Sequence[int],
) -> Panel:
    """A projection of the path; an axis is (label, coordinate, sign)."""

    def flat(points: Points) -> Points:
        return np.stack([points[:, axis] * sign for _, axis, sign in (across, up)], axis=1)

    lines = [Line(points=flat(estimated_m), color=ESTIMATED_COLOR)]
    if true_m is not None:
        lines.insert(0, Line(points=_finite(flat(true_m)), color=TRUE_COLOR, width_px=5))
    words = "" if true_m is None else " (gray: true)"
    return Panel(
        title=f"{title}{words}",
        x_label=across[0],
        y_label=up[0],
        lines=lines,
        dots=flat(estimated_m)[list(heads)],
    )


def _finite(points: Points) -> Points:
    return points[np.isfinite(points).all(axis=1)]


class _Axes:
    """Maps the panel's units to pixels of an oversampled canvas."""

    def __init__(self, panel: Panel, size: tuple[int, int]) -> None:
        width = size[0] - _MARGIN["left"] - _MARGIN["right"]
        height = size[1] - _MARGIN["top"] - _MARGIN["bottom"]
        points = np.concatenate([*(line.points for line in panel.lines), panel.dots])
        low, high = points.min(axis=0), points.max(axis=0)
        if panel.from_zero:
            low[1] = 0.0
        span = np.maximum(high - low, 1e-6) * 1.08
        if panel.equal_axes:
            span = np.array([width, height]) * max(span[0] / width, span[1] / height)
        middle = 0.5 * (low + high)
        self.low, self.high = middle - 0.5 * span, middle + 0.5 * span
        if panel.from_zero:
            self.low[1], self.high[1] = 0.0, span[1]
        self._scale = np.array([width, height]) / (self.high - self.low)
        self.origin = np.array([_MARGIN["left"], _MARGIN["top"] + height])
        self.corner = np.array([_MARGIN["left"] + width, _MARGIN["top"]])

    def pixels(self, points: Points) -> npt.NDArray[np.int32]:
        """Pixels [K,2] (column, row) of points [K,2]."""
        offset = (points - self.low) * self._scale
        at = self.origin + offset * np.array([1.0, -1.0])
        return np.asarray(np.rint(at * _OVERSAMPLING), np.int32)

    def ticks(self, axis: int) -> list[float]:
        """Round numbers along an axis, about five."""
        raw = (self.high[axis] - self.low[axis]) / 5.0
        power = 10.0 ** np.floor(np.log10(raw))
        step = next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= raw)
        first = np.ceil(self.low[axis] / step)
        return [float(step * k) for k in np.arange(first, np.floor(self.high[axis] / step) + 1)]


def _panel(panel: Panel, size: tuple[int, int]) -> Picture:
    axes = _Axes(panel, size)
    large = np.full((size[1] * _OVERSAMPLING, size[0] * _OVERSAMPLING, 3), 255, np.uint8)
    for axis in (0, 1):
        for tick in axes.ticks(axis):
            _grid_line(large, axes, axis, tick)
    corners = [tuple(int(v) * _OVERSAMPLING for v in corner) for corner in (axes.origin, axes.corner)]
    cv2.rectangle(large, corners[0], corners[1], _FRAME, 2)
    for line in panel.lines:
        pixels = axes.pixels(line.points).reshape(-1, 1, 2)
        cv2.polylines(large, [pixels], False, line.color, line.width_px * _OVERSAMPLING, cv2.LINE_AA)
    for column, row in axes.pixels(panel.dots):
        cv2.circle(large, (int(column), int(row)), 4 * _OVERSAMPLING, HEAD_COLOR, -1, cv2.LINE_AA)
    picture = np.asarray(cv2.resize(large, size, interpolation=cv2.INTER_AREA), np.uint8)
    _write_words(picture, panel, axes)
    return picture


def _grid_line(large: Picture, axes: _Axes, axis: int, tick: float) -> None:
    ends = np.stack([axes.low, axes.high])
    ends[:, axis] = tick
    start, end = (tuple(int(v) for v in point) for point in axes.pixels(ends))
    cv2.line(large, start, end, _GRID, 2)


def _write_words(picture: Picture, panel: Panel, axes: _Axes) -> None:
    write(picture, panel.title, (_MARGIN["left"], 18), scale=0.45)
    write(picture, panel.x_label, (int(axes.corner[0]) - 60, picture.shape[0] - 6))
    write(picture, panel.y_label, (4, 18))
    for axis in (0, 1):
        for tick in axes.ticks(axis):
            place = axes.low.copy()
            place[axis] = tick
            column, row = axes.pixels(place[None])[0] // _OVERSAMPLING
            at = (column - 12, row + 16) if axis == 0 else (8, row + 4)
            write(picture, f"{tick + 0.0:.4g}", (int(at[0]), int(at[1])), scale=0.36)

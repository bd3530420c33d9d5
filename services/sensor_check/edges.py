"""Do colour and depth belong together: where depth jumps, colour has edges, at the same place and the same time.

The edges of depth are laid over those of colour at every shift; summed over frames from all over a recording, only the
true shift stands out. The same with colour images from before and after tells how far apart in time they were taken.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

Gray = npt.NDArray[np.uint8]
Map = npt.NDArray[np.float64]

REACH_PX = 14  # largest shift that is tried, in reduced pixels
_DEPTH_JUMP = 1.06  # ratio of depths across an edge
_SMALLEST_CONTRAST = 4.0  # of a colour edge, beside the contrast around it
_EDGES_NEEDED = 500  # in all frames together


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """How colour lies to depth.

    Attributes:
        shift_px: Colour's place minus depth's (right, down), in reduced pixels, at the best lag.
        lag_frames: Colour of frame t + lag fits depth of frame t; None if that cannot be told.
        clear: Both kinds of edges agree well enough to tell.
        agreement_here: How well they agree as they are, against the best, 0..1.
        agreement_now: The same for the best shift, but no lag.
    """

    shift_px: tuple[float, float]
    lag_frames: float | None
    clear: bool
    agreement_here: float
    agreement_now: float


def color_edges(gray: Gray) -> npt.NDArray[np.float32]:
    """Gradient of an image [h,w] against that around it, float32 [h,w]."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    around = cv2.blur(strength, (31, 31)) + _SMALLEST_CONTRAST
    return np.asarray(np.minimum(strength / around, 4.0), np.float32)


def depth_edges(depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """1 where depth [h,w] (m) jumps between neighbours that all have it, else 0, float32 [h,w]."""
    square = np.ones((3, 3), np.uint8)
    full = cv2.erode((depth_m > 0).astype(np.uint8), square) > 0
    near, far = cv2.erode(depth_m, square), cv2.dilate(depth_m, square)
    edges = (full & (far > near * _DEPTH_JUMP)).astype(np.float32)
    border = min(REACH_PX, min(edges.shape) // 4)
    edges[:border] = edges[-border:] = 0.0
    edges[:, :border] = edges[:, -border:] = 0.0
    return edges


class EdgeEvidence:
    """Agreement of depth edges with colour edges, by shift and lag, summed over frames.

    Args:
        max_lag: Largest lag in frames.
    """

    def __init__(self, max_lag: int) -> None:
        self._lags = range(-max_lag, max_lag + 1)
        self._maps: dict[int, Map] = {lag: np.zeros((2 * REACH_PX + 1,) * 2) for lag in self._lags}
        self._count = dict.fromkeys(self._lags, 0.0)

    def add(self, grays: Sequence[Gray], depths_m: Sequence[npt.NDArray[np.float32]], middle: int) -> None:
        """Compare depth of frame ``middle`` of successive frames with colour of those around it."""
        edges = depth_edges(depths_m[middle])
        count = float(edges.sum())
        if count == 0.0:
            return
        for lag in self._lags:
            if 0 <= middle + lag < len(grays):
                self._maps[lag] += _correlation(edges, color_edges(grays[middle + lag]))
                self._count[lag] += count

    def alignment(self) -> Alignment | None:
        """What the frames so far say; None if they have too few edges."""
        if self._count[0] < _EDGES_NEEDED:
            return None
        maps = {
            lag: self._maps[lag] / self._count[lag] for lag in self._lags if self._count[lag] > 0.9 * self._count[0]
        }
        heights = {lag: float(each.max() - np.median(each)) for lag, each in maps.items()}
        best = max(heights, key=lambda lag: heights[lag])
        at_best = maps[best]
        row, column = np.unravel_index(int(np.argmax(at_best)), at_best.shape)
        spread = 1.4826 * float(np.median(np.abs(at_best - np.median(at_best))))
        here = float(at_best[REACH_PX, REACH_PX] - np.median(at_best))
        return Alignment(
            shift_px=(_vertex(at_best[row], int(column)) - REACH_PX, _vertex(at_best[:, column], int(row)) - REACH_PX),
            lag_frames=_lag(heights, best),
            clear=heights[best] > 5.0 * spread,
            agreement_here=here / heights[best],
            agreement_now=heights[0] / heights[best],
        )


def _lag(heights: dict[int, float], best: int) -> float | None:
    """The lag of most agreement, between frames; None where all lags fit alike or too few were tried."""
    if len(heights) < 3 or min(heights.values()) > 0.8 * heights[best]:
        return None
    lags = sorted(heights)
    return lags[0] + _vertex(np.array([heights[lag] for lag in lags]), best - lags[0])


def _vertex(values: npt.NDArray[np.float64], at: int) -> float:
    """Where the parabola through ``values`` [K] around their maximum at ``at`` is highest."""
    if not 0 < at < len(values) - 1:
        return float(at)
    left, middle, right = (float(value) for value in values[at - 1 : at + 2])
    bend = left - 2.0 * middle + right
    return at if bend >= 0.0 else at + 0.5 * (left - right) / bend


def _correlation(edges: npt.NDArray[np.float32], strength: npt.NDArray[np.float32]) -> Map:
    """Sums of ``strength`` under ``edges``, moved by (column, row) - REACH_PX, float64 [2R+1,2R+1]."""
    height, width = edges.shape
    size = (cv2.getOptimalDFTSize(height + REACH_PX), cv2.getOptimalDFTSize(width + REACH_PX))
    padded = np.zeros((2, *size), np.float32)
    padded[0, :height, :width], padded[1, :height, :width] = edges, strength
    product = cv2.mulSpectrums(cv2.dft(padded[1]), cv2.dft(padded[0]), 0, conjB=True)
    sums = cv2.idft(product, flags=cv2.DFT_SCALE)
    span = 2 * REACH_PX + 1
    return np.asarray(np.roll(sums, (REACH_PX, REACH_PX), (0, 1))[:span, :span], np.float64)

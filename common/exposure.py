"""Exposure and white balance of a frame against the map: one gain and offset per colour channel.

Cameras adapt both while they move, so two frames show one surface in different colours. The map keeps one gauge (that
of its first frame); a frame is compared with the map as the frame's exposure shows it: ``gain * map + offset``.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.splat.engine import Rendering

_Image = npt.NDArray[np.float32]

_MIN_ALPHA = 0.95
_DEPTH_AGREEMENT = 0.03  # of the depth: pixels where map and frame show the same surface
_SATURATED = 248  # of 255
_MIN_SHARE = 0.02  # of the frame's pixels: fewer say too little
_SAMPLES = 8_000  # pixels used; more change nothing
_ROUNDS = 6
_GAINS, _OFFSETS = (0.25, 4.0), (-0.5, 0.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exposure:
    """How a frame shows the map's colours.

    Attributes:
        gain: float32 [3].
        offset: float32 [3].
    """

    gain: npt.NDArray[np.float32]
    offset: npt.NDArray[np.float32]

    @classmethod
    def identity(cls) -> "Exposure":
        """The map's own gauge."""
        return cls(gain=np.ones(3, np.float32), offset=np.zeros(3, np.float32))

    @property
    def is_identity(self) -> bool:
        """Whether it changes nothing."""
        return bool((self.gain == 1).all() and (self.offset == 0).all())

    def applied(self, colors: _Image) -> _Image:
        """Map colours float32 [...,3] as the frame shows them."""
        return colors if self.is_identity else colors * self.gain + self.offset

    def removed(self, rgb: npt.NDArray[np.uint8]) -> _Image:
        """A frame's image uint8 [H,W,3] in the map's gauge, float32."""
        levels = np.arange(256, dtype=np.float32)[:, None] * np.float32(1.0 / 255.0)
        table = (levels - self.offset) / self.gain
        return np.asarray(cv2.LUT(rgb, table[:, None]), np.float32)

    def nearer_to_identity(self, share: float) -> "Exposure":
        """Moved towards the identity by a share, 0 to 1."""
        keep = np.float32(1.0 - share)
        return Exposure(gain=np.float32(1) + keep * (self.gain - np.float32(1)), offset=keep * self.offset)


def estimated_exposure(rendering: Rendering, frame: Frame, fallback: Exposure) -> Exposure:
    """The exposure of ``frame`` by a rendering of the map from the frame's pose.

    Least squares per channel with Cauchy weights, over pixels where both show the same surface.

    Args:
        rendering: The map in its own gauge.
        frame: The frame.
        fallback: Taken where too few pixels agree.
    """
    depth_m = frame.depth_m()
    usable = (frame.depth > 0) & (rendering.alpha > _MIN_ALPHA)
    usable &= np.abs(rendering.depth_m - depth_m) < _DEPTH_AGREEMENT * depth_m
    for channel in range(3):
        usable &= frame.rgb[..., channel] < _SATURATED
    chosen = np.flatnonzero(usable)
    if chosen.size < _MIN_SHARE * usable.size:
        return fallback
    chosen = chosen[:: max(chosen.size // _SAMPLES, 1)]
    shown = rendering.rgb.reshape(-1, 3)[chosen].astype(np.float64)
    seen = frame.rgb.reshape(-1, 3)[chosen] / 255.0
    lines = [_line_through(shown[:, channel], seen[:, channel]) for channel in range(3)]
    gain, offset = np.array(lines, np.float32).T
    return Exposure(gain=np.clip(gain, *_GAINS), offset=np.clip(offset, *_OFFSETS))


def _line_through(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Gain and offset of y over x, outliers weighed down; gain 1 where x hardly varies."""
    weights = np.ones_like(x)
    gain, offset = 1.0, 0.0
    for _ in range(_ROUNDS):
        total = weights.sum()
        mean_x, mean_y = weights @ x / total, weights @ y / total
        dx, dy = x - mean_x, y - mean_y
        weighted = weights * dx
        variance = weighted @ dx / total
        gain = float(weighted @ dy / total / variance) if variance > 1e-4 else 1.0
        offset = float(mean_y - gain * mean_x)
        error = dy - gain * dx
        scale = 1.5 * float(np.median(np.abs(error))) + 1e-6
        weights = 1.0 / (1.0 + np.square(error / scale))
    return gain, offset

"""A rendering small enough to know by hand: two Gaussians one behind the other, and one gradient."""

import math

import numpy as np

from vtslam.common.geometry.camera import Camera
from vtslam.common.splat.engine import RasterSettings, Splats
from vtslam.common.splat.native_engine import NativeEngine

_SIZE, _FOCAL_PX, _SIGMA_M, _LOGIT = 9, 10.0, 0.2, 0.3
_NEAR_M, _FAR_M = 2.0, 4.0


def largest_error() -> float:
    """Largest difference of the CPU engine from the image model's formulas (``common/splat/engine.py``)."""
    engine = NativeEngine(RasterSettings())
    centre = _SIZE / 2
    camera = Camera(width=_SIZE, height=_SIZE, fx=_FOCAL_PX, fy=_FOCAL_PX, cx=centre, cy=centre)
    splats = Splats(
        means_m=np.array([[0, 0, _FAR_M], [0, 0, _NEAR_M]], np.float32),
        colors=np.array([[0.0, 0.0, 1.0], [1.0, 0.5, 0.0]], np.float32),
        log_radii=np.full(2, math.log(_SIGMA_M), np.float32),
        opacity_logits=np.full(2, _LOGIT, np.float32),
    )
    rendering = engine.render(splats, camera, np.eye(4))
    rows, columns = np.mgrid[0:_SIZE, 0:_SIZE]
    distance2_px = (columns - _SIZE // 2) ** 2 + (rows - _SIZE // 2) ** 2
    near, far = (_alpha(distance2_px, depth, engine.settings) for depth in (_NEAR_M, _FAR_M))
    behind = far * (1.0 - near)
    d_rgb = np.ones((_SIZE, _SIZE, 3), np.float32)
    gradients = engine.backward(rendering, d_rgb=d_rgb, d_depth=np.zeros((_SIZE, _SIZE), np.float32))
    pairs = (
        (rendering.alpha, near + behind),
        (rendering.depth_m, near * _NEAR_M + behind * _FAR_M),
        (rendering.rgb, near[..., None] * splats.colors[1] + behind[..., None] * splats.colors[0]),
        (gradients.colors[:, 0] / distance2_px.size, np.array([behind.mean(), near.mean()])),
    )
    return max(float(np.abs(found - expected).max()) for found, expected in pairs)


def _alpha(distance2_px: np.ndarray, depth_m: float, settings: RasterSettings) -> np.ndarray:
    """Alpha [H,W] of a Gaussian on the optical axis, where its image is round."""
    variance_px2 = (_FOCAL_PX * _SIGMA_M / depth_m) ** 2 + settings.low_pass_px2
    alpha = np.exp(-0.5 * distance2_px / variance_px2) / (1.0 + math.exp(-_LOGIT))
    return np.where(alpha < settings.alpha_min, 0.0, alpha)

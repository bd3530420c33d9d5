"""A small scene of scattered Gaussians for the tests of the native engine."""

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.splat.engine import FloatArray, Splats


def scattered(count: int, *, width: int, height: int, seed: int = 0) -> tuple[Splats, Camera, npt.NDArray[np.float64]]:
    """Gaussians in and around the view, some behind it, and a pose that is not the identity."""
    rng = np.random.default_rng(seed)
    camera = Camera(width=width, height=height, fx=0.9 * width, fy=0.95 * width, cx=0.51 * width, cy=0.48 * height)
    z = rng.uniform(-0.3, 4.0, count)
    u, v = rng.uniform(-5.0, width + 5.0, count), rng.uniform(-5.0, height + 5.0, count)
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], -1)
    T_camera_map = se3.exp(np.array([0.3, -0.2, 0.1, 0.2, 0.1, -0.3]))
    T_map_camera = se3.inverse(T_camera_map)
    splats = Splats(
        means_m=as_floats(points @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]),
        colors=as_floats(rng.uniform(-0.5, 1.5, (count, 3))),
        log_radii=as_floats(np.log(np.abs(z) / camera.fx * rng.uniform(0.5, 4.0, count) + 1e-4)),
        opacity_logits=as_floats(rng.uniform(-3.0, 4.0, count)),
    )
    return splats, camera, T_camera_map


def image_derivatives(camera: Camera, *, seed: int = 1) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Random derivatives of a loss by colour, depth and alpha."""
    rng = np.random.default_rng(seed)
    size = (camera.height, camera.width)
    return as_floats(rng.normal(size=(*size, 3))), as_floats(rng.normal(size=size)), as_floats(rng.normal(size=size))


def as_floats(values: npt.ArrayLike) -> FloatArray:
    """C-contiguous float32."""
    return np.ascontiguousarray(values, np.float32)

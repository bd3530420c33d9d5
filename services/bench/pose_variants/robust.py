"""Residuals, their robust weights and their derivatives by a twist, in numpy."""

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.settings import GaussNewtonSettings

Array = npt.NDArray[np.float64]


def huber_weights(sigmas: Array) -> Array:
    """Weights of residuals in sigmas."""
    return np.asarray(1.0 / np.maximum(np.abs(sigmas), 1.0))


def huber_costs(sigmas: Array) -> Array:
    """Costs of residuals in sigmas."""
    size = np.abs(sigmas)
    return np.where(size <= 1.0, 0.5 * size * size, size - 0.5)


def depth_sigmas_m(depth_m: Array, settings: GaussNewtonSettings) -> Array:
    """Standard deviation (m) of depths [...] (m)."""
    return settings.depth_sigma_base_m + settings.depth_sigma_per_m * depth_m * depth_m


def twist_rows(points_m: Array, gradients: Array) -> Array:
    """Rows [K,6] of a left twist on points [K,3] with derivatives ``gradients`` [K,3] by the point."""
    return np.concatenate([gradients, np.cross(points_m, gradients)], axis=-1)


def image_gradients_by_point(du: Array, dv: Array, points_m: Array, camera: Camera) -> Array:
    """Derivative [K,3] by the camera-frame point, of an image with derivatives du, dv [K] per pixel where it lands."""
    inverse_z = 1.0 / points_m[:, 2]
    gx, gy = du * camera.fx * inverse_z, dv * camera.fy * inverse_z
    gz = -(gx * points_m[:, 0] + gy * points_m[:, 1]) * inverse_z
    return np.stack([gx, gy, gz], axis=-1)


def image_derivatives(image: npt.NDArray[np.floating]) -> tuple[Array, Array]:
    """Derivatives d/du and d/dv per pixel of an image [H,W,C], as the tracker takes them."""
    du, dv = (cv2.Scharr(image, cv2.CV_64F, x, 1 - x, scale=1 / 32) for x in (1, 0))
    return np.asarray(du, np.float64), np.asarray(dv, np.float64)


def moved(T: se3.Matrix4, points_m: Array) -> Array:
    """Points [K,3] moved by a rigid motion."""
    return points_m @ T[:3, :3].T + T[:3, 3]


def sampled(image: npt.NDArray[np.float32], uv: Array) -> Array:
    """Values [K,C] of an image [H,W,C] between its pixel centres at ``uv`` [K,2], all at least a pixel inside."""
    x, y = uv[:, 0] - 0.5, uv[:, 1] - 0.5
    u = np.minimum(x.astype(np.int64), image.shape[1] - 2)
    v = np.minimum(y.astype(np.int64), image.shape[0] - 2)
    a, b = (x - u)[:, None], (y - v)[:, None]
    top = image[v, u] * (1 - a) + image[v, u + 1] * a
    bottom = image[v + 1, u] * (1 - a) + image[v + 1, u + 1] * a
    return np.asarray(top * (1 - b) + bottom * b, np.float64)


def inside(uv: Array, camera: Camera, *, border_px: float) -> npt.NDArray[np.bool_]:
    """Which of ``uv`` [K,2] are farther from the image's border than ``border_px``."""
    return np.asarray(
        (uv[:, 0] >= border_px)
        & (uv[:, 1] >= border_px)
        & (uv[:, 0] < camera.width - border_px)
        & (uv[:, 1] < camera.height - border_px)
    )

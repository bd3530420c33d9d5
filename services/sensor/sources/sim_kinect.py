"""Noise of a structured-light depth camera, and of its colour camera."""

import cv2
import numpy as np
import numpy.typing as npt

Rng = np.random.Generator

MIN_RANGE_M = 0.4
COLOUR_SIGMA = 1.5  # of 255

_DISPARITY_STEPS_M = 580.0 * 0.075 * 8.0  # focal length (px) times baseline (m) times 8 steps a pixel
_EDGE_RATIO = 1.04  # neighbouring depths further apart than this are an edge
_EDGE_HOLE_RATE = 0.35
_GRAZING_COSINES = (0.10, 0.26)  # all lost below the first, none above the second


def axial_sigma_m(depth_m: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Standard deviation of depth along the axis (m) at a depth (m)."""
    return np.asarray(0.0012 + 0.0019 * (depth_m - 0.4) ** 2)


def noisy_depth(depth_m: npt.NDArray[np.float64], cosine: npt.NDArray[np.float32], rng: Rng) -> npt.NDArray[np.float64]:
    """Depth [H,W] (m, exact) as the sensor would give it, 0 in holes.

    ``cosine`` [H,W] is that of the angle between ray and surface normal. At edges the depth is that of a pixel about
    one away; the far side of edges and surfaces at grazing angles have holes; values are rounded to 1/8 pixel of
    disparity.
    """
    height, width = depth_m.shape
    box = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(depth_m, box), cv2.dilate(depth_m, box)
    edge = far > near * _EDGE_RATIO
    shift = np.rint(rng.standard_normal((2, height, width), np.float32) * 0.7).astype(np.intp) * edge
    rows = np.clip(np.arange(height)[:, None] + shift[0], 0, height - 1)
    columns = np.clip(np.arange(width)[None, :] + shift[1], 0, width - 1)
    moved = depth_m[rows, columns]
    noisy = moved + axial_sigma_m(moved) * rng.standard_normal((height, width), np.float32)
    quantised = _DISPARITY_STEPS_M / np.maximum(np.rint(_DISPARITY_STEPS_M / np.maximum(noisy, 0.1)), 1.0)
    chance = rng.random((2, height, width), np.float32)
    all_lost, none_lost = _GRAZING_COSINES
    grazing = chance[0] > (cosine - all_lost) / (none_lost - all_lost)
    shadow = edge & (moved > 0.5 * (near + far)) & (chance[1] < _EDGE_HOLE_RATE)
    return np.where(grazing | shadow | (moved < MIN_RANGE_M), 0.0, quantised)


def noisy_colour(rgb: npt.NDArray[np.uint8], rng: Rng) -> npt.NDArray[np.uint8]:
    """Colour [H,W,3] with Gaussian noise of ``COLOUR_SIGMA``."""
    noise = COLOUR_SIGMA * rng.standard_normal(rgb.shape, np.float32)
    return np.clip(np.rint(rgb + noise), 0.0, 255.0).astype(np.uint8)

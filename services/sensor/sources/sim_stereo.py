"""Noise of a stereo camera: depth from disparity, and its colour camera."""

import cv2
import numpy as np
import numpy.typing as npt

Rng = np.random.Generator

FOCAL_BASELINE_M_PX = 718.856 * 0.5372  # of KITTI's colour cameras at full size
DISPARITY_SIGMA_PX = 0.2  # at full size, half of it alike over patches of some pixels, as matching windows make it
FARTHEST_M = 90.0
COLOUR_SIGMA = 1.5  # of 255

_PATCH_PX = 6


def sigma_m(depth_m: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Standard deviation of depth (m) at a depth (m): it grows with the square."""
    return np.asarray(DISPARITY_SIGMA_PX / FOCAL_BASELINE_M_PX * depth_m**2)


def noisy_depth(depth_m: npt.NDArray[np.float64], rng: Rng) -> npt.NDArray[np.float64]:
    """Depth [H,W] (m, exact, 0 = none) as matching would give it; 0 beyond ``FARTHEST_M``."""
    height, width = depth_m.shape
    coarse = rng.standard_normal((height // _PATCH_PX + 2, width // _PATCH_PX + 2), np.float32)
    patches = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR) * np.float32(1.5)  # back to 1
    noise = np.float32(np.sqrt(0.5)) * (patches + rng.standard_normal((height, width), np.float32))
    valid = (depth_m > 0.0) & (depth_m < FARTHEST_M)
    disparity = FOCAL_BASELINE_M_PX / np.where(valid, depth_m, 1.0) + DISPARITY_SIGMA_PX * noise
    return np.where(valid, FOCAL_BASELINE_M_PX / np.maximum(disparity, 1.0), 0.0)


def noisy_colour(rgb: npt.NDArray[np.uint8], rng: Rng) -> npt.NDArray[np.uint8]:
    """Colour [H,W,3] with Gaussian noise of ``COLOUR_SIGMA``."""
    noise = np.float32(COLOUR_SIGMA) * rng.standard_normal(rgb.shape, np.float32)
    return np.clip(np.rint(rgb + noise), 0.0, 255.0).astype(np.uint8)

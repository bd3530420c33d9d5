"""A frame of the smooth room, and the view of it that it is aligned to."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.geometry import se3
from vtslam.common.optim.alignment import Observed, Reference, observed_frame, reference_view

Array = npt.NDArray[np.float64]

CAMERA = small_camera()
START = se3.exp(np.array([0.2, -0.1, 0.3, 0.1, 0.4, -0.2]))


def motion(seed: int, *, metres: float, degrees: float) -> Array:
    """A motion of this length and angle in random directions."""
    rng = np.random.default_rng(seed)
    rho, phi = rng.normal(size=3), rng.normal(size=3)
    return se3.exp(
        np.concatenate([rho * metres / np.linalg.norm(rho), phi * np.radians(degrees) / np.linalg.norm(phi)])
    )


def reference_of(room: SmoothRoom, *, levels: int = 1, margin: int = 0) -> Reference:
    """The room from START, with a point at every pixel; a margin keeps what is warped away from the image's border."""
    rendering = room.rendering(START, CAMERA)
    points = CAMERA.back_projected(rendering.depth_m)
    normals = room.normals(points @ START[:3, :3].T + START[:3, 3]) @ START[:3, :3]
    inner = np.ones(rendering.alpha.shape, np.bool_)
    if margin:
        inner[:margin], inner[-margin:], inner[:, :margin], inner[:, -margin:] = False, False, False, False
    rendering = replace(rendering, alpha=np.where(inner, rendering.alpha, np.float32(0)))
    surface = np.concatenate([points, normals], axis=-1).reshape(-1, 6).astype(np.float32)
    return reference_view(rendering, CAMERA, np.eye(4), surface=surface, levels=levels, silhouette_threshold=0.9)


def observed_of(room: SmoothRoom, T_world_camera: Array, *, levels: int = 1) -> Observed:
    return observed_frame(*room.view(T_world_camera, CAMERA), CAMERA, levels)


def with_mask(reference: Reference, mask: npt.NDArray[np.uint8]) -> Reference:
    """The view with another mask at its finest level."""
    return replace(reference, levels=[replace(reference.levels[0], mask=mask)])

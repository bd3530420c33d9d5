"""The one protocol of all rasteriser engines, and the records that cross it.

Image model (EWA splatting of isotropic Gaussians): a Gaussian at camera point (X, Y, Z) with standard deviation
sigma has image mean (fx X/Z + cx, fy Y/Z + cy) and covariance sigma^2 J J^T + low_pass I, J the Jacobian of the
projection at the mean. At a pixel centre d away from the mean, alpha = min(cap, opacity exp(-d^T Sigma^-1 d / 2)).
Gaussians are blended front to back by Z (ties by index); alpha below ``alpha_min`` is skipped, and the first one
that would take the transmittance below ``transmittance_min`` ends the pixel without being blended.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class RasterSettings:
    """Constants of the image model (module text)."""

    low_pass_px2: float = 0.001
    near_m: float = 0.2
    alpha_cap: float = 0.999
    alpha_min: float = 1.0 / 255.0
    transmittance_min: float = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Splats:
    """Gaussians as a renderer takes them; float32, C-contiguous; the engine's own arrays.

    Attributes:
        means_m: [N,3], in the frame the pose maps from.
        colors: [N,3], any value (not clamped).
        log_radii: [N], natural logarithm of sigma in metres.
        opacity_logits: [N].
    """

    means_m: FloatArray
    colors: FloatArray
    log_radii: FloatArray
    opacity_logits: FloatArray

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.log_radii.shape[0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rendering:
    """What one pass gives.

    Attributes:
        rgb: [H,W,3].
        depth_m: [H,W], accumulated alpha T z, not divided by alpha.
        alpha: [H,W], accumulated alpha T (the silhouette S).
        saved: The engine's own record for ``backward``.
    """

    rgb: FloatArray
    depth_m: FloatArray
    alpha: FloatArray
    saved: Any


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gradients:
    """Derivatives of a scalar loss.

    Attributes:
        colors: [N,3]. log_radii: [N]. opacity_logits: [N].
        means_m: [N,3] in the frame of the splats' means, or None if not asked for.
        weights: [N], no derivative: the sum over pixels of alpha T with which each was blended; None if not asked for.
        pose: float64 [6] for ``exp(xi) @ T_camera_map`` at xi = 0, xi = (translation m, rotation rad);
            zero if not asked for.
    """

    colors: FloatArray
    log_radii: FloatArray
    opacity_logits: FloatArray
    means_m: FloatArray | None
    pose: npt.NDArray[np.float64]
    weights: FloatArray | None = None


class Engine(Protocol):
    """A rasteriser: forward, backward. Raises ValueError for NaN, infinite or misshapen input."""

    name: str
    settings: RasterSettings

    def render(self, splats: Splats, camera: Camera, T_camera_map: npt.NDArray[np.float64]) -> Rendering:
        """Render ``splats`` from a pose (float64 [4,4], map to camera)."""
        ...

    def backward(
        self,
        rendering: Rendering,
        *,
        d_rgb: FloatArray,
        d_depth: FloatArray,
        d_alpha: FloatArray | None = None,
        want_means: bool = False,
        want_pose: bool = True,
        want_weights: bool = False,
    ) -> Gradients:
        """Pull image derivatives (shapes as in the rendering) back to the Gaussians and, if wanted, the pose."""
        ...

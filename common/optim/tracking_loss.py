"""The tracking loss, Eq. 1, with its derivatives with respect to the rendered images."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.optim import _align
from vtslam.common.splat.engine import FloatArray, Rendering


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """A frame as the tracker compares it.

    Attributes:
        rgb: float32 [H,W,3], 0..1.
        depth_m: float32 [H,W]; 0 where there is none.
        mask: uint8 [H,W], fixed part of the mask W of Eq. 1 (valid depth, near enough, visible).
    """

    rgb: FloatArray
    depth_m: FloatArray
    mask: npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingLoss:
    """Eq. 1 taken apart.

    Attributes:
        color: Mean over the mask of sum_c |I - I'|.
        depth_m: Mean over the mask of |D - D'|.
        pixels: Pixels in the mask.
        total: alpha * color + beta * depth, per pixel: normalised by mask area, so that views can be compared.
    """

    color: float
    depth_m: float
    pixels: int
    total: float


def tracking_loss(
    rendering: Rendering, target: Target, *, silhouette_threshold: float, color_weight: float, depth_weight: float
) -> tuple[TrackingLoss, FloatArray, FloatArray]:
    """Eq. 1 over mask, valid depth and silhouette above the threshold.

    Returns:
        The loss; d_rgb [H,W,3] and d_depth [H,W] of the weighted SUM, as the paper writes it. No gradient flows
        through the mask. An empty mask gives zero derivatives and an infinite total.
    """
    color_sum, depth_sum, pixels, d_rgb, d_depth = _align.tracking_loss(
        rendering.rgb,
        rendering.depth_m,
        rendering.alpha,
        target.rgb,
        target.depth_m,
        target.mask,
        silhouette_threshold,
        color_weight,
        depth_weight,
    )
    area = max(pixels, 1)
    total = (color_weight * color_sum + depth_weight * depth_sum) / area if pixels else float("inf")
    loss = TrackingLoss(color=color_sum / area, depth_m=depth_sum / area, pixels=pixels, total=total)
    return loss, np.asarray(d_rgb), np.asarray(d_depth)

"""The mapping loss of Eq. 2 for one view, with its derivatives, in one fused pass (C++).

L = w_color [(1 - s) mean |I - I^| + s (1 - SSIM(I, I^))] + w_depth mean_{D > 0} |D - D^|

I and I^ are the observed and the rendered colour, D and D^ the depths. SSIM: window 11x11 Gaussian of sigma 1.5, zero
padding, C1 = 0.01^2, C2 = 0.03^2, per channel, mean over all pixels (data range 1).
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.splat import _native
from vtslam.common.splat.engine import FloatArray
from vtslam.common.splat.native_engine import checked


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MappingLoss:
    """A value of the loss.

    Attributes:
        loss: The weighted sum.
        color_l1: mean |I - I^| over pixels and channels. ssim: mean SSIM (1 if its share is 0). depth_l1_m: mean
            |D - D^| over pixels with D > 0, 0 if there are none. All three unweighted.
        d_rgb: Derivative of ``loss`` by the rendered colour, [H,W,3].
        d_depth: Derivative by the rendered depth, [H,W]. An error of exactly zero has derivative zero.
    """

    loss: float
    color_l1: float
    ssim: float
    depth_l1_m: float
    d_rgb: FloatArray
    d_depth: FloatArray


def mapping_loss(
    rgb: FloatArray,
    depth_m: FloatArray,
    target_rgb: FloatArray,
    target_depth_m: FloatArray,
    *,
    weight_color: float = 1.0,
    weight_depth: float = 1.0,
    ssim_share: float = 0.2,
    mask: npt.NDArray[np.uint8] | None = None,
    threads: int | None = None,
) -> MappingLoss:
    """Loss of a rendering against an observed frame; the same bytes for any number of threads.

    Args:
        rgb: Rendered colour, float32 [H,W,3].
        depth_m: Rendered depth, float32 [H,W].
        target_rgb: Observed colour in 0..1, float32 [H,W,3].
        target_depth_m: Observed depth, float32 [H,W]; 0 where there is none.
        weight_color: w_color.
        weight_depth: w_depth.
        ssim_share: s.
        mask: uint8 [H,W]; pixels with 0 are left out of both mean absolute errors, but not of SSIM. None: none.
        threads: None for the process's default.

    Raises:
        ValueError: An array is misshapen, of another type or not contiguous, or the loss is not finite; the text names
            the array and, for NaN or infinity, the first such index.
    """
    size = depth_m.shape
    checked("depth_m", depth_m, np.float32, (*size[:2],) if len(size) >= 2 else (0, 0))
    checked("rgb", rgb, np.float32, (*size, 3))
    checked("target_rgb", target_rgb, np.float32, (*size, 3))
    checked("target_depth_m", target_depth_m, np.float32, size)
    if mask is not None:
        checked("mask", mask, np.uint8, size)
    color_l1, ssim, depth_l1_m, d_rgb, d_depth = _native.mapping_loss(
        rgb, depth_m, target_rgb, target_depth_m, mask, weight_color, weight_depth, ssim_share, threads or 0
    )
    color = (1.0 - ssim_share) * color_l1 + ssim_share * (1.0 - ssim)
    return MappingLoss(
        loss=weight_color * color + weight_depth * depth_l1_m,
        color_l1=color_l1,
        ssim=ssim,
        depth_l1_m=depth_l1_m,
        d_rgb=d_rgb,
        d_depth=d_depth,
    )

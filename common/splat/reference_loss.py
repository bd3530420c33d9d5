"""The mapping loss in plain torch, to compare the fused native one with.

L = w_color [(1 - s) mean |I - I^| + s (1 - SSIM)] + w_depth mean over D > 0 of |D - D^|, one rendering's part of Eq. 2.
SSIM (Wang et al. 2004): 11x11 Gaussian window of sigma 1.5, pixels beyond the border count as zero, constants 0.01^2
and 0.03^2, mean over pixels and channels.
"""

import torch

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Structural similarity of two images [H,W,C] in 0..1, a scalar."""
    offsets = torch.arange(-_RADIUS, _RADIUS + 1, dtype=image.dtype)
    window = torch.exp(-0.5 * (offsets / _SIGMA) ** 2)
    window = torch.outer(window, window)[None, None] / window.sum() ** 2

    def filtered(values: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(values.permute(2, 0, 1)[:, None], window, padding=_RADIUS)

    mean_x, mean_y = filtered(image), filtered(target)
    variance_x = filtered(image * image) - mean_x**2
    variance_y = filtered(target * target) - mean_y**2
    covariance = filtered(image * target) - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2.0 * covariance + _C2) / (variance_x + variance_y + _C2)
    return (luminance * structure).mean()


def reference_mapping_loss(
    rgb: torch.Tensor,
    depth_m: torch.Tensor,
    target_rgb: torch.Tensor,
    target_depth_m: torch.Tensor,
    *,
    weight_color: float,
    weight_depth: float,
    ssim_share: float,
    mask: torch.Tensor | None = None,
) -> torch.Tensor:
    """The loss of the module text, a scalar that autograd can follow.

    Args:
        rgb: Rendered colour [H,W,3].
        depth_m: Rendered depth [H,W], not divided by alpha.
        target_rgb: Observed colour [H,W,3].
        target_depth_m: Observed depth [H,W]; 0 where there is none.
        weight_color: w_color.
        weight_depth: w_depth.
        ssim_share: s, 0 to 1.
        mask: bool [H,W]; the pixels that the two absolute differences count, all without it. SSIM counts all.
    """
    counted = torch.ones_like(target_depth_m, dtype=torch.bool) if mask is None else mask
    deep = counted & (target_depth_m > 0.0)
    zero = rgb.new_zeros(())
    color = (rgb - target_rgb)[counted].abs().mean() if bool(counted.any()) else zero
    depth = (depth_m - target_depth_m)[deep].abs().mean() if bool(deep.any()) else zero
    color_term = (1.0 - ssim_share) * color + ssim_share * (1.0 - ssim(rgb, target_rgb))
    return weight_color * color_term + weight_depth * depth

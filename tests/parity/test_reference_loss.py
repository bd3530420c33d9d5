"""The reference loss against sums written out by hand."""

import numpy as np
import pytest
import torch

from vtslam.common.splat.reference_loss import reference_mapping_loss, ssim


def _images(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(4)
    rgb, target_rgb = (torch.from_numpy(rng.uniform(0.0, 1.0, (height, width, 3))) for _ in range(2))
    depth, target_depth = (torch.from_numpy(rng.uniform(0.5, 3.0, (height, width))) for _ in range(2))
    target_depth[rng.random((height, width)) < 0.3] = 0.0
    return rgb, depth, target_rgb, target_depth


def _ssim_at(x: np.ndarray, y: np.ndarray, row: int, column: int) -> float:
    """SSIM at a pixel of single-channel images, as its definition reads."""
    moments, total = np.zeros(5), 0.0
    for dv in range(-5, 6):
        for du in range(-5, 6):
            weight = np.exp(-(du * du + dv * dv) / (2.0 * 1.5**2))
            total += weight
            v, u = row + dv, column + du
            if 0 <= v < x.shape[0] and 0 <= u < x.shape[1]:
                a, b = x[v, u], y[v, u]
                moments += weight * np.array([a, b, a * a, b * b, a * b])
    mx, my, xx, yy, xy = moments / total
    numerator = (2 * mx * my + 0.01**2) * (2 * (xy - mx * my) + 0.03**2)
    return float(numerator / ((mx**2 + my**2 + 0.01**2) * (xx - mx**2 + yy - my**2 + 0.03**2)))


@pytest.mark.parametrize("size", [(1, 1), (4, 9), (13, 12)])
def test_ssim_is_its_definition(size: tuple[int, int]) -> None:
    rgb, _, target, _ = _images(*size)
    x, y = rgb.numpy(), target.numpy()
    expected = np.mean([_ssim_at(x[..., c], y[..., c], v, u) for v, u, c in np.ndindex(*size, 3)])
    assert float(ssim(rgb, target)) == pytest.approx(expected, abs=1e-12)
    assert float(ssim(rgb, rgb)) == pytest.approx(1.0)


def test_loss_weighs_its_terms() -> None:
    rgb, depth, target_rgb, target_depth = _images(9, 7)
    mask = torch.from_numpy(np.random.default_rng(1).random((9, 7)) < 0.5)
    given = reference_mapping_loss(
        rgb, depth, target_rgb, target_depth, weight_color=0.5, weight_depth=2.0, ssim_share=0.2, mask=mask
    )
    chosen = mask.numpy()
    color = np.abs(rgb.numpy() - target_rgb.numpy())[chosen].mean()
    deep = chosen & (target_depth.numpy() > 0.0)
    depths = np.abs(depth.numpy() - target_depth.numpy())[deep].mean()
    expected = 0.5 * (0.8 * color + 0.2 * (1.0 - float(ssim(rgb, target_rgb)))) + 2.0 * depths
    assert float(given) == pytest.approx(expected)


def test_no_depth_and_no_pixel_give_no_term() -> None:
    rgb, depth, target_rgb, target_depth = _images(3, 5)
    nothing = torch.zeros_like(target_depth)
    without_depth = reference_mapping_loss(
        rgb, depth, target_rgb, nothing, weight_color=1.0, weight_depth=1.0, ssim_share=0.0
    )
    assert float(without_depth) == pytest.approx(float((rgb - target_rgb).abs().mean()))
    masked = reference_mapping_loss(
        rgb,
        depth,
        target_rgb,
        target_depth,
        weight_color=1.0,
        weight_depth=1.0,
        ssim_share=0.0,
        mask=nothing > 0.0,
    )
    assert float(masked) == 0.0

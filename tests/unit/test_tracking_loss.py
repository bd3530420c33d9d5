"""Eq. 1 and its image derivatives, held to their definition."""

import numpy as np
import numpy.typing as npt
import pytest

from vtslam.common.optim.tracking_loss import Target, TrackingLoss, tracking_loss
from vtslam.common.splat.engine import Rendering

Image = npt.NDArray[np.float32]

H, W = 11, 17
ALPHA, BETA, SILHOUETTE = 0.5, 1.5, 0.9


def scene(seed: int) -> tuple[Rendering, Target]:
    rng = np.random.default_rng(seed)

    def image(*shape: int) -> Image:
        return rng.random(shape).astype(np.float32)

    rendering = Rendering(rgb=image(H, W, 3), depth_m=3 * image(H, W), alpha=0.7 + 0.3 * image(H, W), saved=None)
    depth_m = 3 * image(H, W)
    depth_m[rng.random((H, W)) < 0.1] = 0.0
    target = Target(rgb=image(H, W, 3), depth_m=depth_m, mask=(rng.random((H, W)) < 0.8).astype(np.uint8))
    return rendering, target


def evaluated(rendering: Rendering, target: Target) -> tuple[TrackingLoss, Image, Image]:
    return tracking_loss(rendering, target, silhouette_threshold=SILHOUETTE, color_weight=ALPHA, depth_weight=BETA)


@pytest.mark.parametrize("seed", range(3))
def test_loss_and_derivatives_match_the_definition(seed: int) -> None:
    rendering, target = scene(seed)
    loss, d_rgb, d_depth = evaluated(rendering, target)
    inside = (target.mask > 0) & (target.depth_m > 0) & (rendering.alpha > SILHOUETTE)
    color = np.abs(rendering.rgb.astype(np.float64) - target.rgb).sum(axis=2)[inside]
    depth = np.abs(rendering.depth_m.astype(np.float64) - target.depth_m)[inside]
    assert 20 < loss.pixels == np.count_nonzero(inside) < H * W
    assert loss.color == pytest.approx(color.mean(), rel=1e-6)
    assert loss.depth_m == pytest.approx(depth.mean(), rel=1e-6)
    assert loss.total == pytest.approx(ALPHA * color.mean() + BETA * depth.mean(), rel=1e-6)
    np.testing.assert_array_equal(
        d_rgb, np.where(inside[..., None], ALPHA * np.sign(rendering.rgb - target.rgb), 0).astype(np.float32)
    )
    np.testing.assert_array_equal(
        d_depth, np.where(inside, BETA * np.sign(rendering.depth_m - target.depth_m), 0).astype(np.float32)
    )


def test_equal_images_have_no_loss_and_no_derivative() -> None:
    rendering, target = scene(0)
    same = Target(rgb=rendering.rgb, depth_m=rendering.depth_m, mask=target.mask)
    loss, d_rgb, d_depth = evaluated(rendering, same)
    assert (loss.total, loss.color, loss.depth_m) == (0.0, 0.0, 0.0)
    assert loss.pixels > 0
    assert not d_rgb.any()
    assert not d_depth.any()


@pytest.mark.parametrize("emptied_by", ["mask", "depth", "silhouette"])
def test_an_empty_mask_is_worse_than_any_view_and_pulls_nowhere(emptied_by: str) -> None:
    rendering, target = scene(1)
    zeros = np.zeros((H, W), np.float32)
    if emptied_by == "mask":
        target = Target(rgb=target.rgb, depth_m=target.depth_m, mask=np.zeros((H, W), np.uint8))
    elif emptied_by == "depth":
        target = Target(rgb=target.rgb, depth_m=zeros, mask=target.mask)
    else:
        rendering = Rendering(rgb=rendering.rgb, depth_m=rendering.depth_m, alpha=zeros, saved=None)
    loss, d_rgb, d_depth = evaluated(rendering, target)
    assert loss.pixels == 0
    assert loss.total == float("inf")
    assert not d_rgb.any()
    assert not d_depth.any()


def test_the_total_does_not_favour_views_with_little_in_common() -> None:
    rendering, target = scene(2)
    whole, _, _ = evaluated(rendering, target)
    corner = target.mask.copy()
    corner[:, 5:] = 0
    part, _, _ = evaluated(rendering, Target(rgb=target.rgb, depth_m=target.depth_m, mask=corner))
    assert part.pixels < whole.pixels / 2
    assert part.total == pytest.approx(whole.total, rel=0.3)  # a sum would fall to a third


def test_misshapen_images_are_refused() -> None:
    rendering, target = scene(0)
    with pytest.raises(ValueError, match="target_rgb: wrong shape"):
        evaluated(rendering, Target(rgb=target.rgb[:-1].copy(), depth_m=target.depth_m, mask=target.mask))

"""The reference rasteriser: the image model of :mod:`vtslam.common.splat.engine` written down plainly.

Float64 torch with autograd, every Gaussian against every pixel. It exists to be right: the fast engines are compared
with it, and no product process imports it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from vtslam.common.geometry.camera import Camera
from vtslam.common.splat.engine import FloatArray, Gradients, RasterSettings, Rendering, Splats
from vtslam.common.splat.torch_inputs import SplatTensors, camera_points, checked_derivatives, checked_pose

_PIXELS_AT_ONCE = 512  # bounds the [pixels, Gaussians] arrays
_WEIGHTLESS_TRANSMITTANCE = 2e-4  # a splat at the alpha cut behind this changes a pixel by less than 1e-6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TorchRendering:
    """A rendering that autograd can follow, and how near each pixel is to a discontinuity.

    Attributes:
        rgb: [H,W,3]. depth_m: [H,W], accumulated alpha T z. alpha: [H,W], accumulated alpha T.
        alpha_margin: [H,W], least |alpha - alpha_min| of the splats that a flip of the cut would make visible.
        stop_margin: [H,W], least |T - transmittance_min| / transmittance_min over the pixel's transmittances.
    """

    rgb: torch.Tensor
    depth_m: torch.Tensor
    alpha: torch.Tensor
    alpha_margin: torch.Tensor
    stop_margin: torch.Tensor


class _Projected(NamedTuple):
    """Gaussians in front of the near plane, nearest first."""

    means_px: torch.Tensor  # [K,2]
    inverse_covariance: torch.Tensor  # [K,2,2], 1/px^2
    opacity: torch.Tensor  # [K]
    channels: torch.Tensor  # [K,5]: colour, z, 1


class _Saved(NamedTuple):
    leaves: SplatTensors
    twist: torch.Tensor
    images: TorchRendering


def _project(points_m: torch.Tensor, tensors: SplatTensors, camera: Camera, settings: RasterSettings) -> _Projected:
    order = torch.sort(points_m[:, 2], stable=True).indices  # ties by index
    order = order[points_m[order, 2] > settings.near_m]
    x, y, z = points_m[order].unbind(1)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * x / z**2], 1),
            torch.stack([zero, camera.fy / z, -camera.fy * y / z**2], 1),
        ],
        1,
    )
    variance_m2 = torch.exp(2.0 * tensors.log_radii[order])
    covariance_px2 = variance_m2[:, None, None] * (jacobian @ jacobian.transpose(1, 2))
    covariance_px2 = covariance_px2 + settings.low_pass_px2 * torch.eye(2, dtype=z.dtype)
    return _Projected(
        means_px=torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1),
        inverse_covariance=torch.linalg.inv(covariance_px2),
        opacity=torch.sigmoid(tensors.opacity_logits[order]),
        channels=torch.cat([tensors.colors[order], z[:, None], torch.ones_like(z)[:, None]], 1),
    )


def _alphas(pixels: torch.Tensor, splats: _Projected, settings: RasterSettings) -> torch.Tensor:
    """Alpha [P,K] at pixel centres [P,2], capped but not cut."""
    dx, dy = (pixels[:, None, :] - splats.means_px[None, :, :]).unbind(2)
    a, b, c = splats.inverse_covariance[:, 0, 0], splats.inverse_covariance[:, 0, 1], splats.inverse_covariance[:, 1, 1]
    distance2 = a * dx * dx + 2.0 * b * dx * dy + c * dy * dy
    return (splats.opacity * torch.exp(-0.5 * distance2)).clamp(max=settings.alpha_cap)


def _blend(pixels: torch.Tensor, splats: _Projected, settings: RasterSettings) -> tuple[torch.Tensor, torch.Tensor]:
    """Channels [P,5] and margins [P,2] (alpha, transmittance) of some pixels."""
    with torch.no_grad():  # what is far below the cut at all of these pixels has no part in them
        reached = (_alphas(pixels, splats, settings) > 0.5 * settings.alpha_min).any(0)
    splats = _Projected(*(column[reached] for column in splats))
    uncut = _alphas(pixels, splats, settings)
    alpha = torch.where(uncut >= settings.alpha_min, uncut, torch.zeros_like(uncut))
    after = torch.cumprod(1.0 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
    weight = torch.where(after >= settings.transmittance_min, alpha * before, torch.zeros_like(alpha))

    with torch.no_grad():
        infinite = torch.full_like(alpha, torch.inf)
        from_cut = torch.where(before >= _WEIGHTLESS_TRANSMITTANCE, (uncut - settings.alpha_min).abs(), infinite)
        from_stop = (after / settings.transmittance_min - 1.0).abs()
        from_stop = torch.where(before >= settings.transmittance_min, from_stop, infinite)
        unbounded = torch.full_like(pixels[:, :1], torch.inf)
        margins = [torch.cat([margin, unbounded], 1).amin(1) for margin in (from_cut, from_stop)]
    return weight @ splats.channels, torch.stack(margins, 1)


class ReferenceEngine:
    """The engine of this module; its images and gradients leave as float32, its inside is float64."""

    name = "reference"

    def __init__(self, settings: RasterSettings | None = None) -> None:
        self.settings = settings or RasterSettings()

    def render_torch(
        self, tensors: SplatTensors, camera: Camera, T_camera_map: npt.NDArray[np.float64], twist: torch.Tensor
    ) -> TorchRendering:
        """Render float64 tensors so that autograd reaches them and ``twist``.

        Args:
            tensors: The Gaussians.
            camera: Intrinsics and size.
            T_camera_map: Pose, float64 [4,4].
            twist: float64 [6], must be zero: stands for the left perturbation of the pose.
        """
        points_m = camera_points(tensors.means_m, T_camera_map, twist)
        splats = _project(points_m, tensors, camera, self.settings)
        rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        pixels = torch.stack([columns, rows], -1).reshape(-1, 2).to(torch.float64) + 0.5
        parts = [_blend(some, splats, self.settings) for some in torch.split(pixels, _PIXELS_AT_ONCE)]
        size = (camera.height, camera.width)
        images = torch.cat([part[0] for part in parts]).reshape(*size, 5)
        margins = torch.cat([part[1] for part in parts]).reshape(*size, 2)
        return TorchRendering(
            rgb=images[..., :3],
            depth_m=images[..., 3],
            alpha=images[..., 4],
            alpha_margin=margins[..., 0],
            stop_margin=margins[..., 1],
        )

    def render(self, splats: Splats, camera: Camera, T_camera_map: npt.NDArray[np.float64]) -> Rendering:
        """Render as :class:`~vtslam.common.splat.engine.Engine` says.

        Raises:
            ValueError: NaN, infinite or misshapen input.
        """
        leaves = SplatTensors.of(splats)
        twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        images = self.render_torch(leaves, camera, checked_pose(T_camera_map), twist)
        return Rendering(
            rgb=_float32(images.rgb),
            depth_m=_float32(images.depth_m),
            alpha=_float32(images.alpha),
            saved=_Saved(leaves, twist, images),
        )

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
        """Pull image derivatives back, by autograd.

        Raises:
            ValueError: A derivative has another shape than its image, or holds NaN or infinity.
        """
        saved: _Saved = rendering.saved
        means, colors, log_radii, opacity_logits, pose = self.backward_torch(saved, d_rgb, d_depth, d_alpha)
        return Gradients(
            colors=_float32(colors),
            log_radii=_float32(log_radii),
            opacity_logits=_float32(opacity_logits),
            means_m=_float32(means) if want_means else None,
            pose=pose.numpy() if want_pose else np.zeros(6),
            weights=_float32(self.weights_torch(saved)) if want_weights else None,
        )

    @staticmethod
    def backward_torch(
        saved: _Saved,
        d_rgb: npt.NDArray[np.floating],
        d_depth: npt.NDArray[np.floating],
        d_alpha: npt.NDArray[np.floating] | None,
    ) -> list[torch.Tensor]:
        """Float64 gradients of means, colours, log radii, opacity logits and pose, for a rendering's ``saved``."""
        images = [saved.images.rgb, saved.images.depth_m, saved.images.alpha]
        cotangents = checked_derivatives(images, (d_rgb, d_depth, d_alpha))
        leaves = [*saved.leaves.all(), saved.twist]
        gradients = torch.autograd.grad(
            images, leaves, cotangents, retain_graph=True, allow_unused=True, materialize_grads=True
        )
        return [gradient.detach() for gradient in gradients]

    @staticmethod
    def weights_torch(saved: _Saved) -> torch.Tensor:
        """Float64 sums [N] of blending weights: the derivative of an image channel's sum by that channel's colours."""
        red = saved.images.rgb[..., 0].sum()
        colors = saved.leaves.colors
        (gradient,) = torch.autograd.grad(red, [colors], retain_graph=True, allow_unused=True, materialize_grads=True)
        return gradient[:, 0].detach()


def _float32(tensor: torch.Tensor) -> FloatArray:
    return tensor.detach().numpy().astype(np.float32)

"""The CUDA engine: an adapter to gsplat 1.5 (https://docs.gsplat.studio), imported only when it is chosen.

Its authors have never executed this path on a GPU. The mapping of arguments is tested against a stand-in with gsplat's
documented signature; ``vtslam doctor --gpu`` compares the real thing with the reference on the user's machine.

Where gsplat's image model differs from :mod:`vtslam.common.splat.engine`: cap, alpha cut and transmittance stop are
constants of its kernels, so other values are refused; it evaluates the projection's Jacobian no further outside the
image than 0.3 half-sizes (:data:`VIEW_MARGIN`), so Gaussians beyond that keep a bounded footprint; its backward pass
recovers the transmittance from 1 - alpha in float32, which costs digits where pixels are nearly opaque, and its
kernels are built with approximate exponentials and divisions.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from vtslam.common.geometry.camera import Camera
from vtslam.common.splat.engine import FloatArray, Gradients, RasterSettings, Rendering, Splats
from vtslam.common.splat.torch_inputs import SplatTensors, camera_points, checked_derivatives, checked_pose

FIXED_CONSTANTS = {"alpha_cap": 0.999, "alpha_min": 1.0 / 255.0, "transmittance_min": 1e-4}
VIEW_MARGIN = 0.3


class GsplatUnavailableError(RuntimeError):
    """gsplat or a CUDA device is missing; the text says what to install."""


class _Saved(NamedTuple):
    leaves: SplatTensors
    twist: torch.Tensor
    images: tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # rgb, depth, alpha
    as_numpy: bool


class GsplatEngine:
    """Engine whose own arrays are float32 torch tensors on a CUDA device.

    Columns of :class:`Splats` may be numpy arrays or tensors; images and gradients come back as what the columns were.

    Args:
        settings: Constants of the image model; those of :data:`FIXED_CONSTANTS` cannot be changed.
        device: torch device.

    Raises:
        ValueError: A constant that gsplat fixes has another value.
        GsplatUnavailableError: gsplat is not installed, or torch finds no such device.
    """

    name = "gsplat"

    def __init__(self, settings: RasterSettings | None = None, *, device: str = "cuda") -> None:
        self.settings = settings or RasterSettings()
        self._device = device
        for name, fixed in FIXED_CONSTANTS.items():
            value = getattr(self.settings, name)
            if not np.isclose(value, fixed, rtol=1e-6, atol=0.0):
                raise ValueError(f"gsplat fixes {name} at {fixed:g}; {value:g} needs splat.engine=native")
        if device.startswith("cuda") and not torch.cuda.is_available():
            raise GsplatUnavailableError("torch finds no CUDA device; use splat.engine=native")
        try:
            import gsplat
        except ImportError as error:
            raise GsplatUnavailableError('gsplat is missing; install it with: pip install "vtslam[cuda]"') from error
        self._rasterization = gsplat.rasterization

    def render(self, splats: Splats, camera: Camera, T_camera_map: npt.NDArray[np.float64]) -> Rendering:
        """Render as :class:`~vtslam.common.splat.engine.Engine` says.

        Raises:
            ValueError: NaN, infinite or misshapen input.
        """
        pose = checked_pose(T_camera_map)
        leaves = SplatTensors.of(splats, device=self._device, dtype=torch.float32)
        twist = torch.zeros(6, dtype=torch.float32, device=self._device, requires_grad=True)
        # In float64, so that nothing is lost when the map's origin is far from the camera.
        points_m = camera_points(leaves.means_m.double(), pose, twist.double()).float()
        images = self._rasterized(points_m, leaves, camera)
        saved = _Saved(leaves, twist, images, as_numpy=isinstance(splats.means_m, np.ndarray))
        rgb, depth_m, alpha = (_given_back(image, saved) for image in images)
        return Rendering(rgb=rgb, depth_m=depth_m, alpha=alpha, saved=saved)

    def _rasterized(
        self, points_m: torch.Tensor, leaves: SplatTensors, camera: Camera
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Images of Gaussians given in the camera frame: a sphere looks the same from any side, so this is exact."""
        count = points_m.shape[0]
        if count == 0:  # not promised to work
            blank = torch.zeros(camera.height, camera.width, 5, device=self._device)
            return blank[..., :3], blank[..., 3], blank[..., 4]
        intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        colors, alphas, _ = self._rasterization(
            means=points_m,
            quats=torch.tensor([1.0, 0.0, 0.0, 0.0], device=self._device).expand(count, 4).contiguous(),  # w, x, y, z
            scales=torch.exp(leaves.log_radii)[:, None].expand(count, 3).contiguous(),
            opacities=torch.sigmoid(leaves.opacity_logits),
            colors=leaves.colors,
            viewmats=torch.eye(4, device=self._device)[None],
            Ks=torch.tensor(intrinsics, dtype=torch.float32, device=self._device)[None],
            width=camera.width,
            height=camera.height,
            near_plane=self.settings.near_m,
            eps2d=self.settings.low_pass_px2,
            radius_clip=0.0,
            packed=False,
            backgrounds=None,
            render_mode="RGB+D",  # accumulated depth as the last channel
            rasterize_mode="classic",
            camera_model="pinhole",
        )
        return colors[0, ..., :3], colors[0, ..., 3], alphas[0, ..., 0]

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
        """Pull image derivatives (numpy or tensors) back, through gsplat's own backward pass.

        Raises:
            ValueError: A derivative has another shape than its image, or holds NaN or infinity.
        """
        saved: _Saved = rendering.saved
        cotangents = checked_derivatives(saved.images, (d_rgb, d_depth, d_alpha))
        leaves = [*saved.leaves.all(), saved.twist]
        if saved.leaves.means_m.shape[0] == 0:
            found = [torch.zeros_like(leaf) for leaf in leaves]
        else:
            found = list(torch.autograd.grad(saved.images, leaves, cotangents, retain_graph=True))
        means, colors, log_radii, opacity_logits = (_given_back(gradient, saved) for gradient in found[:4])
        return Gradients(
            colors=colors,
            log_radii=log_radii,
            opacity_logits=opacity_logits,
            means_m=means if want_means else None,
            pose=found[4].double().cpu().numpy() if want_pose else np.zeros(6),
            weights=_given_back(_weights(saved), saved) if want_weights else None,
        )


def _weights(saved: _Saved) -> torch.Tensor:
    """Sums [N] of blending weights: the derivative of an image channel's sum by that channel's colours."""
    colors = saved.leaves.colors
    if colors.shape[0] == 0:
        return torch.zeros_like(colors[:, 0])
    return torch.autograd.grad(saved.images[0][..., 0].sum(), colors, retain_graph=True)[0][:, 0]


def _given_back(tensor: torch.Tensor, saved: _Saved) -> FloatArray:
    """A detached tensor as what the caller's columns were: numpy array or tensor on the device."""
    own: Any = tensor.detach()
    array: FloatArray = own.cpu().numpy() if saved.as_numpy else own
    return array

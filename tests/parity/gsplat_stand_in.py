"""A module with the documented signature of gsplat 1.5.3's `rasterization`, computing on the CPU what it documents."""

from types import ModuleType
from typing import Any

import torch


def _rotations(quats: torch.Tensor) -> torch.Tensor:
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _inverse_covariances(
    points: torch.Tensor, covariances: torch.Tensor, K: torch.Tensor, width: int, height: int, eps2d: float
) -> torch.Tensor:
    """EWA with gsplat's limit on the Jacobian outside the image."""
    z = points[:, 2]
    half = 0.5 * torch.tensor([width, height], dtype=K.dtype) / K.diagonal()[:2]
    center = torch.stack([0.5 * width - K[0, 2], 0.5 * height - K[1, 2]]) / K.diagonal()[:2]
    limited = torch.maximum(torch.minimum(points[:, :2] / z[:, None], center + 1.3 * half), center - 1.3 * half)
    jacobian = torch.zeros(len(z), 2, 3, dtype=K.dtype)
    jacobian[:, 0, 0], jacobian[:, 1, 1] = K[0, 0] / z, K[1, 1] / z
    jacobian[:, :, 2] = -K.diagonal()[:2] * limited / z[:, None]
    image = jacobian @ covariances @ jacobian.transpose(1, 2) + eps2d * torch.eye(2, dtype=K.dtype)
    inverse: torch.Tensor = torch.linalg.inv(image)
    return inverse


def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: torch.Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: torch.Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: torch.Tensor | None = None,
    tangential_coeffs: torch.Tensor | None = None,
    thin_prism_coeffs: torch.Tensor | None = None,
    ftheta_coeffs: object = None,
    rolling_shutter: object = None,
    viewmats_rs: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    count = means.shape[0]
    shapes = [tuple(tensor.shape) for tensor in (means, quats, scales, opacities, viewmats, Ks)]
    assert shapes == [(count, 3), (count, 4), (count, 3), (count,), (1, 4, 4), (1, 3, 3)], shapes
    assert colors.shape == (count, 3)
    assert all(tensor.dtype == torch.float32 for tensor in (means, quats, scales, opacities, colors, viewmats, Ks))
    assert count > 0
    # The other modes are documented too; this stands in for what the adapter may ask.
    assert (sh_degree, backgrounds, render_mode, rasterize_mode) == (None, None, "RGB+D", "classic")
    assert (camera_model, distributed, with_ut, with_eval3d, covars) == ("pinhole", False, False, False, None)
    assert radius_clip == 0.0

    exact = [tensor.double() for tensor in (means, quats, scales, opacities, colors, viewmats[0], Ks[0])]
    means, quats, scales, opacities, colors, view, K = exact
    points = means @ view[:3, :3].T + view[:3, 3]
    order = torch.sort(points[:, 2], stable=True).indices
    order = order[(points[order, 2] >= near_plane) & (points[order, 2] <= far_plane)]
    points, opacities, colors = points[order], opacities[order], colors[order]
    half = view[:3, :3] @ _rotations(quats[order]) * scales[order][:, None, :]
    inverse = _inverse_covariances(points, half @ half.transpose(1, 2), K, width, height, eps2d)
    projected = points @ K.T
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(-1, 1, 2) + 0.5
    delta = pixels - projected[:, :2] / projected[:, 2:]
    exponent = -0.5 * torch.einsum("pki,kij,pkj->pk", delta, inverse, delta)
    alpha = (opacities * torch.exp(exponent)).clamp(max=0.999)
    alpha = alpha * (alpha >= 1.0 / 255.0)
    after = torch.cumprod(1.0 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after], 1)[:, :-1]
    weight = alpha * before * (after > 1e-4)
    images = weight @ torch.cat([colors, points[:, 2:]], 1)
    shape = (1, height, width)
    return images.reshape(*shape, 4).float(), weight.sum(1).reshape(*shape, 1).float(), {}


def stand_in_module(**changes: object) -> ModuleType:
    """A module to put into `sys.modules["gsplat"]`; `changes` override arguments, to see an error found."""
    module = ModuleType("gsplat")

    def changed(**arguments: object) -> object:
        combined: dict[str, Any] = arguments | changes
        return rasterization(**combined)

    module.__dict__.update(rasterization=changed, __version__="1.5.3")
    return module

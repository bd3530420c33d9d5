"""Checks and conversions shared by the two engines that stand on torch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from vtslam.common.geometry import se3
from vtslam.common.splat.engine import Splats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SplatTensors:
    """The columns of :class:`Splats` as tensors of one device and type: [N,3], [N,3], [N], [N]."""

    means_m: torch.Tensor
    colors: torch.Tensor
    log_radii: torch.Tensor
    opacity_logits: torch.Tensor

    @classmethod
    def of(cls, splats: Splats, *, device: str = "cpu", dtype: torch.dtype = torch.float64) -> "SplatTensors":
        """Copies of the columns as leaves that record gradients.

        Raises:
            ValueError: A column has another shape than stated in :class:`Splats`, or holds NaN or infinity.
        """
        count = splats.count
        shapes = {"means_m": (count, 3), "colors": (count, 3), "log_radii": (count,), "opacity_logits": (count,)}
        columns: dict[str, torch.Tensor] = {}
        for name, shape in shapes.items():
            column = torch.as_tensor(getattr(splats, name)).detach().to(device=device, dtype=dtype, copy=True)
            if tuple(column.shape) != shape:
                raise ValueError(f"{name} must have shape {shape}, got {tuple(column.shape)}")
            if not bool(torch.isfinite(column).all()):
                raise ValueError(f"{name} holds NaN or infinite values")
            columns[name] = column.requires_grad_()
        return cls(**columns)

    def all(self) -> list[torch.Tensor]:
        """The four columns in the order of the fields."""
        return [self.means_m, self.colors, self.log_radii, self.opacity_logits]


def checked_pose(T_camera_map: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The pose as float64 [4,4].

    Raises:
        ValueError: It is not a finite rigid motion.
    """
    pose = np.asarray(T_camera_map, np.float64)
    if not se3.is_rigid(pose):
        raise ValueError(f"T_camera_map must be a finite rigid motion [4,4], got {pose.tolist()}")
    return pose


def checked_derivatives(images: Sequence[torch.Tensor], given: Sequence[object]) -> list[torch.Tensor]:
    """Image derivatives (arrays or tensors; None for zero) as tensors like their images.

    Raises:
        ValueError: A derivative has another shape than its image, or holds NaN or infinity.
    """
    out = []
    for image, values in zip(images, given, strict=True):
        tensor = torch.zeros_like(image) if values is None else torch.as_tensor(values).to(image)
        if tensor.shape != image.shape or not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"an image derivative must be finite, of shape {tuple(image.shape)}")
        out.append(tensor)
    return out


def camera_points(means_m: torch.Tensor, pose: npt.NDArray[np.float64], twist: torch.Tensor) -> torch.Tensor:
    """Means [N,3] in the camera frame of ``exp(twist) @ pose``, to first order in ``twist`` [6] about zero.

    The first order is what the derivative at zero needs, and is exact there.
    """
    transform = torch.as_tensor(pose, dtype=means_m.dtype, device=means_m.device)
    points = means_m @ transform[:3, :3].T + transform[:3, 3]
    turned: torch.Tensor = torch.linalg.cross(twist[3:].expand_as(points), points)
    return points + twist[:3] + turned

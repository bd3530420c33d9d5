"""What is shown, as plain named parts that know nothing of who draws them."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera

Color = tuple[int, int, int]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Something shown under a name; a later part of the same name replaces it.

    Attributes:
        path: Its name, with slashes.
        lasting: Whether it is sent once and holds for good; otherwise there is a new one soon.
    """

    path: str
    lasting: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gaussians(Part):
    """Spheres: centres float32 [N,3] and sigmas float32 [N] (m, world), colours with opacity uint8 [N,4]."""

    centers_m: npt.NDArray[np.float32]
    sigmas_m: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Points(Part):
    """Points float32 [N,3] (m, world) with colours uint8 [N,3]; without them the points have those of a `Tint`."""

    points_m: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tint(Part):
    """One colour for all points of that name."""

    color: Color


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line(Part):
    """A line through points float32 [N,3] (m, world)."""

    points_m: npt.NDArray[np.float32]
    color: Color


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frustum(Part):
    """A camera at ``T_world_camera`` float64 [4,4]."""

    T_world_camera: npt.NDArray[np.float64]
    camera: Camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture(Part):
    """An image uint8 [H,W,3], red first."""

    rgb: npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthPicture(Part):
    """Depth uint16 [H,W] in units of ``depth_scale_m``; 0 is none."""

    depth: npt.NDArray[np.uint16]
    depth_scale_m: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Figure(Part):
    """A point of a curve over time."""

    value: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Word(Part):
    """A line of a log."""

    text: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gone(Part):
    """What had this name is not there any more."""

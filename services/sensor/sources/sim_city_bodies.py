"""What stands or drives in ``sim:city``, and its hand-over to the ray caster as arrays."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources._city import Town
from vtslam.services.sensor.sources.sim_city_materials import Texels

BOX, CYLINDER, ELLIPSOID = range(3)

Arrays = tuple[
    npt.NDArray[np.int32], npt.NDArray[np.float64], npt.NDArray[np.int32], npt.NDArray[np.float64]
]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=False)
class Cover:
    """A texture by name, and what its width and height cover (m)."""

    texture: str
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """An upright box, cylinder or ellipsoid.

    Attributes:
        kind: ``BOX``, ``CYLINDER`` or ``ELLIPSOID``.
        place: x, z, direction of local x (x, z), half lengths along local x and z (or the radius twice), heights of
            bottom and top (m).
        side: Sides along local x, and all of a round body.
        end: The other two sides of a box.
        foot: Sides below ``foot_m``.
        foot_m: 0 for none.
        tint: Multiplies the textures but the foot's.
        shift: Moves stains (m), so that no two bodies have the same.
    """

    kind: int
    place: tuple[float, float, float, float, float, float, float, float]
    side: Cover
    end: Cover
    foot: Cover
    foot_m: float = 0.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    shift: float = 0.0


def body_arrays(bodies: list[Body], texture_names: list[str]) -> Arrays:
    """Kind [N], place [N,8], skin [N,3] and look [N,11], as `Town` takes them."""
    number = {name: k for k, name in enumerate(texture_names)}
    covers = [(b.side, b.end, b.foot) for b in bodies]
    look = [
        (*(size for cover in three for size in (cover.width_m, cover.height_m)), b.foot_m, *b.tint, b.shift)
        for b, three in zip(bodies, covers, strict=True)
    ]
    return (
        np.array([b.kind for b in bodies], np.int32),
        np.array([b.place for b in bodies], np.float64).reshape(-1, 8),
        np.array([[number[cover.texture] for cover in three] for three in covers], np.int32).reshape(-1, 3),
        np.array(look, np.float64).reshape(-1, 11),
    )


def make_town(bodies: list[Body], segments: npt.NDArray[np.float64], textures: dict[str, Texels]) -> Town:
    """The town, ready to be rendered; ``segments`` [S,5] are the streets' pieces."""
    return Town(*body_arrays(bodies, list(textures)), np.ascontiguousarray(segments), list(textures.values()))

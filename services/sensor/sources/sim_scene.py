"""Building blocks of simulated scenes: materials, textured primitives, and their hand-over to the ray caster."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources._raycast import Scene

Vector = tuple[float, float, float]
Colour = tuple[float, float, float]
WHITE: Colour = (1.0, 1.0, 1.0)

_BOX, _ROOM, _CONE, _ELLIPSOID = range(4)
NUM_FACES = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Material:
    """A tiling texture.

    Attributes:
        texels: uint8 [h,w,3]; h and w are powers of two.
        width_m: What the texture's width covers on a surface.
        height_m: What its height covers.
    """

    texels: npt.NDArray[np.uint8]
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Finish:
    """How a face looks: a material by name, shifted and tinted.

    Attributes:
        material: Name in the scene's table of materials.
        tint: Multiplies the texture.
        shift: Moves the texture, in parts of its width and height.
        stretch: None for the material's own size; else the (width, height) in metres that it covers once, centred.
        glow: Light given off (1 = the texture shows at full brightness in the dark).
    """

    material: str
    tint: Colour = WHITE
    shift: tuple[float, float] = (0.0, 0.0)
    stretch: tuple[float, float] | None = None
    glow: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """A soft light: position (m), colour and strength, and the distance (m) at which it has fallen to half."""

    position: Vector
    strength: Colour
    reach_m: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Primitive:
    kind: int
    centre: Vector
    rotation: npt.NDArray[np.float64]
    size: Vector
    faces: tuple[Finish, ...]


def turned(*, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> npt.NDArray[np.float64]:
    """Rotation [3,3] object to world: about x by roll, then about y by pitch, then about z by yaw."""
    (sz, sy, sx), (cz, cy, cx) = (f(np.radians([yaw_deg, pitch_deg, roll_deg])) for f in (np.sin, np.cos))
    about_z = np.array([[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]])
    return np.asarray(about_z @ about_y @ about_x, np.float64)


class SceneBuilder:
    """Collects primitives in world coordinates (x right, y to the back, z up; metres); then :meth:`build`.

    A body's ``finish`` is one for all faces or, for boxes, six (+x, -x, +y, -y, +z, -z), for cones three (side, top,
    bottom).
    """

    def __init__(self, materials: dict[str, Material]) -> None:
        self._materials = materials
        self._primitives: list[_Primitive] = []
        self._lights: list[Light] = []

    def _add(
        self,
        kind: int,
        centre: Vector,
        size: Vector,
        finish: Finish | tuple[Finish, ...],
        rotation: npt.NDArray[np.float64] | None,
    ) -> None:
        faces = (finish,) * NUM_FACES if isinstance(finish, Finish) else finish + (finish[-1],) * (6 - len(finish))
        turn = np.eye(3) if rotation is None else rotation
        self._primitives.append(_Primitive(kind=kind, centre=centre, rotation=turn, size=size, faces=faces))

    def room(self, low: Vector, high: Vector, finish: tuple[Finish, ...]) -> None:
        """The box from ``low`` to ``high`` seen from inside; its six finishes in the order +x, -x, +y, -y, +z, -z."""
        centre, half = _centre_and_half(low, high)
        self._add(_ROOM, centre, half, finish, None)

    def box(
        self,
        centre: Vector,
        size: Vector,
        finish: Finish | tuple[Finish, ...],
        rotation: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """A box with its full edge lengths ``size``."""
        self._add(_BOX, centre, (size[0] / 2, size[1] / 2, size[2] / 2), finish, rotation)

    def cone(
        self,
        centre: Vector,
        radii: tuple[float, float],
        height: float,
        finish: Finish | tuple[Finish, ...],
        rotation: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """A truncated cone along z with bottom and top ``radii``; a cylinder where they agree."""
        self._add(_CONE, centre, (radii[0], radii[1], height / 2), finish, rotation)

    def ellipsoid(
        self, centre: Vector, semi_axes: Vector, finish: Finish, rotation: npt.NDArray[np.float64] | None = None
    ) -> None:
        """An ellipsoid; a sphere where the semi-axes agree."""
        self._add(_ELLIPSOID, centre, semi_axes, finish, rotation)

    def light(self, light: Light) -> None:
        """Add a light."""
        self._lights.append(light)

    def build(self, *, ambient: Colour, num_threads: int) -> Scene:
        """The scene, ready to be rendered."""
        names = list(self._materials)
        items = self._primitives
        return Scene(
            kind=np.array([p.kind for p in items], np.int32),
            centre=np.array([p.centre for p in items], np.float64),
            rotation=np.array([p.rotation for p in items], np.float64),
            size=np.array([p.size for p in items], np.float64),
            face_texture=np.array([[names.index(f.material) for f in p.faces] for p in items], np.int32),
            face=np.array([[self._face(f) for f in p.faces] for p in items], np.float32),
            textures=[m.texels for m in self._materials.values()],
            lights=np.array([(*x.position, *x.strength, x.reach_m) for x in self._lights], np.float64).reshape(-1, 7),
            ambient=np.array(ambient, np.float32),
            num_threads=num_threads,
        )

    def _face(self, finish: Finish) -> tuple[float, ...]:
        material = self._materials[finish.material]
        width, height = finish.stretch or (material.width_m, material.height_m)
        return (0.5 + finish.shift[0], 0.5 + finish.shift[1], 1.0 / width, 1.0 / height, *finish.tint, finish.glow)


def _centre_and_half(low: Vector, high: Vector) -> tuple[Vector, Vector]:
    a, b = np.array(low), np.array(high)
    cx, cy, cz = (0.5 * (a + b)).tolist()
    hx, hy, hz = (0.5 * (b - a)).tolist()
    return (cx, cy, cz), (hx, hy, hz)

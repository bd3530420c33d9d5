"""Pieces of furniture, each put into a scene as textured boxes, cones and ellipsoids."""

import numpy as np

from vtslam.services.sensor.sources.sim_scene import Colour, Finish, SceneBuilder, Vector, turned

Rng = np.random.Generator

_COVERS: tuple[Colour, ...] = (  # red, navy, bottle green, ochre, cream, brown, teal, black, orange, grey blue, plum
    (0.95, 0.3, 0.26),
    (0.26, 0.34, 0.66),
    (0.28, 0.54, 0.34),
    (0.98, 0.76, 0.36),
    (1.15, 1.08, 0.92),
    (0.62, 0.42, 0.28),
    (0.3, 0.62, 0.62),
    (0.32, 0.32, 0.34),
    (1.1, 0.58, 0.26),
    (0.62, 0.74, 0.9),
    (0.6, 0.3, 0.45),
)


def table(scene: SceneBuilder, at: Vector, size: Vector, top: Finish, legs: Finish) -> None:
    """A table whose feet stand around ``at`` (floor centre), of full size (x, y, height)."""
    x, y, z = at
    wide, deep, high = size
    scene.box((x, y, z + high - 0.02), (wide, deep, 0.04), top)
    scene.box((x, y, z + high - 0.075), (wide - 0.12, deep - 0.12, 0.07), legs)
    for sx in (-1, 1):
        for sy in (-1, 1):
            foot = (x + sx * (wide / 2 - 0.06), y + sy * (deep / 2 - 0.06), z + (high - 0.04) / 2)
            scene.box(foot, (0.06, 0.06, high - 0.04), legs)


def chair(scene: SceneBuilder, at: Vector, yaw_deg: float, seat: Finish, frame: Finish) -> None:
    """A chair with its feet around ``at``, its back towards -x before it is turned by ``yaw_deg``."""
    turn = turned(yaw_deg=yaw_deg)

    def put(local: Vector, size: Vector, finish: Finish) -> None:
        x, y, z = (np.array(at) + turn @ np.array(local)).tolist()
        scene.box((x, y, z), size, finish, turn)

    put((0.0, 0.0, 0.45), (0.44, 0.44, 0.06), seat)
    for sx in (-1, 1):
        for sy in (-1, 1):
            put((0.19 * sx, 0.19 * sy, 0.21), (0.045, 0.045, 0.42), frame)
    for sy in (-1, 1):
        put((-0.2, 0.19 * sy, 0.69), (0.045, 0.045, 0.48), frame)
    put((-0.2, 0.0, 0.85), (0.03, 0.34, 0.14), seat)
    put((-0.2, 0.0, 0.64), (0.03, 0.34, 0.09), seat)


def book_row(scene: SceneBuilder, start: Vector, length: float, room: float, rng: Rng) -> None:
    """Books side by side along x from ``start`` (front lower left), spines to -y, under a shelf ``room`` above."""
    x = start[0]
    end = x + length
    while x < end - 0.06:
        thick = float(rng.uniform(0.022, 0.06))
        high = float(rng.uniform(0.66, 0.95)) * room
        deep = float(rng.uniform(0.15, 0.2))
        cover = Finish(material="spines", tint=book_colour(rng), shift=(float(rng.uniform()), float(rng.uniform())))
        paper = Finish(material="pages", shift=cover.shift)
        back = start[1] + 0.24
        scene.box(
            (x + thick / 2, back - deep / 2, start[2] + high / 2),
            (thick - 0.002, deep, high),
            (cover, cover, cover, cover, paper, paper),
        )
        x += thick
        if rng.random() < 0.06:
            x += 0.07


def book_colour(rng: Rng) -> Colour:
    """A cover colour near one of those in use."""
    r, g, b = (np.array(_COVERS[int(rng.integers(len(_COVERS)))]) * rng.uniform(0.75, 1.2, 3)).tolist()
    return r, g, b


def book_pile(scene: SceneBuilder, at: Vector, count: int, rng: Rng) -> None:
    """Books lying on one another on ``at``, each turned a little."""
    x, y, z = at
    turn_deg = float(rng.uniform(0.0, 90.0))
    for _ in range(count):
        thick = float(rng.uniform(0.02, 0.045))
        cover = Finish(material="spines", tint=book_colour(rng), shift=(float(rng.uniform()), float(rng.uniform())))
        paper = Finish(material="pages")
        scene.box(
            (x, y, z + thick / 2),
            (float(rng.uniform(0.2, 0.28)), float(rng.uniform(0.15, 0.2)), thick),
            (paper, cover, paper, paper, cover, cover),
            turned(yaw_deg=turn_deg + float(rng.uniform(-18.0, 18.0))),
        )
        z += thick


def bookshelf(scene: SceneBuilder, at: Vector, size: Vector, wood: Finish, rng: Rng, *, shelves: int = 5) -> None:
    """A filled bookshelf against a wall at +y; ``at`` is the middle of its back edge on the floor."""
    x, y, z = at
    wide, deep, high = size
    middle = y - deep / 2
    scene.box((x, y - 0.01, z + high / 2), (wide, 0.02, high), wood)
    for side in (-1, 1):
        scene.box((x + side * (wide / 2 - 0.0125), middle, z + high / 2), (0.025, deep, high), wood)
    step = (high - 0.1) / shelves
    for k in range(shelves + 1):
        level = z + 0.07 + k * step
        scene.box((x, middle, level), (wide - 0.05, deep, 0.025), wood)
        if k < shelves:
            book_row(scene, (x - wide / 2 + 0.03, y - 0.27, level + 0.0125), wide - 0.06, step - 0.03, rng)


def cabinet(scene: SceneBuilder, at: Vector, size: Vector, body: Finish, front: Finish, metal: Finish) -> None:
    """A cabinet with two rows of three drawers facing -y; ``at`` is the middle of its back edge on the floor."""
    x, y, z = at
    wide, deep, high = size
    scene.box((x, y - deep / 2, z + high / 2 + 0.04), (wide, deep, high - 0.08), body)
    scene.box((x, y - deep / 2, z + high + 0.01), (wide + 0.04, deep + 0.03, 0.03), front)
    for column in range(3):
        for row in range(2):
            cx = x + (column - 1) * wide / 3
            cz = z + 0.1 + (row + 0.5) * (high - 0.14) / 2
            scene.box((cx, y - deep, cz), (wide / 3 - 0.03, 0.03, (high - 0.14) / 2 - 0.03), front)
            scene.ellipsoid((cx, y - deep - 0.03, cz), (0.02, 0.02, 0.02), metal)
    for side in (-1, 1):
        scene.box((x + side * (wide / 2 - 0.05), y - deep / 2, z + 0.04), (0.06, deep - 0.06, 0.08), body)


def sofa(scene: SceneBuilder, at: Vector, size: Vector, cloth: Finish, pillows: tuple[Finish, ...]) -> None:
    """A sofa with its back to a wall at +x; ``at`` is the middle of its back edge on the floor, size (x, y, height)."""
    x, y, z = at
    deep, wide, high = size
    scene.box((x - deep / 2, y, z + 0.13), (deep, wide, 0.22), cloth)
    scene.box((x - 0.11, y, z + high / 2 + 0.02), (0.22, wide, high - 0.04), cloth)
    flat = turned(pitch_deg=90.0)
    scene.cone((x - 0.11, y, z + high), (0.11, 0.11), wide, cloth, turned(roll_deg=90.0))
    for side in (-1, 1):
        edge = y + side * (wide / 2 - 0.09)
        scene.box((x - deep / 2, edge, z + 0.3), (deep, 0.18, 0.5), cloth)
        scene.cone((x - deep / 2, edge, z + 0.55), (0.1, 0.1), deep, cloth, flat)
        scene.box(
            (x - deep / 2 - 0.05, y + side * (wide - 0.36) / 4, z + 0.32), (deep - 0.14, wide / 2 - 0.2, 0.17), cloth
        )
    for k, pillow in enumerate(pillows):
        across = (k + 0.5) / len(pillows) - 0.5
        at_pillow = (x - 0.34, y + across * (wide - 0.5), z + 0.58)
        scene.ellipsoid(at_pillow, (0.1, 0.22, 0.2), pillow, turned(pitch_deg=-18.0, yaw_deg=12.0 - 24.0 * (k % 2)))


def framed(
    scene: SceneBuilder, at: Vector, normal: str, size: tuple[float, float], picture: str, frame: Finish
) -> None:
    """A framed picture of (width, height) on a wall; ``normal`` (+x, -x, +y, -y) is the way it faces."""
    axis, sign = "xy".index(normal[1]), 1.0 if normal[0] == "+" else -1.0
    image = Finish(material=picture, stretch=size)
    for border, depth, finish in ((0.05, 0.03, frame), (0.0, 0.04, image)):
        full = [size[0] + 2 * border] * 2 + [size[1] + 2 * border]
        full[axis] = depth
        centre = list(at)
        centre[axis] += sign * depth / 2
        scene.box((centre[0], centre[1], centre[2]), (full[0], full[1], full[2]), finish)


def curtain(scene: SceneBuilder, start: Vector, end: Vector, height: float, cloth: Finish) -> None:
    """A curtain in folds from ``start`` to ``end`` (lower corners, along y)."""
    folds = max(2, round(abs(end[1] - start[1]) / 0.075))
    for k in range(folds):
        t = (k + 0.5) / folds
        at = (start[0] + 0.02 * (k % 2), start[1] + t * (end[1] - start[1]), start[2] + height / 2)
        scene.cone(at, (0.045, 0.04), height, cloth)


def floor_lamp(scene: SceneBuilder, at: Vector, metal: Finish, shade: Finish) -> None:
    """A standing lamp, 1.7 m high."""
    x, y, z = at
    scene.cone((x, y, z + 0.015), (0.16, 0.15), 0.03, metal)
    scene.cone((x, y, z + 0.72), (0.018, 0.018), 1.4, metal)
    scene.cone((x, y, z + 1.55), (0.24, 0.15), 0.32, shade)


def potted_plant(scene: SceneBuilder, at: Vector, pot: Finish, leaf: Finish, stem: Finish, rng: Rng) -> None:
    """A bushy plant, about 1.3 m high."""
    x, y, z = at
    scene.cone((x, y, z + 0.18), (0.13, 0.19), 0.36, pot)
    scene.cone((x, y, z + 0.55), (0.025, 0.02), 0.5, stem)
    for k in range(9):
        angle = 2.4 * k
        reach, high = 0.08 + 0.015 * k, z + 1.22 - 0.06 * k
        axes = rng.uniform(0.1, 0.17, 3)
        at_leaf = (x + reach * float(np.cos(angle)), y + reach * float(np.sin(angle)), high)
        tint = float(rng.uniform(0.75, 1.2))
        bush = Finish(material=leaf.material, tint=(tint, tint, tint), shift=(0.13 * k, 0.29 * k))
        scene.ellipsoid(at_leaf, (float(axes[0]), float(axes[1]), float(axes[2])), bush, turned(yaw_deg=40.0 * k))


def mug(scene: SceneBuilder, at: Vector, finish: Finish) -> None:
    """A mug standing on ``at``."""
    scene.cone((at[0], at[1], at[2] + 0.05), (0.036, 0.042), 0.1, finish)


def vase(scene: SceneBuilder, at: Vector, finish: Finish) -> None:
    """A bellied vase standing on ``at``."""
    x, y, z = at
    scene.ellipsoid((x, y, z + 0.12), (0.1, 0.1, 0.12), finish)
    scene.cone((x, y, z + 0.26), (0.035, 0.055), 0.12, finish)

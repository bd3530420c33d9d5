"""The furnished room of ``sim:room``: what stands where, and of which material."""

from vtslam.services.sensor.sources import sim_furniture as furniture
from vtslam.services.sensor.sources import sim_materials as materials
from vtslam.services.sensor.sources import sim_prints as prints
from vtslam.services.sensor.sources._raycast import Scene
from vtslam.services.sensor.sources.sim_materials import Brush
from vtslam.services.sensor.sources.sim_scene import Finish, Light, Material, SceneBuilder, Vector, turned

ROOM_M = (5.0, 4.0, 2.6)
PATH_CENTRE_M = (2.5, 2.0, 1.35)  # the camera's rounds are about this point

_CARTONS: tuple[tuple[Vector, Vector, float], ...] = (  # centre, size, turn in degrees
    ((3.85, 0.4, 0.22), (0.6, 0.5, 0.44), 8.0),
    ((3.8, 0.38, 0.61), (0.46, 0.4, 0.34), -14.0),
    ((4.55, 0.42, 0.29), (0.5, 0.55, 0.58), 20.0),
)


def furnished_room(seed: int, *, num_threads: int) -> Scene:
    """The room for a seed: the same furniture with other grain, books, prints and leaves."""
    brush = Brush(seed, num_threads=num_threads)
    scene = SceneBuilder(_materials(brush))
    _shell(scene)
    _back_wall(scene, brush)
    _front_wall(scene, brush)
    _side_walls(scene, brush)
    _middle(scene, brush)
    scene.light(Light(position=(2.5, 2.0, 2.45), strength=(1.15, 1.08, 0.95), reach_m=2.6))
    scene.light(Light(position=(0.35, 2.0, 1.7), strength=(0.75, 0.85, 1.0), reach_m=2.2))
    scene.light(Light(position=(4.45, 3.5, 1.75), strength=(1.0, 0.78, 0.52), reach_m=1.2))
    return scene.build(ambient=(0.62, 0.62, 0.64), num_threads=num_threads)


def _materials(brush: Brush) -> dict[str, Material]:
    return {
        "planks": materials.planks(brush),
        "brick": materials.brick(brush),
        "oak": materials.wood(brush, "oak", (0.42, 0.26, 0.13), (0.86, 0.66, 0.42)),
        "walnut": materials.wood(brush, "walnut", (0.17, 0.1, 0.06), (0.62, 0.41, 0.25)),
        "warm paper": materials.wallpaper(brush, "warm", (0.9, 0.82, 0.66), (0.62, 0.4, 0.26), (0.4, 0.5, 0.36)),
        "blue paper": materials.wallpaper(brush, "blue", (0.68, 0.76, 0.82), (0.24, 0.36, 0.54), (0.84, 0.8, 0.62)),
        "plaster": materials.plaster(brush, "plaster", (0.62, 0.6, 0.56), (0.98, 0.96, 0.92)),
        "stone": materials.plaster(brush, "stone", (0.25, 0.25, 0.27), (0.75, 0.74, 0.72)),
        "tweed": materials.weave(brush, "tweed", (0.2, 0.28, 0.3), (0.6, 0.68, 0.66), thread=8.0, check=0.12),
        "linen": materials.weave(brush, "linen", (0.55, 0.42, 0.3), (0.98, 0.9, 0.74), thread=6.0),
        "check": materials.weave(brush, "check", (0.5, 0.08, 0.08), (0.98, 0.9, 0.8), thread=5.0, check=0.4),
        "rug": prints.rug(brush),
        "spines": prints.spines(brush),
        "pages": prints.pages(brush),
        "shapes": prints.shapes_poster(brush, "shapes"),
        "news": prints.page_poster(brush, "news", paper=(0.9, 0.88, 0.8), ink=(0.1, 0.1, 0.12), columns=3),
        "landscape": prints.landscape(brush, "landscape"),
        "view": prints.landscape(brush, "view"),
        "map": prints.land_map(brush, "map"),
        "screen": prints.screen(brush),
        "keyboard": prints.keyboard(brush),
        "clock": prints.clock(brush),
        "cardboard": prints.cardboard(brush),
        "leaves": prints.leaves(brush),
    }


def _shell(scene: SceneBuilder) -> None:
    wide, deep, high = ROOM_M
    faces = tuple(Finish(material=m) for m in ("brick", "blue paper", "warm paper", "plaster", "plaster", "planks"))
    scene.room((0.0, 0.0, 0.0), ROOM_M, faces)
    skirting = Finish(material="walnut", tint=(1.2, 1.2, 1.2))
    for y in (0.01, deep - 0.01):
        scene.box((wide / 2, y, 0.05), (wide, 0.02, 0.1), skirting)
    for x in (0.01, wide - 0.01):
        scene.box((x, deep / 2, 0.05), (0.02, deep - 0.04, 0.1), skirting)
    for x in (1.0, 2.5, 4.0):  # beams
        scene.box((x, deep / 2, high - 0.08), (0.14, deep, 0.16), Finish(material="walnut"))


def _back_wall(scene: SceneBuilder, brush: Brush) -> None:
    """The wall at y = 4: bookshelf, cabinet, pictures, lamp."""
    rng, y = brush.rng("back wall"), ROOM_M[1]
    oak, walnut, stone = Finish(material="oak"), Finish(material="walnut"), Finish(material="stone")
    furniture.bookshelf(scene, (1.05, y, 0.0), (1.5, 0.3, 2.05), walnut, rng)
    furniture.cabinet(scene, (2.95, y - 0.03, 0.0), (1.5, 0.45, 0.8), oak, walnut, stone)
    furniture.book_pile(scene, (2.45, y - 0.26, 0.825), 4, rng)
    furniture.vase(scene, (2.95, y - 0.25, 0.825), Finish(material="blue paper"))
    scene.ellipsoid((3.45, y - 0.27, 0.995), (0.15, 0.15, 0.15), Finish(material="map"))
    scene.cone((3.45, y - 0.27, 0.84), (0.08, 0.05), 0.03, walnut)
    furniture.framed(scene, (2.55, y, 1.6), "-y", (0.62, 0.8), "shapes", walnut)
    furniture.framed(scene, (3.4, y, 1.62), "-y", (0.8, 0.6), "landscape", oak)
    lamp_shade = Finish(material="linen", glow=0.75)
    furniture.floor_lamp(scene, (4.45, y - 0.42, 0.0), stone, lamp_shade)


def _front_wall(scene: SceneBuilder, brush: Brush) -> None:
    """The wall at y = 0: door, desk with screen, boxes."""
    rng = brush.rng("front wall")
    oak, walnut, stone = Finish(material="oak"), Finish(material="walnut"), Finish(material="stone")
    scene.box((0.85, 0.02, 1.02), (0.95, 0.04, 2.04), walnut)
    for cz, tall in ((0.5, 0.75), (1.42, 0.9)):
        for cx in (0.64, 1.06):
            scene.box((cx, 0.045, cz), (0.32, 0.03, tall), oak)
    scene.ellipsoid((1.24, 0.09, 1.0), (0.03, 0.04, 0.03), stone)
    furniture.table(scene, (2.5, 0.38, 0.0), (1.6, 0.7, 0.74), oak, walnut)
    screen = Finish(material="screen", stretch=(0.62, 0.36), glow=0.55)
    scene.box((2.5, 0.25, 1.05), (0.66, 0.03, 0.4), stone)
    scene.box((2.5, 0.262, 1.05), (0.62, 0.02, 0.36), screen)
    scene.box((2.5, 0.22, 0.82), (0.06, 0.03, 0.16), stone)
    scene.cone((2.5, 0.24, 0.746), (0.13, 0.12), 0.012, stone)
    scene.box((2.5, 0.5, 0.75), (0.46, 0.15, 0.02), Finish(material="keyboard", stretch=(0.46, 0.15)))
    furniture.mug(scene, (2.92, 0.5, 0.74), Finish(material="check"))
    furniture.book_pile(scene, (1.95, 0.35, 0.74), 5, rng)
    furniture.chair(scene, (2.35, 0.92, 0.0), -70.0, Finish(material="check"), walnut)
    furniture.framed(scene, (1.72, 0.0, 1.6), "+y", (0.5, 0.68), "news", walnut)
    furniture.framed(scene, (3.35, 0.0, 1.65), "+y", (0.9, 0.72), "map", oak)
    for k, (centre, size, yaw_deg) in enumerate(_CARTONS):
        scene.box(centre, size, Finish(material="cardboard", shift=(0.3 * k, 0.4 * k)), turned(yaw_deg=yaw_deg))


def _side_walls(scene: SceneBuilder, brush: Brush) -> None:
    """The walls at x = 5 (sofa) and x = 0 (window)."""
    rng, wide = brush.rng("side walls"), ROOM_M[0]
    oak, walnut = Finish(material="oak"), Finish(material="walnut")
    pillows = (Finish(material="check"), Finish(material="shapes", stretch=(0.5, 0.5)), Finish(material="linen"))
    furniture.sofa(scene, (wide - 0.03, 1.95, 0.0), (0.85, 1.9, 0.8), Finish(material="tweed"), pillows)
    furniture.framed(scene, (wide, 1.95, 1.62), "-x", (1.1, 0.72), "landscape", walnut)
    scene.cone((wide - 0.02, 3.1, 1.75), (0.17, 0.17), 0.04, _clock(), turned(pitch_deg=-90.0))
    # The window: a bright view behind bars, curtains at both sides, a heater below.
    scene.box((0.015, 2.0, 1.55), (0.03, 1.3, 1.2), Finish(material="view", stretch=(1.3, 1.2), glow=0.3))
    for y in (1.33, 2.0, 2.67):
        scene.box((0.03, y, 1.55), (0.06, 0.05, 1.3), oak)
    for z in (0.93, 1.55, 2.17):
        scene.box((0.03, 2.0, z), (0.056, 1.39, 0.05), oak)
    cloth = Finish(material="check", tint=(0.9, 0.95, 1.0))
    furniture.curtain(scene, (0.1, 0.85, 0.12), (0.1, 1.3, 0.12), 2.2, cloth)
    furniture.curtain(scene, (0.1, 2.7, 0.12), (0.1, 3.15, 0.12), 2.2, cloth)
    scene.cone((0.1, 2.0, 2.34), (0.018, 0.018), 2.6, walnut, turned(roll_deg=90.0))
    for k in range(12):
        scene.box(
            (0.1, 1.48 + 0.095 * k, 0.48),
            (0.09, 0.07, 0.6),
            Finish(material="plaster", tint=(0.75, 0.75, 0.72), shift=(0.1 * k, 0.3)),
        )
    furniture.potted_plant(scene, (0.45, 3.4, 0.0), Finish(material="brick"), Finish(material="leaves"), walnut, rng)
    furniture.chair(scene, (0.62, 0.62, 0.0), 45.0, Finish(material="linen"), oak)
    furniture.book_pile(scene, (0.62, 0.62, 0.48), 2, rng)


def _clock() -> tuple[Finish, ...]:
    return Finish(material="walnut"), Finish(material="clock", stretch=(0.34, 0.34)), Finish(material="walnut")


def _middle(scene: SceneBuilder, brush: Brush) -> None:
    rng = brush.rng("middle")
    oak, walnut = Finish(material="oak"), Finish(material="walnut")
    scene.box((2.55, 2.0, 0.006), (2.6, 1.7, 0.012), Finish(material="rug", stretch=(2.6, 1.7)), turned(yaw_deg=6.0))
    furniture.table(scene, (2.6, 2.0, 0.012), (1.0, 0.56, 0.42), oak, walnut)
    furniture.book_pile(scene, (2.35, 2.05, 0.432), 3, rng)
    furniture.mug(scene, (2.62, 1.9, 0.432), Finish(material="shapes"))
    furniture.vase(scene, (2.88, 2.08, 0.432), Finish(material="stone", tint=(1.3, 0.8, 0.6)))
    scene.cone((3.45, 3.0, 0.21), (0.26, 0.24), 0.42, Finish(material="tweed", tint=(1.4, 0.9, 0.7)))
    furniture.chair(scene, (1.25, 2.55, 0.0), 20.0, Finish(material="tweed"), walnut)

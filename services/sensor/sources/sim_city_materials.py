"""Textures of ``sim:city``: ground, facades, shops, trees, cars and clouds, drawn from a seed."""

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources.sim_materials import Brush, Image, blend
from vtslam.services.sensor.sources.sim_scene import Colour

Texels = npt.NDArray[np.uint8]

NUM_FACADES, NUM_SHOPS, NUM_CARS = 12, 6, 4
COLUMNS, FLOORS = 4, 4  # windows across a facade texture, and floors down it

_SIZE = 512
_WALLS: tuple[tuple[Colour, Colour], ...] = (
    ((0.62, 0.58, 0.50), (0.95, 0.92, 0.85)),
    ((0.40, 0.18, 0.13), (0.80, 0.46, 0.34)),
    ((0.48, 0.48, 0.47), (0.82, 0.82, 0.80)),
    ((0.62, 0.45, 0.25), (0.95, 0.82, 0.58)),
    ((0.40, 0.46, 0.52), (0.72, 0.80, 0.86)),
    ((0.50, 0.36, 0.30), (0.88, 0.72, 0.62)),
)
_SIGNS = ("BAKERY", "BOOKS", "CAFE 24", "TAILOR", "HOTEL", "BIKES", "SHOES", "RADIO", "FLOWERS", "OPTICS")


def textures(seed: int, *, num_threads: int) -> dict[str, Texels]:
    """All textures uint8 [h,w,3] by name; the first five in the order the ray caster expects."""
    brush = Brush(seed, num_threads=num_threads)
    out = {
        "stains": _stains(brush),
        "asphalt": _asphalt(brush),
        "paving": _paving(brush),
        "grass": _noisy(brush, "grass", (0.10, 0.17, 0.06), (0.42, 0.52, 0.24)),
        "clouds": _clouds(brush),
        "bark": _noisy(brush, "bark", (0.14, 0.10, 0.07), (0.50, 0.42, 0.34)),
        "metal": _noisy(brush, "metal", (0.30, 0.32, 0.33), (0.56, 0.58, 0.58)),
        "leaves": _leaves(brush, "leaves", (0.05, 0.11, 0.04), (96, 150, 56)),
        "linden": _leaves(brush, "linden", (0.10, 0.12, 0.03), (150, 160, 64)),
        "cabin": _cabin(brush),
        "front": _car_front(brush),
    }
    out |= {f"facade{k}": _facade(brush, k) for k in range(NUM_FACADES)}
    out |= {f"shop{k}": _shop(brush, k) for k in range(NUM_SHOPS)}
    return out | {f"car{k}": _car_side(brush, k) for k in range(NUM_CARS)}


def _texels(image: Image) -> Texels:
    return np.asarray(np.clip(image, 0.0, 1.0) * np.float32(255.0) + np.float32(0.5), np.uint8)


def _noisy(brush: Brush, name: str, dark: Colour, light: Colour) -> Texels:
    """Noise of equal strength at all scales."""
    weight = 0.5 + 0.16 * brush.grain((_SIZE, _SIZE), name) + 0.16 * brush.noise((_SIZE, _SIZE), (4, 4), 5, 0.8, name)
    return _texels(blend(dark, light, weight))


def _stains(brush: Brush) -> Texels:
    weight = 0.5 + 0.20 * brush.noise((_SIZE, _SIZE), (3, 3), 7, 0.75, "stains")
    return _texels(blend((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), weight))


def _clouds(brush: Brush) -> Texels:
    weight = 0.6 * brush.noise((_SIZE, _SIZE), (3, 3), 6, 0.55, "clouds") - 0.05
    return _texels(blend((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), weight))


def _asphalt(brush: Brush) -> Texels:
    """Asphalt with patches, cracks and covers."""
    size, rng = 1024, brush.rng("asphalt")
    weight = (
        0.5 + 0.13 * brush.grain((size, size), "asphalt") + 0.12 * brush.noise((size, size), (4, 4), 6, 0.8, "road")
    )
    image = blend((0.20, 0.20, 0.21), (0.50, 0.49, 0.47), weight)
    for _ in range(9):
        a = rng.integers(20, 760, 2)
        b = a + rng.integers(60, 240, 2)
        image[a[0] : b[0], a[1] : b[1]] *= np.float32(rng.uniform(0.72, 1.25))
    texels = _texels(image)
    for _ in range(16):
        line = np.cumsum(np.concatenate([rng.integers(100, 900, (1, 2)), rng.integers(-26, 27, (24, 2))]), axis=0)
        line = np.clip(line + np.arange(25)[:, None] * rng.integers(-14, 15, 2), 4, size - 5)
        cv2.polylines(texels, [line.astype(np.int32)], False, (38, 38, 40), int(rng.integers(2, 5)), cv2.LINE_AA)
    for _ in range(2):
        at = (int(rng.integers(80, 940)), int(rng.integers(80, 940)))
        cv2.circle(texels, at, 36, (58, 54, 50), -1, cv2.LINE_AA)
        cv2.circle(texels, at, 36, (24, 24, 24), 4, cv2.LINE_AA)
        cv2.circle(texels, at, 20, (96, 92, 86), 5, cv2.LINE_AA)
    return texels


def _paving(brush: Brush) -> Texels:
    """Slabs, 8 x 8 of them, with dark joints."""
    rng = brush.rng("paving")
    cell = np.minimum(np.arange(_SIZE) * 8 // _SIZE, 7)
    tone = rng.uniform(-0.25, 0.25, (8, 8)).astype(np.float32)[cell[:, None], cell[None, :]]
    image = blend((0.36, 0.35, 0.33), (0.72, 0.70, 0.66), 0.5 + tone + 0.12 * brush.grain((_SIZE, _SIZE), "paving"))
    joint = np.arange(_SIZE) % (_SIZE // 8) < 3
    image[joint[:, None] | joint[None, :]] *= np.float32(0.5)
    return _texels(image)


def _leaves(brush: Brush, name: str, ground: Colour, tone: tuple[int, int, int]) -> Texels:
    rng, texels = brush.rng(name), np.full((_SIZE, _SIZE, 3), np.rint(np.array(ground) * 255.0), np.uint8)
    for k in range(900):
        at = (int(rng.integers(0, _SIZE)), int(rng.integers(0, _SIZE)))
        bright = float(rng.uniform(0.35, 1.0)) * (0.5 + 0.5 * k / 900)
        colour = tuple(int(c * bright) for c in tone)
        axes, turn = (int(rng.integers(10, 30)), int(rng.integers(5, 14))), int(rng.integers(0, 180))
        for dx in (-_SIZE, 0, _SIZE):
            cv2.ellipse(texels, (at[0] + dx, at[1]), axes, turn, 0, 360, colour, -1, cv2.LINE_AA)
    return texels


def _wall(brush: Brush, name: str, k: int) -> Image:
    """Plaster, brick courses or panels."""
    dark, light = _WALLS[k % len(_WALLS)]
    size = (_SIZE, _SIZE)
    weight = 0.5 + 0.13 * brush.grain(size, name) + 0.10 * brush.noise(size, (4, 4), 5, 0.8, name + " wall")
    if k % 3 == 1:
        row = np.arange(_SIZE) // 8
        weight = (
            weight + brush.rng(name).uniform(-0.2, 0.2, (64, 32)).astype(np.float32)[row[:, None], row[None, :] // 2]
        )
        weight[np.arange(_SIZE) % 8 == 0] += np.float32(0.25)
    if k % 3 == 2:
        weight[np.arange(_SIZE) % 64 < 2] -= np.float32(0.35)
    return blend(dark, light, weight)


def _facade(brush: Brush, k: int) -> Texels:
    """Four floors of four windows, no two alike."""
    name = f"facade{k}"
    rng, texels = brush.rng(name), _texels(_wall(brush, name, k))
    wide, tall = int(rng.integers(46, 84)), int(rng.integers(60, 88))
    frame = tuple(int(c) for c in rng.integers(30, 240, 3))
    cell_x, cell_y = _SIZE // COLUMNS, _SIZE // FLOORS
    for floor in range(FLOORS):
        if k % 2:
            cv2.rectangle(texels, (0, floor * cell_y), (_SIZE, floor * cell_y + 6), frame, -1)
        for column in range(COLUMNS):
            left = column * cell_x + (cell_x - wide) // 2
            top = floor * cell_y + (cell_y - tall) // 2 + 4
            _window(texels, rng, (left, top, left + wide, top + tall), frame)
    return texels


def _window(texels: Texels, rng: np.random.Generator, box: tuple[int, int, int, int], frame: tuple[int, ...]) -> None:
    left, top, right, bottom = box
    glass = int(rng.integers(22, 90))
    cv2.rectangle(texels, (left - 5, top - 5), (right + 5, bottom + 5), frame, -1)
    cv2.rectangle(texels, (left, top), (right, bottom), (glass, glass + 8, glass + 16), -1)
    kind = rng.random()
    pale = tuple(int(c) for c in rng.integers(150, 240, 3))
    if kind < 0.35:
        cv2.rectangle(texels, (left, top), (right, top + int(rng.integers(10, bottom - top))), pale, -1)
    elif kind < 0.65:
        reach = int(rng.integers(8, (right - left) // 2))
        cv2.rectangle(texels, (left, top), (left + reach, bottom), pale, -1)
        cv2.rectangle(texels, (right - reach, top), (right, bottom), pale, -1)
    middle = (left + right) // 2
    cv2.line(texels, (middle, top), (middle, bottom), frame, 4)
    cv2.line(texels, (left, top + (bottom - top) // 3), (right, top + (bottom - top) // 3), frame, 3)
    cv2.rectangle(texels, (left - 9, bottom + 5), (right + 9, bottom + 10), (210, 208, 200), -1)


def _shop(brush: Brush, k: int) -> Texels:
    """A ground floor: shop windows, doors, signs."""
    name = f"shop{k}"
    rng = brush.rng(name)
    wall = _texels(_wall(brush, name, k + 2))
    texels = np.asarray(cv2.resize(wall, (1024, 256), interpolation=cv2.INTER_LINEAR), np.uint8)
    for part in range(4):
        left = 256 * part
        colour = tuple(int(c) for c in rng.integers(30, 220, 3))
        if part % 2 == k % 2:
            cv2.rectangle(texels, (left + 20, 70), (left + 236, 220), colour, -1)
            cv2.rectangle(texels, (left + 30, 80), (left + 226, 212), (42, 50, 58), -1)
            for _ in range(14):
                at = (left + int(rng.integers(36, 200)), int(rng.integers(100, 190)))
                size = int(rng.integers(6, 24))
                goods = tuple(int(c) for c in rng.integers(60, 240, 3))
                cv2.rectangle(texels, at, (at[0] + size, at[1] + size), goods, -1)
            cv2.rectangle(texels, (left + 20, 16), (left + 236, 62), colour, -1)
            sign = _SIGNS[int(rng.integers(len(_SIGNS)))]
            cv2.putText(texels, sign, (left + 34, 54), cv2.FONT_HERSHEY_DUPLEX, 1.4, (236, 232, 220), 3, cv2.LINE_AA)
        else:
            cv2.rectangle(texels, (left + 28, 50), (left + 104, 255), colour, -1)
            cv2.rectangle(texels, (left + 42, 66), (left + 90, 130), (60, 66, 72), -1)
            _window(texels, rng, (left + 140, 70, left + 220, 170), (90, 84, 78))
    cv2.rectangle(texels, (0, 240), (1024, 255), (92, 88, 82), -1)
    return texels


def _painted(brush: Brush, name: str, size: tuple[int, int]) -> Texels:
    """Pale paint, to be tinted."""
    return _texels(blend((0.62, 0.62, 0.62), (0.94, 0.94, 0.94), 0.5 + 0.12 * brush.noise(size, (2, 2), 5, 0.7, name)))


def _car_side(brush: Brush, k: int) -> Texels:
    """The lower part of a car from the side, 4.3 x 0.75 m: wheels, doors, lights."""
    texels = _painted(brush, f"car{k}", (128, 512))
    for x in (92, 410):
        cv2.circle(texels, (x, 92), 52, (16, 16, 18), -1, cv2.LINE_AA)
        cv2.circle(texels, (x, 92), 27, (168, 170, 172), -1, cv2.LINE_AA)
        for turn in range(5):
            way = np.array([np.cos(1.2566 * turn + k), np.sin(1.2566 * turn + k)]) * 24.0
            cv2.line(texels, (x, 92), (x + int(way[0]), 92 + int(way[1])), (40, 40, 42), 6, cv2.LINE_AA)
    for x in (170 - 6 * k, 268, 352 + 5 * k):
        cv2.line(texels, (x, 6), (x, 104), (40, 40, 42), 3, cv2.LINE_AA)
    cv2.rectangle(texels, (144, 104), (358, 120), (30, 30, 32), -1)
    cv2.rectangle(texels, (2, 22), (34, 48), (236, 228, 190), -1)
    cv2.rectangle(texels, (478, 20), (510, 48), (170, 24, 20), -1)
    return texels


def _cabin(brush: Brush) -> Texels:
    """The windows of a car."""
    texels = _painted(brush, "cabin", (128, 256))
    for left, right in ((14, 118), (134, 242)):
        cv2.rectangle(texels, (left, 18), (right, 118), (34, 42, 48), -1)
        cv2.line(texels, (left + 14, 100), (right - 30, 30), (120, 132, 140), 5, cv2.LINE_AA)
    return texels


def _car_front(brush: Brush) -> Texels:
    """The lower part of a car from ahead or behind."""
    texels = _painted(brush, "front", (128, 256))
    for left, right in ((10, 60), (196, 246)):
        cv2.rectangle(texels, (left, 22), (right, 54), (220, 60, 50), -1)
        cv2.rectangle(texels, (left + 8, 28), (right - 16, 48), (240, 230, 200), -1)
    cv2.rectangle(texels, (84, 62), (172, 86), (235, 235, 225), -1)
    cv2.putText(texels, "VT 2506", (88, 82), cv2.FONT_HERSHEY_DUPLEX, 0.6, (20, 20, 30), 2, cv2.LINE_AA)
    cv2.rectangle(texels, (0, 100), (255, 127), (28, 28, 30), -1)
    return texels

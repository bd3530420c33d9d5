"""Procedural materials of the simulated room: wood, brick, wallpaper, cloth, paper, ... drawn from a seed."""

import zlib

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources._raycast import fractal_noise
from vtslam.services.sensor.sources.sim_scene import Colour, Material

Plane = npt.NDArray[np.float32]
Image = npt.NDArray[np.float32]

TEXEL_M = 0.002


class Brush:
    """Seeded raw material for textures: noise planes float32 [h,w] and random numbers, by name."""

    def __init__(self, seed: int, *, num_threads: int) -> None:
        self._seed = seed
        self._num_threads = num_threads
        self._grain: dict[tuple[int, int], Plane] = {}

    def rng(self, name: str) -> np.random.Generator:
        """Random numbers of their own for each name."""
        return np.random.Generator(np.random.Philox(key=[self._seed, zlib.crc32(name.encode())]))

    def noise(self, size: tuple[int, int], cells: tuple[int, int], octaves: int, gain: float, name: str) -> Plane:
        """Seamless fractal noise: ``cells`` (down, across) in octave 0, deviation about ``0.83 * gain**k``."""
        key = (self._seed * 0x9E3779B1 + zlib.crc32(name.encode())) & 0xFFFFFFFF
        return fractal_noise(*size, *cells, octaves, gain, key, self._num_threads)

    def grain(self, size: tuple[int, int], name: str) -> Plane:
        """Noise in waves of 32 to 4 texels, the shorter the stronger; deviation about 1.3."""
        if size not in self._grain:
            waves = self.noise(size, (size[0] // 16, size[1] // 16), 4, 1.35, f"grain {size}")
            self._grain[size] = np.float32(0.45) * waves
        shift = self.rng(name).integers(0, 1 << 16, 2)
        return np.roll(self._grain[size], (int(shift[0]), int(shift[1])), (0, 1))


def blend(a: Colour, b: Colour, weight: Plane) -> Image:
    """Colour ``a`` where the weight [h,w] is 0, ``b`` where it is 1: float32 [h,w,3]."""
    out = np.empty((*weight.shape, 3), np.float32)
    for channel in range(3):  # in passes over planes: several times faster than over triples
        np.multiply(weight, np.float32(b[channel] - a[channel]), out=out[..., channel])
        out[..., channel] += np.float32(a[channel])
    return out


def material(image: Image, *, width_m: float | None = None, height_m: float | None = None) -> Material:
    """A material of an image with values 0..1; its size follows from ``TEXEL_M`` unless given."""
    texels = (np.clip(image, 0.0, 1.0) * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)
    height, width = texels.shape[:2]
    return Material(texels=texels, width_m=width_m or width * TEXEL_M, height_m=height_m or height * TEXEL_M)


def _grid(size: tuple[int, int]) -> tuple[Plane, Plane]:
    """Row and column coordinates of texel centres, float32 [h,1] and [1,w]."""
    rows, columns = (np.arange(n, dtype=np.float32) + np.float32(0.5) for n in size)
    return rows[:, None], columns[None, :]


def _wave(x: Plane, period: float) -> Plane:
    """A smooth periodic bump, 0 at multiples of the period and 1 halfway between, without trigonometry."""
    t = np.mod(x, np.float32(period)) / np.float32(period)
    s = 4.0 * t * (1.0 - t)
    return np.asarray(s * s * (3.0 - 2.0 * s), np.float32)


def wood(brush: Brush, name: str, dark: Colour, light: Colour, *, contrast: float = 1.0) -> Material:
    """Straight-grained wood, grain along u."""
    size = (512, 512)
    fibres = brush.noise(size, (64, 8), 3, 1.15, name + " fibres")
    rings = _wave(_grid(size)[0] + 9.0 * brush.noise(size, (4, 2), 3, 0.5, name + " rings"), 512.0 / 14.0)
    weight = 0.5 + contrast * (0.15 * fibres + 0.3 * (rings - 0.5) + 0.07 * brush.grain(size, name))
    return material(blend(dark, light, weight))


def planks(brush: Brush) -> Material:
    """A floor of wooden planks along u, 12.8 cm wide, with dark seams."""
    size, rows = (1024, 1024), 16
    rng = brush.rng("planks")
    v, u = _grid(size)
    row = np.broadcast_to((v / (size[0] / rows)).astype(np.intp), size)
    start, tone = rng.uniform(0.0, 512.0, rows), rng.uniform(-0.22, 0.22, (rows, 2))
    along = np.mod(u + start[row].astype(np.float32), np.float32(size[1]))
    board = (along > 560.0).astype(np.intp)
    shade = tone[row, board].astype(np.float32)
    fibres = brush.noise(size, (128, 12), 3, 1.1, "plank fibres")
    rings = _wave(v + 12.0 * brush.noise(size, (8, 3), 3, 0.5, "plank rings"), 32.0)
    weight = 0.5 + shade + 0.1 * fibres + 0.2 * (rings - 0.5) + 0.07 * brush.grain(size, "planks")
    image = blend((0.36, 0.21, 0.11), (0.80, 0.57, 0.34), weight)
    across = np.mod(v, size[0] / rows)
    seam = (np.minimum(across, size[0] / rows - across) < 1.5) | (np.abs(along - 560.0) < 1.5) | (along < 1.5)
    image[seam] *= np.float32(0.45)
    return material(image)


def brick(brush: Brush) -> Material:
    """A brick wall in running bond, bricks of 25.6 x 6.4 cm with pale joints."""
    size, rows, columns = (1024, 1024), 16, 8
    rng = brush.rng("brick")
    v, u = _grid(size)
    row = np.broadcast_to((v / 64.0).astype(np.intp), size)
    shifted = np.mod(u + 64.0 * (row % 2), np.float32(size[1]))
    column = (shifted / 128.0).astype(np.intp)
    wobble = 2.0 * brush.noise(size, (64, 64), 2, 0.7, "brick edge")
    from_v, from_u = np.mod(v, 64.0) + wobble, np.mod(shifted, 128.0) + wobble
    joint = (np.minimum(from_v, 64.0 - from_v) < 4.0) | (np.minimum(from_u, 128.0 - from_u) < 4.0)
    tone = rng.uniform(-0.22, 0.22, (rows, columns)).astype(np.float32)[row, column]
    grain = brush.grain(size, "brick")
    image = blend((0.42, 0.17, 0.12), (0.82, 0.45, 0.33), 0.5 + tone + 0.14 * grain)
    image[joint] = blend((0.5, 0.47, 0.43), (0.85, 0.82, 0.76), 0.5 + 0.14 * grain)[joint]
    return material(image, width_m=2.048, height_m=1.024)


def wallpaper(brush: Brush, name: str, ground: Colour, figure: Colour, leaf: Colour) -> Material:
    """Wallpaper with ogee medallions and leaves on a grained ground, repeat 25.6 x 25.6 cm."""
    size, period = (512, 512), 128.0
    v, u = _grid(size)
    image = blend(ground, figure, 0.19 + 0.28 * brush.grain(size, name) + 0.05 * _wave(u, 16.0))
    for half in (0.0, 0.5):
        y = np.mod(v / period + half, 1.0) - 0.5
        x = np.mod(u / period + half, 1.0) - 0.5
        radius = np.sqrt(x * x * 2.2 + y * y)
        star = np.abs(x * y) * 9.0
        ring = np.clip(1.0 - np.abs(radius + star - 0.3) * 22.0, 0.0, 1.0)
        core = np.clip((0.16 - radius + star * 0.4) * 40.0, 0.0, 1.0)
        stem = np.clip(1.0 - np.abs(np.abs(x) - 0.22 + 0.25 * y * y) * 40.0, 0.0, 1.0)
        for weight, colour in ((ring, figure), (core, leaf), (stem * 0.8, leaf)):
            worn = (weight * (0.85 + 0.2 * brush.grain(size, name + " wear")))[..., None]
            image += worn * (np.array(colour, np.float32) - image)
    return material(image)


def plaster(brush: Brush, name: str, dark: Colour, light: Colour) -> Material:
    """Rough plaster or stone: noise of equal strength at all scales."""
    size = (512, 512)
    weight = 0.5 + 0.22 * brush.grain(size, name) + 0.05 * brush.noise(size, (3, 3), 3, 0.8, name + " stains")
    return material(blend(dark, light, weight))


def weave(brush: Brush, name: str, dark: Colour, light: Colour, *, thread: float, check: float = 0.0) -> Material:
    """Cloth: threads of ``thread`` texels over and under, with a check pattern of the given strength."""
    size = (512, 512)
    v, u = _grid(size)
    over = (np.mod(u / thread, 2.0).astype(np.intp) + np.mod(v / thread, 2.0).astype(np.intp)) % 2
    threads = np.where(over == 1, _wave(u, thread), _wave(v, thread)) - 0.5
    bands = (np.mod(u / 64.0, 2.0) < 1.0).astype(np.float32) + (np.mod(v / 64.0, 2.0) < 1.0) - 1.0
    weight = 0.5 + 0.22 * threads + check * bands + 0.13 * brush.grain(size, name)
    return material(blend(dark, light, weight))

"""Printed and drawn things of the simulated room: posters, rug, book spines, screen, keyboard, clock, window view."""

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources.sim_materials import Brush, Image, blend, material
from vtslam.services.sensor.sources.sim_scene import Colour, Material

_LETTERS = "the quick brown fox jumps over a lazy dog while two grey geese watch from beyond mossy stones"


def _canvas(size: tuple[int, int], colour: Colour) -> npt.NDArray[np.uint8]:
    return np.full((*size, 3), np.rint(np.array(colour) * 255.0), np.uint8)


def _colour(rng: np.random.Generator, low: int = 20, high: int = 240) -> tuple[int, int, int]:
    r, g, b = (int(c) for c in rng.integers(low, high, 3))
    return r, g, b


def _printed(
    brush: Brush, drawing: npt.NDArray[np.uint8], name: str, strength: float = 0.05, *, contrast: float = 1.0
) -> Image:
    """A drawing as float image with the grain of its paper; ``contrast`` below 1 fades it towards grey."""
    grain = brush.grain((drawing.shape[0], drawing.shape[1]), name)
    scale, offset = np.float32(contrast / 255.0), np.float32(0.5 * (1.0 - contrast))
    return np.asarray(drawing.astype(np.float32) * scale + offset + strength * grain[..., None], np.float32)


def shapes_poster(brush: Brush, name: str) -> Material:
    """Overlapping discs, bars and rings in many colours."""
    rng, size = brush.rng(name), 512
    image = _canvas((size, size), (0.86, 0.82, 0.72))
    for k in range(150):
        at = (int(rng.integers(0, size)), int(rng.integers(0, size)))
        reach = int(rng.integers(8, 70 - k // 3))
        if k % 3 == 0:
            cv2.circle(image, at, reach, _colour(rng), -1, cv2.LINE_AA)
        elif k % 3 == 1:
            cv2.circle(image, at, reach, _colour(rng), int(rng.integers(2, 8)), cv2.LINE_AA)
        else:
            end = (at[0] + int(rng.integers(-90, 90)), at[1] + int(rng.integers(-90, 90)))
            cv2.line(image, at, end, _colour(rng), int(rng.integers(2, 12)), cv2.LINE_AA)
    return material(_printed(brush, image, name, contrast=0.68))


def page_poster(brush: Brush, name: str, *, paper: Colour, ink: Colour, columns: int = 2) -> Material:
    """Columns of small print under a headline, with pictures."""
    rng, size = brush.rng(name), 512
    image = _canvas((size, size), paper)
    pen = tuple(int(255 * c) for c in ink)
    cv2.putText(image, "ATLAS No " + str(rng.integers(10, 99)), (24, 56), cv2.FONT_HERSHEY_TRIPLEX, 1.5, pen, 3)
    wide = (size - 32) // columns
    for column in range(columns):
        x, y = 20 + column * wide, 86
        while y < size - 16:
            if rng.random() < 0.09 and y < size - 120:
                cv2.rectangle(image, (x, y - 6), (x + wide - 20, y + 74), _colour(rng), -1)
                for _ in range(9):
                    at = (x + int(rng.integers(12, wide - 30)), y + int(rng.integers(4, 64)))
                    cv2.circle(image, at, int(rng.integers(3, 12)), _colour(rng), -1, cv2.LINE_AA)
                y += 92
                continue
            first = int(rng.integers(0, 40))
            text = _LETTERS[first : first + wide // 10]
            cv2.putText(image, text, (x, y + 6), cv2.FONT_HERSHEY_DUPLEX, 0.45, pen, 1, cv2.LINE_AA)
            y += 15
    return material(_printed(brush, image, name, contrast=0.6))


def landscape(brush: Brush, name: str) -> Material:
    """Hills in the evening, a lake and a sun: a painting in visible strokes."""
    size = (512, 512)
    strokes = brush.noise(size, (64, 16), 3, 1.0, name + " strokes")
    v = np.linspace(0.0, 1.0, size[0], dtype=np.float32)[:, None] * np.ones((1, size[1]), np.float32)
    u = np.linspace(0.0, 1.0, size[1], dtype=np.float32)[None, :]
    image = blend((0.35, 0.5, 0.78), (0.98, 0.72, 0.45), v * 1.7 + 0.08 * strokes)
    sun = (u - 0.68) ** 2 + (v - 0.33) ** 2
    image[sun < 0.006] = (0.99, 0.93, 0.7)
    ridges = (
        (0.42, 0.16, (0.36, 0.38, 0.55), (0.5, 0.5, 0.66)),
        (0.55, 0.12, (0.2, 0.32, 0.3), (0.4, 0.5, 0.4)),
        (0.68, 0.07, (0.1, 0.22, 0.12), (0.38, 0.46, 0.18)),
    )
    for k, (height, swing, dark, light) in enumerate(ridges):
        line = height + 0.5 * swing * brush.noise(size, (1, 3 + k), 5, 0.55, f"{name} ridge {k}")[:1]
        image = np.where((v > line)[..., None], blend(dark, light, 0.5 + 0.17 * strokes), image)
    water = blend((0.2, 0.36, 0.5), (0.75, 0.68, 0.6), 0.4 + 0.2 * brush.noise(size, (128, 8), 3, 1.0, name + " water"))
    image = np.where((v > 0.84)[..., None], water, image)
    return material(np.asarray(image + 0.02 * strokes[..., None], np.float32))


def land_map(brush: Brush, name: str) -> Material:
    """A map: coasts, height steps, rivers of contour lines, a grid and names."""
    size = (512, 512)
    rng = brush.rng(name)
    height = brush.noise(size, (2, 2), 7, 0.6, name)
    steps = np.floor(height * 4.0) / 4.0
    land = blend((0.55, 0.68, 0.36), (0.84, 0.66, 0.42), np.clip(steps * 0.6, 0.0, 1.0))
    image = np.where((height > 0.0)[..., None], land, blend((0.3, 0.5, 0.68), (0.62, 0.8, 0.88), 1.0 + 0.6 * steps))
    contour = np.abs(height * 8.0 - np.rint(height * 8.0)) < 0.06
    image[contour] *= np.float32(0.55)
    drawing = (np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    for line in range(0, 512, 64):
        cv2.line(drawing, (line, 0), (line, 511), (70, 70, 90), 1)
        cv2.line(drawing, (0, line), (511, line), (70, 70, 90), 1)
    for _ in range(26):
        at = (int(rng.integers(0, 440)), int(rng.integers(20, 500)))
        first = int(rng.integers(0, 60))
        cv2.putText(drawing, _LETTERS[first : first + 7].title(), at, cv2.FONT_HERSHEY_DUPLEX, 0.5, (25, 20, 30), 1)
        cv2.circle(drawing, (at[0] - 5, at[1] - 4), 3, (190, 30, 30), -1, cv2.LINE_AA)
    return material(_printed(brush, drawing, name))


def rug(brush: Brush) -> Material:
    """A knotted rug with borders, a lattice of stars and a medallion; covers its texture once."""
    size = (512, 1024)
    v, u = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32) + np.float32(0.5)
    edge = np.minimum(np.minimum(v, size[0] - v), np.minimum(u, size[1] - u))
    cell_u, cell_v = np.abs(np.mod(u, 64.0) - 32.0), np.abs(np.mod(v, 64.0) - 32.0)
    star = np.minimum(cell_u + cell_v, 1.4 * np.maximum(cell_u, cell_v))
    red, navy, cream, gold = (0.56, 0.2, 0.18), (0.2, 0.22, 0.36), (0.76, 0.68, 0.54), (0.66, 0.5, 0.26)
    image = np.broadcast_to(np.array(red, np.float32), (*size, 3)).copy()
    for low, high, colour in ((0.0, 10.0, gold), (10, 16, navy), (20, 26, cream), (8, 9, navy)):
        image[(star >= low) & (star < high)] = colour
    du, dv = np.abs(u - 512.0) / 300.0, np.abs(v - 256.0) / 170.0
    inside = du + dv + 0.08 * (star / 32.0)
    for low, high, colour in ((0.0, 0.22, cream), (0.22, 0.3, navy), (0.55, 0.6, cream), (0.6, 0.66, navy)):
        image[(inside >= low) & (inside < high)] = colour
    for low, high, colour in ((0, 8, cream), (8, 20, navy), (52, 58, gold), (58, 62, navy), (62, 66, cream)):
        image[(edge >= low) & (edge < high)] = colour
    band = (edge >= 20) & (edge < 52)
    zigzag = np.abs(np.mod(u + v, 48.0) - 24.0) + np.abs(np.mod(u - v, 48.0) - 24.0)
    image[band] = np.where(zigzag[band][:, None] > 24.0, np.array(navy), np.array(gold))
    knots = 0.05 * (np.mod(np.floor(u / 3.0) + np.floor(v / 3.0), 2.0) - 0.5)
    return material(image * (0.92 + 0.2 * brush.grain(size, "rug")[..., None]) + knots[..., None])


def spines(brush: Brush) -> Material:
    """Book cloth with titles and bands, to be tinted; a book shows a strip of it."""
    rng, size = brush.rng("spines"), 512
    image = _canvas((size, size), (0.78, 0.78, 0.78))
    for x in range(0, size, 16):
        for _ in range(3):
            y, tall = int(rng.integers(0, size)), int(rng.integers(4, 26))
            tone = int(rng.choice([90, 130, 215, 235]))
            cv2.rectangle(image, (x, y), (x + 15, y + tall), (tone, tone, tone), -1)
        for y in range(int(rng.integers(0, 30)), size, 11):
            if rng.random() < 0.4:
                tone = int(rng.choice([60, 100, 240]))
                cv2.line(image, (x + 3, y), (x + 12, y + int(rng.integers(0, 6))), (tone, tone, tone), 2)
    return material(_printed(brush, image, "spines", 0.05, contrast=0.5))


def pages(brush: Brush) -> Material:
    """The edges of a book's pages: fine lines along u."""
    size = (512, 512)
    lines = brush.noise(size, (128, 4), 2, 1.0, "pages")
    return material(
        blend((0.66, 0.58, 0.44), (0.96, 0.93, 0.84), 0.5 + 0.25 * lines + 0.05 * brush.grain(size, "pages"))
    )


def screen(brush: Brush) -> Material:
    """A screen full of indented coloured text lines; covers its texture once."""
    rng, size = brush.rng("screen"), (256, 512)
    image = _canvas(size, (0.08, 0.1, 0.15))
    cv2.rectangle(image, (0, 0), (90, 255), (34, 40, 56), -1)
    hues = ((220, 180, 90), (120, 200, 140), (130, 170, 240), (220, 220, 220), (220, 120, 130))
    for y in range(8, 252, 7):
        x = 100 + 14 * int(rng.integers(0, 5))
        while x < 480 and rng.random() < 0.85:
            wide = int(rng.integers(8, 60))
            cv2.line(image, (x, y), (min(x + wide, 500), y), hues[int(rng.integers(0, 5))], 3)
            x += wide + 7
        cv2.line(image, (8, y), (8 + int(rng.integers(15, 70)), y), (140, 150, 170), 3)
    return material(_printed(brush, image, "screen", 0.02, contrast=0.55))


def keyboard(brush: Brush) -> Material:
    """Rows of keys; covers its texture once."""
    rng, size = brush.rng("keyboard"), (128, 512)
    image = _canvas(size, (0.12, 0.12, 0.13))
    for row in range(5):
        x = 8 + 4 * row
        while x < 490:
            wide = 22 if rng.random() < 0.85 else 44
            cv2.rectangle(image, (x, 8 + 23 * row), (min(x + wide, 504), 26 + 23 * row), (196, 196, 190), -1)
            cv2.circle(image, (x + 8, 15 + 23 * row), 3, (40, 40, 40), -1)
            x += wide + 5
    return material(_printed(brush, image, "keyboard", 0.04, contrast=0.7))


def clock(brush: Brush) -> Material:
    """A clock face; covers its texture once."""
    image = _canvas((256, 256), (0.93, 0.91, 0.84))
    cv2.circle(image, (128, 128), 120, (40, 40, 50), 8, cv2.LINE_AA)
    for k in range(60):
        angle = k * np.pi / 30.0
        reach = 92 if k % 5 == 0 else 104
        way = np.array([np.sin(angle), -np.cos(angle)])
        a, b = ((128 + r * way).round().astype(int).tolist() for r in (reach, 112))
        cv2.line(image, a, b, (30, 30, 40), 6 if k % 5 == 0 else 2, cv2.LINE_AA)
    cv2.line(image, (128, 128), (84, 92), (20, 20, 30), 9, cv2.LINE_AA)
    cv2.line(image, (128, 128), (176, 66), (20, 20, 30), 5, cv2.LINE_AA)
    return material(_printed(brush, image, "clock", 0.04, contrast=0.8))


def cardboard(brush: Brush) -> Material:
    """Corrugated board with printed signs and a strip of tape."""
    rng, size = brush.rng("cardboard"), 512
    base = blend((0.52, 0.38, 0.22), (0.78, 0.6, 0.4), 0.5 + 0.2 * brush.grain((size, size), "cardboard"))
    drawing = (np.clip(base, 0.0, 1.0) * 255.0).astype(np.uint8)
    for k in range(12):
        at = (int(rng.integers(0, 420)), int(rng.integers(30, 490)))
        if k % 3 == 0:
            cv2.rectangle(drawing, at, (at[0] + 84, at[1] + 48), (232, 230, 220), -1)
            for y in range(at[1] + 8, at[1] + 44, 7):
                cv2.line(drawing, (at[0] + 6, y), (at[0] + int(rng.integers(30, 78)), y), (40, 40, 40), 2)
        else:
            cv2.putText(drawing, f"BOX {rng.integers(10, 99)}", at, cv2.FONT_HERSHEY_TRIPLEX, 0.9, (70, 40, 24), 2)
    cv2.rectangle(drawing, (240, 0), (270, 511), (196, 170, 120), -1)
    return material(_printed(brush, drawing, "board", 0.03))


def leaves(brush: Brush) -> Material:
    """Dense foliage."""
    rng, size = brush.rng("leaves"), 256
    image = _canvas((size, size), (0.07, 0.16, 0.06))
    for _ in range(420):
        at = (int(rng.integers(0, size)), int(rng.integers(0, size)))
        axes = (int(rng.integers(8, 20)), int(rng.integers(3, 7)))
        turn, tone = int(rng.integers(0, 180)), float(rng.uniform(0.4, 1.0))
        colour = (int(110 * tone), int(190 * tone), int(70 * tone))
        for dx in (-size, 0, size):
            cv2.ellipse(image, (at[0] + dx, at[1]), axes, turn, 0, 360, colour, -1, cv2.LINE_AA)
            cv2.ellipse(image, (at[0] + dx, at[1]), (axes[0], 0), turn, 0, 360, (40, 90, 30), 1, cv2.LINE_AA)
    return material(_printed(brush, image, "leaves", 0.05))

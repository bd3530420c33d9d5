"""Houses, trees, lamps and parked cars of ``sim:city``, set along its streets and clear of where the car drives."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from vtslam.services.sensor.sources.sim_city_bodies import BOX, CYLINDER, ELLIPSOID, Body, Cover
from vtslam.services.sensor.sources.sim_city_materials import COLUMNS, FLOORS, NUM_CARS, NUM_FACADES, NUM_SHOPS
from vtslam.services.sensor.sources.sim_city_path import Points
from vtslam.services.sensor.sources.sim_city_streets import PointGrid, resampled

_FOOT_M, _FLOOR_M = 3.5, 3.0
_HOUSE_CLEAR_M, _CAR_CLEAR_M, _TREE_CLEAR_M = 7.0, 1.8, 3.0  # from the driven path and all middle lines
_PARKED_M, _TREES_M = 4.55, 7.3  # beside the middle line
_CAR_M = (4.3, 1.76)
_RETRY_M = 3.0
_PAINTS = ((0.75, 0.12, 0.10), (0.16, 0.26, 0.55), (0.92, 0.92, 0.92), (0.22, 0.23, 0.25), (0.62, 0.64, 0.66),
           (0.16, 0.38, 0.26), (0.85, 0.68, 0.20))  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Row:
    """A row of houses along a street: distance of their fronts from its middle line, widths, floors, gaps (m)."""

    setback: tuple[float, float]
    width: tuple[float, float]
    depth: tuple[float, float]
    floors: tuple[int, int]
    gap: tuple[float, float]
    open_share: float


_ROWS = (
    _Row(setback=(9.6, 11.6), width=(8.0, 17.0), depth=(8.0, 11.0), floors=(1, 5), gap=(1.5, 7.0), open_share=0.35),
    _Row(setback=(27.0, 38.0), width=(16.0, 30.0), depth=(10.0, 15.0), floors=(4, 9), gap=(4.0, 18.0), open_share=0.8),
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Place:
    """A rectangle on the ground: middle, unit direction of its width, half width and half depth (m)."""

    middle: tuple[float, float]
    way: tuple[float, float]
    half: tuple[float, float]

    def away_m(self, points: Points) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Distances [N] of points [N,2] from it; 0 inside."""
        d = points - np.array(self.middle)
        along, across = d @ np.array(self.way), d @ np.array((-self.way[1], self.way[0]))
        outside = np.maximum(np.abs(np.stack([along, across], axis=1)) - np.array(self.half), 0.0)
        return np.asarray(np.hypot(outside[:, 0], outside[:, 1]))

    def corners(self) -> Points:
        """Its corners [4,2]."""
        way, across = np.array(self.way), np.array((-self.way[1], self.way[0]))
        signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
        return np.array([np.array(self.middle) + a * self.half[0] * way + b * self.half[1] * across for a, b in signs])

    def meets(self, other: "_Place") -> bool:
        """Whether the rectangles overlap: no side of either separates them."""
        for own, its in ((self, other), (other, self)):
            d = its.corners() - np.array(own.middle)
            for k, axis in enumerate((own.way, (-own.way[1], own.way[0]))):
                reach = d @ np.array(axis)
                if reach.min() > own.half[k] or reach.max() < -own.half[k]:
                    return False
        return True


@dataclass(slots=True, kw_only=True, eq=False)
class _Site:
    """What is taken: middle lines and the driven path as points, and the rectangles of what stands already."""

    lines: PointGrid = field(default_factory=lambda: PointGrid(16.0))
    grid: PointGrid = field(default_factory=lambda: PointGrid(32.0))
    taken: list[_Place] = field(default_factory=list)

    def free(self, place: _Place, clear_m: float) -> bool:
        """Whether a rectangle is clear of all lines and of everything that stands."""
        x, z = place.middle
        radius = float(np.hypot(*place.half))
        near = self.lines.around(x, z, radius + clear_m)
        if near and place.away_m(np.array(near)[:, :2]).min() < clear_m:
            return False
        return not any(place.meets(self.taken[int(number)]) for _, _, number in self.grid.around(x, z, radius + 20.0))

    def take(self, place: _Place) -> None:
        """Put a rectangle in."""
        self.grid.add(*place.middle, len(self.taken))
        self.taken.append(place)


def town_bodies(streets: list[Points], driven: Points, *, seed: int) -> list[Body]:
    """All that stands along the streets (middle lines [K,2]); ``driven`` [F,2] is kept free too."""
    site = _Site()
    lines = [resampled(street) for street in streets if len(street) > 1]
    for line in (*lines, resampled(driven)):
        for x, z in line.tolist():
            site.lines.add(x, z, 0.0)
    out: list[Body] = []
    for what in (_houses, _parked_cars, _trees_and_lamps):
        rng = np.random.Generator(np.random.Philox(key=[seed, zlib.crc32(what.__name__.encode())]))
        for line in lines:
            out += what(line, site, rng)
    return out


def _beside(line: Points, at_m: float, beside_m: float, half: tuple[float, float]) -> _Place:
    """A rectangle along the line at a length, its middle to the right (m) of it; the line has a point every metre."""
    row = min(int(at_m), len(line) - 2)
    step = line[min(row + 2, len(line) - 1)] - line[max(row - 1, 0)]
    way = step / np.hypot(*step)
    middle = line[row] + (at_m - row) * way + beside_m * np.array((way[1], -way[0]))
    return _Place(middle=(float(middle[0]), float(middle[1])), way=(float(way[0]), float(way[1])), half=half)


def _houses(line: Points, site: _Site, rng: np.random.Generator) -> Iterator[Body]:
    for row in _ROWS:
        for side in (1.0, -1.0):
            at_m = float(rng.uniform(0.0, 4.0))
            while at_m < len(line) - 1:
                width, depth = float(rng.uniform(*row.width)), float(rng.uniform(*row.depth))
                setback, floors = float(rng.uniform(*row.setback)), int(rng.integers(*row.floors, endpoint=True))
                half = (0.5 * width, 0.5 * depth)
                place = _beside(line, at_m + half[0], side * (setback + half[1]), half)
                look = rng.integers(0, 1 << 30, 4).tolist()
                if not site.free(place, _HOUSE_CLEAR_M):
                    at_m += _RETRY_M
                    continue
                site.take(place)
                yield _house(place, floors, look)
                at_m += width + (float(rng.uniform(*row.gap)) if rng.random() < row.open_share else 0.02)


def _house(place: _Place, floors: int, look: list[int]) -> Body:
    def columns_m(width_m: float) -> float:
        """Width of a window's column: an even number of them across the face, so that no window is cut."""
        return width_m / (2 * max(round(width_m / 6.0), 1))

    facade, shop = f"facade{look[0] % NUM_FACADES}", f"shop{look[1] % NUM_SHOPS}"
    tall = FLOORS * _FLOOR_M
    tone = 0.72 + 0.28 * (look[2] % 97) / 96.0
    return Body(
        kind=BOX, place=(*place.middle, *place.way, *place.half, 0.0, _FOOT_M + floors * _FLOOR_M),
        side=Cover(facade, COLUMNS * columns_m(2 * place.half[0]), tall),
        end=Cover(facade, COLUMNS * columns_m(2 * place.half[1]), tall),
        foot=Cover(shop, 13.0, _FOOT_M), foot_m=_FOOT_M,
        tint=(tone, tone * (0.92 + 0.08 * (look[3] % 31) / 30.0), tone * (0.84 + 0.16 * (look[3] % 53) / 52.0)),
        shift=float(look[3] % 1000),
    )  # fmt: skip


def _parked_cars(line: Points, site: _Site, rng: np.random.Generator) -> Iterator[Body]:
    half = (0.5 * _CAR_M[0], 0.5 * _CAR_M[1])
    for side in (1.0, -1.0):
        at_m = float(rng.uniform(0.0, 12.0))
        while at_m < len(line) - 6:
            place = _beside(line, at_m, side * (_PARKED_M + float(rng.uniform(-0.15, 0.15))), half)
            look = int(rng.integers(0, 1 << 30))
            if site.free(place, _CAR_CLEAR_M):
                site.take(place)
                yield from car(place.middle, place.way, look)
            at_m += float(rng.uniform(5.3, 21.0))


def car(middle: tuple[float, float], way: tuple[float, float], look: int) -> list[Body]:
    """A car of two boxes that points along ``way`` (unit vector); ``look`` chooses its paint and shape."""
    tint = _PAINTS[look % len(_PAINTS)]
    long, wide = 0.5 * _CAR_M[0], 0.5 * _CAR_M[1]
    low, high = 0.84 + 0.10 * (look // 7 % 5) / 4, 1.36 + 0.3 * (look // 35 % 7) / 6
    back = -0.25 + 0.3 * (look // 245 % 3) / 2
    cabin = (middle[0] + back * way[0], middle[1] + back * way[1])
    side, end = Cover(f"car{look % NUM_CARS}", 2 * long, low - 0.12), Cover("front", 2 * wide, low - 0.12)
    glass, glass_end = Cover("cabin", 2.3, high - low), Cover("cabin", 2 * wide, high - low)
    shift = float(look % 1009)
    lower, upper = (*middle, *way, long, wide, 0.12, low), (*cabin, *way, 1.15, wide - 0.09, low, high)
    return [
        Body(kind=BOX, place=lower, side=side, end=end, foot=end, tint=tint, shift=shift),
        Body(kind=BOX, place=upper, side=glass, end=glass_end, foot=end, tint=tint, shift=shift),
    ]


def _trees_and_lamps(line: Points, site: _Site, rng: np.random.Generator) -> Iterator[Body]:
    for side in (1.0, -1.0):
        at_m = float(rng.uniform(0.0, 9.0))
        while at_m < len(line) - 1:
            place = _beside(line, at_m, side * (_TREES_M + float(rng.uniform(-0.3, 0.3))), (0.35, 0.35))
            lamp, look = rng.random() < 0.3, rng.random(8).tolist()
            if site.free(place, _TREE_CLEAR_M):
                site.take(place)
                yield from _lamp(place.middle, side, place.way) if lamp else _tree(place.middle, look)
            at_m += float(rng.uniform(7.0, 17.0))


def _round(
    kind: int, at: tuple[float, float], radius: float, low: float, high: float, cover: Cover, tone: float = 1.0
) -> Body:
    place = (*at, 1.0, 0.0, radius, radius, low, high)
    return Body(kind=kind, place=place, side=cover, end=cover, foot=cover, tint=(tone, tone, tone), shift=at[0] + at[1])


def _tree(at: tuple[float, float], look: list[float]) -> Iterator[Body]:
    trunk_m, radius = 2.1 + 1.2 * look[0], 1.3 + 0.8 * look[1]
    yield _round(CYLINDER, at, 0.13 + 0.12 * look[2], 0.0, trunk_m + 0.6, Cover("bark", 0.9, 1.3))
    crown = Cover("leaves" if look[3] < 0.6 else "linden", 2.6, 2.6)
    for k in range(3):
        x, z = at[0] + 0.9 * (look[4] - 0.5) * (k - 1), at[1] + 0.9 * (look[5] - 0.5) * (k - 1)
        low = trunk_m - 0.3 + 0.9 * k * (0.6 + 0.4 * look[6])
        size = radius * (1.0 - 0.18 * k)
        yield _round(ELLIPSOID, (x, z), size, low, low + 1.9 * size, crown, 0.8 + 0.4 * look[7])


def _lamp(at: tuple[float, float], side: float, way: tuple[float, float]) -> Iterator[Body]:
    metal = Cover("metal", 0.6, 0.8)
    yield _round(CYLINDER, at, 0.09, 0.0, 5.6, metal)
    reach = -side * 0.8
    head = (at[0] + reach * way[1], at[1] - reach * way[0])
    yield Body(
        kind=BOX, place=(*head, -way[1], way[0], 0.9, 0.12, 5.5, 5.7), side=metal, end=metal, foot=metal, shift=at[0]
    )

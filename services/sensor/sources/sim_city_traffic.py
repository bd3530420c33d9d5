"""Oncoming cars of ``sim:city``."""

import zlib

import numpy as np

from vtslam.services.sensor.sources.sim_city_bodies import Body
from vtslam.services.sensor.sources.sim_city_layout import car
from vtslam.services.sensor.sources.sim_city_path import CRUISE_M, Path

_BESIDE_M = 2.45  # to the left of the path
_IN_SIGHT_M = 120.0  # along the path
_KEY, _MASK = zlib.crc32(b"traffic"), 2**64 - 1  # car numbers may be negative, counters not


class Traffic:
    """Cars that come along the path from ahead, evenly but for some metres.

    Args:
        path: Where the camera drives.
        per_km: Cars per kilometre; 0 for none.
        seed: Of their looks and distances.
    """

    def __init__(self, path: Path, *, per_km: int, seed: int) -> None:
        self._path, self._driven_m = path, path.driven_m()
        self._spacing_m = 1000.0 / per_km if per_km else 0.0
        self._seed = seed

    def cars(self, frame: int) -> list[Body]:
        """The cars near the camera of a frame."""
        if not self._spacing_m:
            return []
        here_m, driven_m = float(self._driven_m[frame]), CRUISE_M * frame
        first = int((here_m - _IN_SIGHT_M + driven_m) // self._spacing_m)
        last = int((here_m + _IN_SIGHT_M + driven_m) // self._spacing_m)
        return [body for number in range(first, last + 1) for body in self._car(number, driven_m)]

    def _car(self, number: int, driven_m: float) -> list[Body]:
        rng = np.random.Generator(np.random.Philox(key=[self._seed, _KEY], counter=number & _MASK))
        at_m = (number + float(rng.uniform(0.0, 0.8))) * self._spacing_m - driven_m
        if not 0.0 < at_m < self._driven_m[-1]:
            return []
        x, z, heading = (
            float(np.interp(at_m, self._driven_m, values)) for values in (*self._path.places_m.T, self._path.headings)
        )
        way = (float(np.sin(heading)), float(np.cos(heading)))
        middle = (x - _BESIDE_M * way[1], z + _BESIDE_M * way[0])
        return car(middle, (-way[0], -way[1]), int(rng.integers(0, 1 << 30)))

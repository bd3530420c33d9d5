"""Where things with an extent are: balls in cells of a grid as coarse as they are large."""

import math
from collections import defaultdict
from itertools import product

import numpy as np
import numpy.typing as npt

_Cell = tuple[int, int, int]


class BallGrid:
    """Balls by number, found by place; finding takes as long as there are balls near by, however many there are."""

    def __init__(self) -> None:
        self._levels: dict[int, dict[_Cell, list[int]]] = {}

    def add(self, number: int, center_m: npt.NDArray[np.float64], radius_m: float) -> None:
        """Add a ball: center float64 [3], radius (m) of more than 0."""
        level = math.ceil(math.log2(radius_m))
        cells = self._levels.setdefault(level, defaultdict(list))
        cells[_cell(center_m, 2.0**level)].append(number)

    def near(
        self, center_m: npt.NDArray[np.float64], radius_m: float, *, stretch: float = 1.0
    ) -> npt.NDArray[np.int64]:
        """Numbers, in order, of all balls that meet the ball given, and of some that do not.

        Args:
            center_m: Its center float64 [3].
            radius_m: Its radius.
            stretch: Factor on the radii of the balls in the grid.
        """
        found: list[int] = []
        for level, cells in self._levels.items():
            side = 2.0**level
            reach = radius_m + stretch * side  # a ball's radius is at most the side of its cell
            low, high = _cell(center_m - reach, side), _cell(center_m + reach, side)
            spans = [range(a, b + 1) for a, b in zip(low, high, strict=True)]
            if math.prod(len(span) for span in spans) < len(cells):
                for x, y, z in product(*spans):
                    found += cells.get((x, y, z), ())
            else:
                for cell, numbers in cells.items():
                    if all(i in span for i, span in zip(cell, spans, strict=True)):
                        found += numbers
        return np.array(sorted(found), np.int64)


def _cell(place_m: npt.NDArray[np.float64], side_m: float) -> _Cell:
    x, y, z = (math.floor(value / side_m) for value in place_m.tolist())
    return x, y, z

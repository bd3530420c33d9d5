"""Streets under a driven path: where the path comes back to a street, it is the same street."""

import numpy as np

from vtslam.services.sensor.sources.sim_city_path import Path, Points

_SPACING_M = 1.0
_SAME_STREET_M = 6.0  # lines nearer to each other than this ...
_OTHER_VISIT_M = 30.0  # ... that are this far apart along the path are one street
_RUN_OUT_M = 60.0  # streets go on beyond both ends of a path
_MIN_PIECE = 3  # points


class PointGrid:
    """Points of the ground plane, found by place; each has a number."""

    def __init__(self, cell_m: float) -> None:
        self._cell_m = cell_m
        self._cells: dict[tuple[int, int], list[tuple[float, float, float]]] = {}

    def add(self, x: float, z: float, number: float) -> None:
        """Put in a point."""
        self._cells.setdefault((int(x // self._cell_m), int(z // self._cell_m)), []).append((x, z, number))

    def around(self, x: float, z: float, reach_m: float) -> list[tuple[float, float, float]]:
        """The points (x, z, number) of all cells within ``reach_m``: those in reach and some beyond."""
        low_x, high_x = (int((x + d) // self._cell_m) for d in (-reach_m, reach_m))
        low_z, high_z = (int((z + d) // self._cell_m) for d in (-reach_m, reach_m))
        cells = ((i, j) for i in range(low_x, high_x + 1) for j in range(low_z, high_z + 1))
        return [point for cell in cells for point in self._cells.get(cell, ())]


def resampled(line: Points) -> Points:
    """The line [K,2] with a point every metre."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.arange(0.0, lengths[-1], _SPACING_M)
    return np.stack([np.interp(at, lengths, line[:, k]) for k in range(2)], axis=1)


def path_streets(path: Path) -> list[Points]:
    """Middle lines [K,2] of the streets that a path follows, each once."""
    points = resampled(_with_run_outs(path))
    grid = PointGrid(_SAME_STREET_M)
    fresh = np.ones(len(points), np.bool_)
    for row, (x, z) in enumerate(points.tolist()):
        along_m = row * _SPACING_M
        fresh[row] = not any(
            along_m - number > _OTHER_VISIT_M and (x - px) ** 2 + (z - pz) ** 2 < _SAME_STREET_M**2
            for px, pz, number in grid.around(x, z, _SAME_STREET_M)
        )
        if fresh[row]:
            grid.add(x, z, along_m)
    return _runs(points, fresh)


def _with_run_outs(path: Path) -> Points:
    def beyond(end: int, sign: float) -> Points:
        way = np.array([np.sin(path.headings[end]), np.cos(path.headings[end])])
        return np.asarray(path.places_m[end] + sign * _RUN_OUT_M * way)[None]

    return np.concatenate([beyond(0, -1.0), path.places_m, beyond(-1, 1.0)])


def _runs(points: Points, fresh: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> list[Points]:
    """Stretches of fresh points, each led on over one point into the street it meets."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], fresh, [False]]).astype(np.int8)))
    pieces = [points[max(a - 1, 0) : b + 1] for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return [piece for piece in pieces if len(piece) >= _MIN_PIECE]


def segments(streets: list[Points]) -> Points:
    """Pieces [S,5] (x0, z0, x1, z1, length of the line before) of about 4 m for the ray caster."""
    out = []
    for street in streets:
        line = np.concatenate([street[:-1:4], street[-1:]])
        steps = np.diff(line, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        kept = lengths > 1e-3
        before = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
        out.append(np.concatenate([line[:-1], line[1:], before[:, None]], axis=1)[kept])
    return np.concatenate(out)

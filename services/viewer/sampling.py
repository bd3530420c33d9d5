"""Which of many are shown: always the same ones, and evenly."""

import numpy as np
import numpy.typing as npt


def kept_rows(count: int, limit: int, *, key: int) -> npt.NDArray[np.int64]:
    """At most ``limit`` of ``count`` rows, ascending; int64 [min(limit, count)].

    Drawn by the counter-based generator keyed by ``key``: the rank of a row does not depend on ``count``, so that few
    of those shown change when rows are added.
    """
    if count <= limit:
        return np.arange(count)
    if limit <= 0:
        return np.zeros(0, np.int64)
    ranks = np.random.Generator(np.random.Philox(key=key)).random(count)
    return np.sort(np.argpartition(ranks, limit - 1)[:limit])


def thinned_line(points: npt.NDArray[np.float64], limit: int) -> npt.NDArray[np.float64]:
    """At most ``limit`` points of a line [N,3], its ends among them."""
    if len(points) <= limit:
        return points
    return points[np.linspace(0, len(points) - 1, limit).round().astype(np.int64)]

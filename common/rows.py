"""Leaving out rows of arrays, and adding some."""

from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

_Scalar = TypeVar("_Scalar", bound=np.generic)


def thinned(values: npt.NDArray[_Scalar], kept: npt.NDArray[np.bool_]) -> npt.NDArray[_Scalar]:
    """The rows of ``values`` [N,...] that stay, in memory of their own.

    Args:
        values: At least as many rows as ``kept``.
        kept: bool [M], for the last M rows; those before them all stay. Much faster than indices where few may go.
    """
    first = values.shape[0] - kept.size
    return np.concatenate([values[:first], values[first:][kept]])


def compacted(values: npt.NDArray[_Scalar], kept: npt.NDArray[np.bool_]) -> npt.NDArray[_Scalar]:
    """As :func:`thinned`, within the memory of ``values``, which must not be used afterwards."""
    first = values.shape[0] - kept.size
    end = first + np.count_nonzero(kept)
    values[first:end] = values[first:][kept]
    return values[:end]


class GrowingRows(Generic[_Scalar]):
    """Rows that become more and more, without all of them being copied each time.

    Args:
        values: The first rows, [N,...]; copied.

    Attributes:
        values: All rows up to now; what this was before an extension stays as it was.
    """

    def __init__(self, values: npt.NDArray[_Scalar]) -> None:
        self._room = self.values = values.copy()

    def extend(self, more: npt.NDArray[_Scalar]) -> None:
        """Add rows [M,...] behind the others."""
        count, end = len(self.values), len(self.values) + len(more)
        if end > len(self._room):
            self._room = np.empty((end + end // 2, *self.values.shape[1:]), self.values.dtype)
            self._room[:count] = self.values
        self._room[count:end] = more
        self.values = self._room[:end]

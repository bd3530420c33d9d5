"""Leaving out rows of arrays."""

from typing import TypeVar

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

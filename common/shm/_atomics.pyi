"""Atomic 64-bit words in shared memory."""

from typing import Annotated

import numpy
from numpy.typing import NDArray


class Words:
    """
    Atomic access, sequentially consistent, to a writable uint64 [n] array.
    """

    def __init__(self, words: Annotated[NDArray[numpy.uint64], dict(shape=(None,), order='C', device='cpu')]) -> None: ...

    def __len__(self) -> int: ...

    def load(self, index: int) -> int: ...

    def store(self, index: int, value: int) -> None: ...

    def fetch_add(self, index: int, value: int) -> int:
        """Adds, wrapping; returns the former value."""

    def compare_exchange(self, index: int, expected: int, desired: int) -> bool:
        """Stores ``desired`` if the word is ``expected``; whether it did."""

def fence() -> None:
    """Orders plain reads and writes before it against those after it."""

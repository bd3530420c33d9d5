"""Columns that grow in place: a sparse file laid out for the most, reserved as far as it is used."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.shm.blocks import aligned, column, make_file, mapped, open_file, reserve

CHUNK_ROWS = 4096  # whole pages of any column, where pages have 4096 bytes
ColumnTypes = tuple[tuple[str, str, tuple[int, ...]], ...]
Admission = Callable[[str, int], None]


class ColumnLayout:
    """Places of columns for ``max_rows`` rows after ``head_bytes``.

    Attributes:
        head_bytes: Where the first column starts.
        file_bytes: Size of the file.
        row_bytes: Bytes of one row in all columns.
    """

    def __init__(self, columns: ColumnTypes, max_rows: int, *, head_bytes: int) -> None:
        self.head_bytes = aligned(head_bytes)
        self._columns: dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]] = {}
        place, self.row_bytes = self.head_bytes, 0
        for name, dtype, values in columns:
            kind = np.dtype(dtype)
            self._columns[name] = (place, kind, values)
            size = kind.itemsize * int(np.prod(values, dtype=np.int64))
            self.row_bytes += size
            place += aligned(aligned(max_rows, CHUNK_ROWS) * size)
        self.file_bytes = place

    def column(self, area: npt.NDArray[np.uint8], name: str, rows: int) -> npt.NDArray[Any]:
        """The first rows of a column."""
        place, kind, values = self._columns[name]
        return column(area, place, kind, (rows, *values))

    def extents(self, low: int, high: int) -> list[tuple[int, int]]:
        """(offset, length) of rows ``low`` to ``high`` - 1 in every column, whole chunks."""
        sizes = ((place, kind.itemsize * int(np.prod(values))) for place, kind, values in self._columns.values())
        return [(place + low * size, (high - low) * size) for place, size in sizes]


class GrowingFile:
    """A writer's mapping of such a file.

    Args:
        path: The file; made if ``rows_reserved`` is None.
        layout: Its columns.
        admit: Asked before anything is reserved; raises if it must not be.
        rows_reserved: Rows that an existing file surely holds.

    Attributes:
        area: The whole file, writable; only what is reserved may be touched.
    """

    def __init__(self, path: Path, layout: ColumnLayout, admit: Admission, *, rows_reserved: int | None = None) -> None:
        self.path, self._layout, self._admit = path, layout, admit
        self._rows = aligned(rows_reserved or 0, CHUNK_ROWS)
        if rows_reserved is None:
            self._fd = make_file(path, layout.file_bytes)
        else:
            self._fd = open_file(path, writable=True)
        self.area = mapped(self._fd, layout.file_bytes, writable=True)

    def ensure_rows(self, rows: int) -> None:
        """Reserve space of at least ``rows`` rows; raises MapStoreFull or SharedMemoryFull."""
        wanted = aligned(rows, CHUNK_ROWS)
        if wanted <= self._rows:
            return
        self._admit(str(self.path), (wanted - self._rows) * self._layout.row_bytes)
        for offset, length in self._layout.extents(self._rows, wanted):
            reserve(self.path, self._fd, offset, length)
        self._rows = wanted

    def reserve(self, offset: int, length: int) -> None:
        """Reserve bytes before the columns; raises MapStoreFull or SharedMemoryFull."""
        self._admit(str(self.path), length)
        reserve(self.path, self._fd, offset, length)

    def column(self, name: str, rows: int) -> npt.NDArray[Any]:
        """The first rows of a column, writable."""
        return self._layout.column(self.area, name, rows)

    def close(self) -> None:
        """Give the descriptor back; the mapping goes with its last view."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __del__(self) -> None:
        if hasattr(self, "_fd"):
            self.close()

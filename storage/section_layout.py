"""What the bytes of a `.vts` file are called, and the checks of all that is read from one (docs/format-section.md)."""

import math
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vtslam.common import plain_msgpack
from vtslam.storage.column_codecs import CODECS, RAW, most_decoded_bytes
from vtslam.storage.errors import ChecksumMismatch, MalformedSection, StorageError

FORMAT_VERSION = 2  # what is written
READABLE_VERSIONS = (1, 2)

MAGIC = b"\x89VTS\r\n\x1a\n"
END_MARK = b"VTS-END\n"
PRELUDE = struct.Struct("<8sIIQII")  # magic, version, header length, file size, header CRC, CRC of the rest
INDEX_REFERENCE = struct.Struct("<QII")  # index offset, index length, index CRC
FOOTER = struct.Struct("<16s32sI8s")  # index reference, SHA-256, CRC of both, end mark
CRC = struct.Struct("<I")
_ALIGNMENT = 64
MAX_COLUMNS = 256
MAX_DIMENSIONS = 8
_MAX_ELEMENTS = 2**48  # with every size taken as at least 1, so that numpy can hold the shape of an empty array
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
DTYPES = {
    name: np.dtype(name).newbyteorder("<")
    for name in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64")
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One row of the index: a column's name, type, shape, place (bytes), codec and checksum of the stored bytes."""

    name: str
    dtype_name: str
    shape: tuple[int, ...]
    offset: int
    length: int
    codec: str
    crc32: int

    def as_list(self) -> list[object]:
        """The row as the index stores it."""
        return [self.name, self.dtype_name, list(self.shape), self.offset, self.length, self.codec, self.crc32]


def aligned(offset: int) -> int:
    """The first place at or after ``offset`` where a column or the index may start."""
    return -(-offset // _ALIGNMENT) * _ALIGNMENT


def parse_header(path: Path, data: bytes) -> dict[str, Any]:
    """The header's map; raises MalformedSection."""
    try:
        header = plain_msgpack.unpack(data)
    except ValueError as error:
        raise MalformedSection(f"{path}: header: {error}") from error
    if not isinstance(header, dict):
        raise MalformedSection.differing(path, "header", expected="a map", found=type(header).__name__)
    return header


def parse_index(path: Path, data: bytes, version: int) -> tuple[Entry, ...]:
    """The index's rows, each one consistent in itself; raises MalformedSection."""
    try:
        rows = plain_msgpack.unpack(data)
        if not isinstance(rows, list) or len(rows) > MAX_COLUMNS:
            raise ValueError(f"expected a list of at most {MAX_COLUMNS} columns, found {rows!r:.60}")
        entries = tuple(_parse_entry(row, CODECS if version > 1 else (RAW,)) for row in rows)
    except ValueError as error:
        raise MalformedSection(f"{path}: index: {error}") from error
    names = [entry.name for entry in entries]
    if names != sorted(set(names)):
        raise MalformedSection.differing(path, "index", expected="names sorted and unique", found=names)
    return entries


def _parse_entry(row: Any, codecs: Sequence[str]) -> Entry:  # noqa: ANN401
    """One checked row of the index; ValueError says what is wrong with it."""
    match row:
        case [str(name), str(dtype_name), list(shape), int(offset), int(length), str(codec), int(crc32)] if (
            bool not in (type(offset), type(length), type(crc32))
        ):
            pass
        case _:
            raise ValueError(f"expected [name, dtype, shape, offset, length, codec, crc32], found {row!r:.80}")
    if not NAME.fullmatch(name) or dtype_name not in DTYPES or codec not in codecs:
        raise ValueError(
            f"expected a name like {NAME.pattern}, a dtype of {', '.join(DTYPES)} and a codec of {', '.join(codecs)}, "
            f"found {name!r:.80}, {dtype_name!r:.20}, {codec!r:.20}"
        )
    sizes_known = len(shape) <= MAX_DIMENSIONS and all(type(size) is int and size >= 0 for size in shape)
    if not sizes_known or math.prod(max(size, 1) for size in shape) > _MAX_ELEMENTS:
        raise ValueError(f"column {name!r}: expected at most {MAX_DIMENSIONS} sizes, found {shape!r:.80}")
    size = math.prod(shape) * DTYPES[dtype_name].itemsize
    if length < 0 or (length != size if codec == RAW else size > most_decoded_bytes(codec, length)):
        raise ValueError(f"column {name!r}: {dtype_name} {shape} takes {size} bytes, which {length} of {codec} are not")
    return Entry(
        name=name, dtype_name=dtype_name, shape=tuple(shape), offset=offset, length=length, codec=codec, crc32=crc32
    )


def check_places(path: Path, entries: Sequence[Entry], header_end: int, index_offset: int) -> None:
    """Columns lie one after another from the header's end up to the index, so their lengths fit in the file.

    Raises:
        MalformedSection: Something lies elsewhere.
    """
    end = header_end
    for entry in entries:
        check_equal(path, f"offset of column {entry.name!r}", aligned(end), entry.offset, MalformedSection)
        end = entry.offset + entry.length
    check_equal(path, "offset of the index", aligned(end), index_offset, MalformedSection)


def check_crc(path: Path, what: str, expected: int, data: bytes | memoryview) -> None:
    """Raise ChecksumMismatch if the CRC-32 of ``data`` is not ``expected``."""
    found = zlib.crc32(data)
    if found != expected:
        raise ChecksumMismatch.differing(path, f"CRC-32 of {what}", expected=f"{expected:08x}", found=f"{found:08x}")


def check_equal(path: Path, what: str, expected: object, found: object, error: type[StorageError]) -> None:
    """Raise ``error`` if ``found`` is not ``expected``."""
    if found != expected:
        raise error.differing(path, what, expected=expected, found=found)

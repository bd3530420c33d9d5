"""The bytes of a `.vts` file from a header and columns (docs/format-section.md)."""

import hashlib
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common import plain_msgpack
from vtslam.storage.column_codecs import RAW, ColumnCodec, encode_column
from vtslam.storage.section_layout import (
    CRC,
    DTYPES,
    END_MARK,
    FOOTER,
    FORMAT_VERSION,
    INDEX_REFERENCE,
    MAGIC,
    MAX_COLUMNS,
    MAX_DIMENSIONS,
    NAME,
    PRELUDE,
    Entry,
    aligned,
)

AnyArray = npt.NDArray[Any]
_AS_IS = ColumnCodec(name=RAW)


def encoded_columns(
    header: Mapping[str, Any], columns: Mapping[str, AnyArray], codecs: Mapping[str, ColumnCodec] | None = None
) -> list[bytes | memoryview]:
    """A file's bytes, the last piece its footer, in pieces; ValueError if it cannot be."""
    return list(_encoded(dict(header), columns, codecs or {}))


def _encoded(
    header: dict[str, Any], columns: Mapping[str, AnyArray], codecs: Mapping[str, ColumnCodec]
) -> Iterator[bytes | memoryview]:
    """The file's bytes, piece by piece; the last piece is the footer."""
    header_bytes = plain_msgpack.pack(header)
    arrays = {name: _stored(name, columns[name]) for name in sorted(columns)}
    if len(arrays) > MAX_COLUMNS:
        raise ValueError(f"there are {len(arrays)} columns, at most {MAX_COLUMNS} fit")
    entries, chunks, end = [], {}, PRELUDE.size + len(header_bytes)
    for name, array in arrays.items():
        codec, chunk = encode_column(array, codecs.get(name, _AS_IS))
        chunks[name] = chunk
        offset = aligned(end)
        end = offset + chunk.nbytes
        entries.append(
            Entry(
                name=name,
                dtype_name=array.dtype.name,
                shape=array.shape,
                offset=offset,
                length=chunk.nbytes,
                codec=codec,
                crc32=zlib.crc32(chunk.data),
            )
        )
    index_bytes = plain_msgpack.pack([entry.as_list() for entry in entries])
    index_offset = aligned(end)
    file_size = index_offset + len(index_bytes) + FOOTER.size

    digest = hashlib.sha256()
    for piece in _body(header_bytes, file_size, entries, chunks, index_offset, index_bytes):
        digest.update(piece)
        yield piece
    checked = INDEX_REFERENCE.pack(index_offset, len(index_bytes), zlib.crc32(index_bytes))
    digest.update(checked)
    yield FOOTER.pack(checked, digest.digest(), zlib.crc32(checked + digest.digest()), END_MARK)


def _body(
    header_bytes: bytes,
    file_size: int,
    entries: Sequence[Entry],
    chunks: Mapping[str, npt.NDArray[np.uint8]],
    index_offset: int,
    index_bytes: bytes,
) -> Iterator[bytes | memoryview]:
    """Everything before the footer."""
    fields = (MAGIC, FORMAT_VERSION, len(header_bytes), file_size, zlib.crc32(header_bytes))
    prelude = PRELUDE.pack(*fields, 0)[: -CRC.size]
    yield prelude + CRC.pack(zlib.crc32(prelude))
    yield header_bytes
    end = PRELUDE.size + len(header_bytes)
    for entry in entries:
        yield bytes(entry.offset - end)
        yield chunks[entry.name].data
        end = entry.offset + entry.length
    yield bytes(index_offset - end)
    yield index_bytes


def _stored(name: str, array: AnyArray) -> AnyArray:
    """``array`` little-endian and in C order (copied only if it is not), if the format can hold it."""
    if not NAME.fullmatch(name):
        raise ValueError(f"a column's name must match {NAME.pattern}, got {name!r:.80}")
    dtype = DTYPES.get(array.dtype.name)
    if dtype is None or array.ndim > MAX_DIMENSIONS:
        raise ValueError(
            f"column {name!r} must be one of {', '.join(DTYPES)} with at most {MAX_DIMENSIONS} dimensions, "
            f"got {array.dtype} {array.shape}"
        )
    return np.asarray(array, dtype=dtype, order="C")

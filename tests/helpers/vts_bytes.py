"""Section files taken apart and sealed again, written from docs/format-section.md and not from the program's code.

With it tests make files whose checksums all fit and whose content is wrong.
"""

import hashlib
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgpack  # type: ignore[import-untyped]

MAGIC = bytes.fromhex("89565453 0D0A1A0A")
END_MARK = bytes.fromhex("5654532D 454E440A")
PRELUDE_BYTES, FOOTER_BYTES = 32, 60


@dataclass(frozen=True, slots=True, kw_only=True)
class VtsParts:
    """What determines a file; ``body`` is all between header and index. None: the right value."""

    header: bytes
    body: bytes
    index: bytes
    version: int = 2
    header_length: int | None = None
    file_size: int | None = None
    index_offset: int | None = None
    index_length: int | None = None
    sha256: bytes | None = None

    @property
    def rows(self) -> list[Any]:
        """The index, decoded."""
        rows: list[Any] = msgpack.unpackb(self.index)
        return rows

    def with_rows(self, rows: object) -> "VtsParts":
        """The same with another index."""
        return replace(self, index=msgpack.packb(rows))

    def with_header(self, change: Callable[[dict[str, Any]], object]) -> "VtsParts":
        """The same with a changed header; the columns move to where they then belong."""
        header = msgpack.unpackb(self.header)
        change(header)
        packed = msgpack.packb({key: header[key] for key in sorted(header)})
        old_end, new_end = PRELUDE_BYTES + len(self.header), PRELUDE_BYTES + len(packed)
        old_start, new_start = -(-old_end // 64) * 64, -(-new_end // 64) * 64
        rows = self.rows
        for row in rows:
            row[3] += new_start - old_start
        body = bytes(new_start - new_end) + self.body[old_start - old_end :]
        return replace(self, header=packed, body=body, index=msgpack.packb(rows))

    def with_column_bytes(self, name: str, data: bytes) -> "VtsParts":
        """The same with a column's bytes replaced (equal length) and its checksum made right."""
        rows = self.rows
        row = next(row for row in rows if row[0] == name)
        assert row[4] == len(data)
        row[6] = zlib.crc32(data)
        start = row[3] - PRELUDE_BYTES - len(self.header)
        body = self.body[:start] + data + self.body[start + len(data) :]
        # A checksum's shortest msgpack form may differ in length; that only moves the end of the file.
        return replace(self, body=body, index=msgpack.packb(rows))

    def with_chunk(self, name: str, data: bytes) -> "VtsParts":
        """The same with a column's stored bytes replaced, of any length; lengths, places and checksums made right."""
        rows, body, end = self.rows, b"", PRELUDE_BYTES + len(self.header)
        for row in rows:
            start = row[3] - PRELUDE_BYTES - len(self.header)
            chunk = data if row[0] == name else self.body[start : start + row[4]]
            body += bytes(-end % 64) + chunk
            row[3], row[4], row[6] = end + -end % 64, len(chunk), zlib.crc32(chunk)
            end = row[3] + row[4]
        return replace(self, body=body + bytes(-end % 64), index=msgpack.packb(rows))

    def sealed(self) -> bytes:
        """The file, with every checksum right."""

        def chosen(value: int | None, right: int) -> int:
            return right if value is None else value

        index_offset = PRELUDE_BYTES + len(self.header) + len(self.body)
        size = index_offset + len(self.index) + FOOTER_BYTES
        prelude = MAGIC + struct.pack(
            "<IIQI",
            self.version,
            chosen(self.header_length, len(self.header)),
            chosen(self.file_size, size),
            zlib.crc32(self.header),
        )
        data = prelude + struct.pack("<I", zlib.crc32(prelude)) + self.header + self.body + self.index
        reference = struct.pack(
            "<QII",
            chosen(self.index_offset, index_offset),
            chosen(self.index_length, len(self.index)),
            zlib.crc32(self.index),
        )
        checked = reference + (self.sha256 or hashlib.sha256(data + reference).digest())
        return data + checked + struct.pack("<I", zlib.crc32(checked)) + END_MARK


def parts_of(data: bytes) -> VtsParts:
    """Take an intact file apart."""
    header_end = PRELUDE_BYTES + struct.unpack_from("<I", data, 12)[0]
    index_offset, index_length = struct.unpack_from("<QI", data, len(data) - FOOTER_BYTES)
    return VtsParts(
        header=data[PRELUDE_BYTES:header_end],
        body=data[header_end:index_offset],
        index=data[index_offset : index_offset + index_length],
    )

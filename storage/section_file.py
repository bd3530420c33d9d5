"""Named arrays and a header in one checked file: the `.vts` container (docs/format-section.md)."""

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO, FileIO
from pathlib import Path
from stat import S_ISREG
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common import plain_msgpack
from vtslam.storage.atomic import replace_file
from vtslam.storage.column_codecs import ColumnCodec, decode_column
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.errors import (
    BadMagic,
    ChecksumMismatch,
    MalformedSection,
    TruncatedFile,
    UnreadableFile,
    UnsupportedVersion,
)
from vtslam.storage.section_codecs import SectionCodec, decoded_record, encoded_record
from vtslam.storage.section_encoding import encoded_columns
from vtslam.storage.section_layout import (
    CRC,
    DTYPES,
    END_MARK,
    FOOTER,
    INDEX_REFERENCE,
    MAGIC,
    PRELUDE,
    READABLE_VERSIONS,
    Entry,
    check_crc,
    check_equal,
    check_places,
    parse_header,
    parse_index,
)
from vtslam.storage.section_record import SectionRecord

AnyArray = npt.NDArray[Any]
Source = FileIO | BytesIO


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layout:
    """All of an open file but its columns, checked against the file's size."""

    prelude: bytes
    header_bytes: bytes
    header: dict[str, Any]
    entries: tuple[Entry, ...]
    index_bytes: bytes
    index_offset: int
    index_reference: bytes
    sha256: bytes


def write_columns(
    path: Path,
    header: Mapping[str, Any],
    columns: Mapping[str, AnyArray],
    codecs: Mapping[str, ColumnCodec] | None = None,
) -> None:
    """Write ``header`` and ``columns`` to ``path``, replacing it as a whole, then read back from disk and compare.

    Args:
        path: The file; its folder must exist.
        header: Plain values (see :mod:`vtslam.common.plain_msgpack`), at most 65536 bytes packed.
        columns: Arrays of integer or float32/float64 type, at most 8 dimensions; names as in the format's section 1.
        codecs: How to store columns, by name; those not named as they are.

    Raises:
        MalformedSection: The format cannot hold this header or these columns.
        WriteFailed: The operating system refused.
        StorageError: What came back from the disk is not what was written.
    """
    try:
        pieces = encoded_columns(header, columns, codecs)
    except ValueError as error:
        raise MalformedSection(f"{path}: cannot be written: {error}") from error
    _write_pieces(path, pieces)


def _write_pieces(path: Path, pieces: Sequence[bytes | memoryview]) -> None:
    replace_file(path, pieces)
    written = FOOTER.unpack(pieces[-1])[1]
    found = verify_file(path)
    if found != written:
        raise ChecksumMismatch.differing(path, "SHA-256 read back", expected=written.hex(), found=found.hex())


def read_columns(path: Path, names: Sequence[str] | None = None) -> tuple[dict[str, Any], dict[str, AnyArray]]:
    """The header and the columns of a file, each column's bytes checked.

    Args:
        path: The file.
        names: Columns to read; None for all, which also checks the whole file's SHA-256.

    Returns:
        The header, and new writable arrays by name (all, sorted by name, or as in ``names``).

    Raises:
        StorageError: One of the kinds in the format's section 7.
    """
    with _open(path) as file:
        layout = _read_layout(file, path)
        if names is None:
            return layout.header, dict(_decoded(path, item) for item in _read_whole(file, path, layout))
        by_name = {entry.name: entry for entry in layout.entries}
        for name in names:
            if name not in by_name:
                raise MalformedSection.differing(path, "columns", expected=repr(name), found=sorted(by_name))
        return layout.header, dict(
            _decoded(path, (by_name[name], _read_chunk(file, path, by_name[name]))) for name in names
        )


def verify_file(path: Path) -> bytes:
    """Check every byte of a file, read from disk and not from memory where the system allows; its SHA-256.

    Raises:
        StorageError: One of the kinds in the format's section 7.
    """
    with _open(path) as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        layout = _read_layout(file, path)
        for _ in _read_whole(file, path, layout):
            pass
    return layout.sha256


def _open(path: Path) -> FileIO:
    """The file, unbuffered; never waits, as opening a pipe would."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot open: {error.strerror}") from error
    if not S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise UnreadableFile.differing(path, "kind", expected="a regular file", found="a folder or device")
    return FileIO(descriptor, "rb")


def _read_layout(file: Source, path: Path) -> _Layout:
    """Everything but the columns, in the order of checks of the format's section 7."""
    size = file.seek(0, os.SEEK_END)
    prelude, version, header_length, header_crc = _read_prelude(file, path, size)
    footer = _read(file, path, size - FOOTER.size, FOOTER.size)
    reference, sha256, footer_crc, end_mark = FOOTER.unpack(footer)
    check_crc(path, "footer", footer_crc, reference + sha256)
    check_equal(path, "end mark", END_MARK, end_mark, MalformedSection)
    index_offset, index_length, index_crc = INDEX_REFERENCE.unpack(reference)
    header_end = PRELUDE.size + header_length
    if index_length > plain_msgpack.MAX_BYTES or index_offset + index_length + FOOTER.size != size:
        raise MalformedSection.differing(
            path,
            "index",
            expected=f"at most {plain_msgpack.MAX_BYTES} bytes that end at {size - FOOTER.size}",
            found=f"{index_length} bytes from {index_offset}",
        )
    index_bytes = _read(file, path, index_offset, index_length)
    check_crc(path, "index", index_crc, index_bytes)
    entries = parse_index(path, index_bytes, version)
    check_places(path, entries, header_end, index_offset)
    header_bytes = _read(file, path, PRELUDE.size, header_length)
    check_crc(path, "header", header_crc, header_bytes)
    return _Layout(
        prelude=prelude,
        header_bytes=header_bytes,
        header=parse_header(path, header_bytes),
        entries=entries,
        index_bytes=index_bytes,
        index_offset=index_offset,
        index_reference=reference,
        sha256=sha256,
    )


def _read_prelude(file: Source, path: Path, size: int) -> tuple[bytes, int, int, int]:
    """The checked prelude, the version, the header's length and its CRC."""
    start = _read(file, path, 0, min(size, PRELUDE.size))
    check_equal(path, "magic", MAGIC[: max(len(start), 1)], start[: len(MAGIC)], BadMagic)
    if size < PRELUDE.size + FOOTER.size:
        raise TruncatedFile.differing(
            path, "size", expected=f"at least {PRELUDE.size + FOOTER.size} bytes", found=f"{size} bytes"
        )
    _, version, header_length, file_size, header_crc, crc = PRELUDE.unpack(start)
    check_crc(path, "prelude", crc, start[: -CRC.size])
    if version not in READABLE_VERSIONS:
        raise UnsupportedVersion.differing(
            path, "format version", expected=f"one of {', '.join(map(str, READABLE_VERSIONS))}", found=version
        )
    check_equal(path, "size in bytes", file_size, size, TruncatedFile)
    room = min(plain_msgpack.MAX_BYTES, size - PRELUDE.size - FOOTER.size)
    if header_length > room:
        raise MalformedSection.differing(path, "header length", expected=f"at most {room}", found=header_length)
    return start, version, header_length, header_crc


def _read_whole(file: Source, path: Path, layout: _Layout) -> Iterator[tuple[Entry, npt.NDArray[np.uint8]]]:
    """Every column's bytes; at the end the SHA-256 is checked, so only an exhausted iterator vouches for the file."""
    digest = hashlib.sha256(layout.prelude + layout.header_bytes)
    end = PRELUDE.size + len(layout.header_bytes)
    for entry in layout.entries:
        digest.update(_read_gap(file, path, end, entry.offset))
        chunk = _read_chunk(file, path, entry)
        digest.update(chunk.data)
        end = entry.offset + entry.length
        yield entry, chunk
    digest.update(_read_gap(file, path, end, layout.index_offset))
    digest.update(layout.index_bytes + layout.index_reference)
    if digest.digest() != layout.sha256:
        raise ChecksumMismatch.differing(path, "SHA-256", expected=layout.sha256.hex(), found=digest.hexdigest())


def _read_chunk(file: Source, path: Path, entry: Entry) -> npt.NDArray[np.uint8]:
    chunk = np.empty(entry.length, np.uint8)
    _fill(file, path, entry.offset, chunk.data)
    check_crc(path, f"column {entry.name!r}", entry.crc32, chunk.data)
    return chunk


def _decoded(path: Path, item: tuple[Entry, npt.NDArray[np.uint8]]) -> tuple[str, AnyArray]:
    """A column's name and array."""
    entry, chunk = item
    try:
        return entry.name, decode_column(chunk, entry.codec, DTYPES[entry.dtype_name], entry.shape)
    except ValueError as error:
        raise MalformedSection(f"{path}: column {entry.name!r}: {error}") from error


def _read_gap(file: Source, path: Path, start: int, end: int) -> bytes:
    gap = _read(file, path, start, end - start)
    check_equal(path, f"gap at {start}", bytes(len(gap)), gap, MalformedSection)
    return gap


def _read(file: Source, path: Path, offset: int, length: int) -> bytes:
    """``length`` bytes, a number the caller has bounded."""
    data = bytearray(length)
    _fill(file, path, offset, memoryview(data))
    return bytes(data)


def _fill(file: Source, path: Path, offset: int, target: memoryview) -> None:
    """Read from ``offset`` until ``target`` is full; one read may give less than asked."""
    done = 0
    try:
        file.seek(offset)
        while done < len(target):
            count = file.readinto(target[done:])
            if not count:
                raise TruncatedFile.differing(
                    path, f"bytes from {offset}", expected=len(target), found=f"{done} (cut while being read)"
                )
            done += count
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot read at {offset + done}: {error.strerror}") from error


# --- sections --------------------------------------------------------------------------------------------------------


def write_section(
    path: Path, record: SectionRecord, codec: SectionCodec = "lossless", grid: DenseGrid | None = None
) -> None:
    """Write a section to ``path``; see :func:`write_columns` and :func:`encode_section`."""
    _write_pieces(path, _section_pieces(path, record, codec, grid))


def encode_section(record: SectionRecord, codec: SectionCodec, *, name: Path, grid: DenseGrid | None = None) -> bytes:
    """The bytes of a section's file.

    Args:
        record: The section.
        codec: See :func:`vtslam.storage.section_codecs.encoded_record`.
        name: What errors call the file.
        grid: What ``dense`` rounds to; None for the usual grid.

    Raises:
        MalformedSection: The codec cannot hold this section.
    """
    return b"".join(_section_pieces(name, record, codec, grid))


def decode_section(data: bytes, *, name: Path) -> SectionRecord:
    """The section in a file's bytes, as :func:`read_section`."""
    return _section_in(BytesIO(data), name)


def column_bytes(data: bytes, *, name: Path) -> dict[str, int]:
    """Stored bytes of each column of a file's bytes; raises StorageError."""
    return {entry.name: entry.length for entry in _read_layout(BytesIO(data), name).entries}


def read_section(path: Path) -> SectionRecord:
    """The section in a file, every byte and value checked.

    Raises:
        StorageError: One of the kinds in the format's section 7.
    """
    with _open(path) as file:
        return _section_in(file, path)


def _section_pieces(
    path: Path, record: SectionRecord, codec: SectionCodec, grid: DenseGrid | None = None
) -> list[bytes | memoryview]:
    try:
        return encoded_columns(*encoded_record(record, codec, grid))
    except ValueError as error:
        raise MalformedSection(f"{path}: cannot be written: {error}") from error


def _section_in(file: Source, path: Path) -> SectionRecord:
    layout = _read_layout(file, path)
    columns = dict(_decoded(path, item) for item in _read_whole(file, path, layout))
    return _record(path, layout.header, columns)


def _record(path: Path, header: Mapping[str, Any], columns: Mapping[str, AnyArray]) -> SectionRecord:
    try:
        return decoded_record(header, columns)
    except ValueError as error:
        raise MalformedSection(f"{path}: {error}") from error

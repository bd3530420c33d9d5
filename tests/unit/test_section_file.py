"""Section files: exact, deterministic, atomic; each kind of damage has its own clear refusal."""

import errno
import os
import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from helpers.sections import assert_same_section, small_section
from helpers.vts_bytes import VtsParts, parts_of

from vtslam.storage import section_file
from vtslam.storage.atomic import replace_file
from vtslam.storage.errors import (
    BadMagic,
    ChecksumMismatch,
    MalformedSection,
    StorageError,
    TruncatedFile,
    UnreadableFile,
    UnsupportedVersion,
    WriteFailed,
)
from vtslam.storage.section_file import read_columns, read_section, verify_file, write_columns, write_section


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "000007.vts"


@pytest.fixture
def parts(path: Path) -> VtsParts:
    write_section(path, small_section(), "raw")
    return parts_of(path.read_bytes())


# --- exactness -------------------------------------------------------------------------------------------------------


def test_section_comes_back_bit_by_bit(path: Path) -> None:
    write_section(path, small_section())
    assert_same_section(read_section(path), small_section())


def test_section_without_gaussians_and_views(path: Path) -> None:
    record = small_section(num_gaussians=0, num_views=0)
    write_section(path, record)
    assert_same_section(read_section(path), record)


def test_equal_content_gives_equal_bytes_whatever_the_order(path: Path, tmp_path: Path) -> None:
    a, b = np.arange(5, dtype=np.int64), np.ones((2, 3), np.float32)
    write_columns(path, {"y": 1, "x": {"q": 2.5, "p": None}}, {"b": b, "a": a})
    write_columns(tmp_path / "other.vts", {"x": {"p": None, "q": 2.5}, "y": 1}, {"a": a, "b": np.asfortranarray(b)})
    assert path.read_bytes() == (tmp_path / "other.vts").read_bytes()


def test_file_is_as_the_description_says(path: Path, parts: VtsParts) -> None:
    # vts_bytes follows the description, not the program: if both agree, the description is right.
    assert parts.sealed() == path.read_bytes()
    assert [row[0] for row in parts.rows] == sorted(small_section().columns())
    name, dtype, shape, offset, length, codec, crc = next(row for row in parts.rows if row[0] == "color")
    start = offset - 32 - len(parts.header)
    assert (name, dtype, shape, offset % 64, codec) == ("color", "float32", [20, 3], 0, "raw")
    assert parts.body[start : start + length] == small_section().color.astype("<f4").tobytes()
    assert crc == zlib.crc32(small_section().color.tobytes())


@pytest.mark.parametrize("array", [np.array(3.5), np.zeros((0, 4), np.uint8), np.zeros((2, 0, 3), np.float32)])
def test_shapes_without_axes_or_elements(path: Path, array: npt.NDArray[Any]) -> None:
    write_columns(path, {}, {"a": array})
    found = read_columns(path)[1]["a"]
    assert (found.dtype, found.shape, found.tobytes()) == (array.dtype, array.shape, array.tobytes())


def test_special_floats_and_byte_order(path: Path) -> None:
    bits = np.array([0x7FC00001, 0xFF800000, 0x80000000, 0x00000001], np.uint32)
    write_columns(path, {}, {"native": bits.view(np.float32), "swapped": np.array([1, 2], ">i4")})
    columns = read_columns(path)[1]
    assert columns["native"].view(np.uint32).tolist() == bits.tolist()
    assert columns["swapped"].tolist() == [1, 2]


def test_chosen_columns_only(path: Path) -> None:
    write_section(path, small_section())
    header, columns = read_columns(path, ["view_depth", "view_index"])
    assert header["section_id"] == 7
    assert list(columns) == ["view_depth", "view_index"]
    assert np.array_equal(columns["view_depth"], small_section().view_depth)
    with pytest.raises(MalformedSection, match=r"expected 'colour', found .*'color'"):
        read_columns(path, ["colour"])


# --- writing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"a b": np.zeros(1)}, "a column's name"),
        ({"a": np.zeros(1, np.complex64)}, "column 'a' must be one of int8"),
        ({"a": np.zeros(1, object)}, "column 'a' must be one of int8"),
        ({"a": np.zeros((1,) * 9)}, "at most 8 dimensions"),
        ({f"a{i}": np.zeros(1) for i in range(257)}, "257 columns, at most 256"),
    ],
)
def test_columns_that_do_not_fit(path: Path, columns: dict[str, npt.NDArray[Any]], message: str) -> None:
    with pytest.raises(MalformedSection, match=message):
        write_columns(path, {}, columns)
    assert not path.exists()


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"a": float("nan")}, r"\.a must be"),
        ({"a": {"b": np.float32(1.0)}}, r"\.a\.b must be"),
        ({"a": [1, b"x"]}, r"\.a\[1\] must be"),
        ({"a": 2**63}, r"\.a must be"),
        ({"a": [[[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]]]}, "nested more than 16 deep"),
        ({"a": list(range(257))}, r"\.a must be"),
        ({"a": "x" * 70000}, "takes 70008 bytes, at most 65536"),
    ],
)
def test_headers_that_do_not_fit(path: Path, header: dict[str, Any], message: str) -> None:
    with pytest.raises(MalformedSection, match=message):
        write_columns(path, header, {})
    assert not path.exists()


def test_full_disk_leaves_the_old_file_and_no_other(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_section(path, small_section())
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(WriteFailed, match=r"000007\.vts: cannot write: No space left on device"):
        write_section(path, small_section(section_id=8))
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_file_is_durable_before_its_name_and_then_the_name(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events = []
    fsync, rename = os.fsync, Path.replace

    def recorded_fsync(descriptor: int) -> None:
        events.append(f"sync {Path(os.readlink(f'/proc/self/fd/{descriptor}')).suffix or 'folder'}")
        fsync(descriptor)

    def recorded_rename(self: Path, target: Path) -> Path:
        events.append(f"rename to {target.name}")
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", recorded_fsync)
    monkeypatch.setattr(Path, "replace", recorded_rename)
    write_section(path, small_section())
    assert events == ["sync .tmp", "rename to 000007.vts", "sync folder"]


def test_interrupt_leaves_the_old_file_and_no_other(path: Path) -> None:
    write_section(path, small_section())
    before = path.read_bytes()

    def interrupted() -> Iterable[bytes]:
        yield b"half"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replace_file(path, interrupted())
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_disk_that_gives_back_something_else_is_noticed(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def bad_disk(target: Path, pieces: Iterable[bytes]) -> None:
        data = bytearray(b"".join(bytes(piece) for piece in pieces))
        data[len(data) // 2] ^= 1
        target.write_bytes(data)

    monkeypatch.setattr(section_file, "replace_file", bad_disk)
    with pytest.raises(ChecksumMismatch):
        write_section(path, small_section())


def test_disk_that_gives_back_an_older_file_is_noticed(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_section(path, small_section())
    monkeypatch.setattr(section_file, "replace_file", lambda *_: None)
    with pytest.raises(ChecksumMismatch, match=r"SHA-256 read back: expected [0-9a-f]{64}, found [0-9a-f]{64}"):
        write_section(path, small_section(section_id=8))


# --- damage ----------------------------------------------------------------------------------------------------------


def test_flipped_bits_and_cuts_anywhere_are_found(path: Path, parts: VtsParts) -> None:
    data = parts.sealed()
    for place in range(0, len(data), 41):
        path.write_bytes(data[:place] + bytes([data[place] ^ (1 << place % 8)]) + data[place + 1 :])
        with pytest.raises(StorageError):
            verify_file(path)
    for length in range(0, len(data), 97):
        path.write_bytes(data[:length])
        with pytest.raises(StorageError):
            verify_file(path)


def _flipped(data: bytes, place: int) -> bytes:
    place %= len(data)
    return data[:place] + bytes([data[place] ^ 0x10]) + data[place + 1 :]


@pytest.mark.parametrize(
    ("damage", "error", "message"),
    [
        (lambda data: b"", BadMagic, "magic: expected .*, found b''"),
        (lambda data: b"\x89PNG" + data[4:], BadMagic, "magic: expected .*VTS.*, found .*PNG"),
        (lambda data: data[:20], TruncatedFile, "size: expected at least 92 bytes, found 20 bytes"),
        (lambda data: data[:-7], TruncatedFile, r"size in bytes: expected \d+, found \d+"),
        (lambda data: data + b"\0", TruncatedFile, r"size in bytes: expected \d+, found \d+"),
        (lambda data: _flipped(data, 8), ChecksumMismatch, "CRC-32 of prelude: expected [0-9a-f]{8}, found"),
        (lambda data: _flipped(data, 40), ChecksumMismatch, "CRC-32 of header"),
        (lambda data: _flipped(data, 257), ChecksumMismatch, "CRC-32 of column 'T_section_frame'"),
        (lambda data: _flipped(data, -80), ChecksumMismatch, "CRC-32 of index"),
        (lambda data: _flipped(data, -30), ChecksumMismatch, "CRC-32 of footer"),
        (lambda data: _flipped(data, -1), MalformedSection, "end mark: expected .*VTS-END.*, found"),
    ],
)
def test_kinds_of_damage(
    path: Path, parts: VtsParts, damage: Callable[[bytes], bytes], error: type[StorageError], message: str
) -> None:
    path.write_bytes(damage(parts.sealed()))
    with pytest.raises(error, match=rf"000007\.vts: {message}"):
        read_section(path)


def test_newer_version_is_told_from_damage(path: Path, parts: VtsParts) -> None:
    path.write_bytes(replace(parts, version=3).sealed())
    with pytest.raises(UnsupportedVersion, match="format version: expected one of 1, 2, found 3"):
        read_section(path)


def test_what_cannot_be_opened(tmp_path: Path) -> None:
    with pytest.raises(UnreadableFile, match="cannot open: No such file"):
        read_section(tmp_path / "none.vts")
    with pytest.raises(UnreadableFile, match="kind: expected a regular file"):
        read_section(tmp_path)
    os.mkfifo(tmp_path / "pipe.vts")
    with pytest.raises(UnreadableFile, match="kind: expected a regular file"):
        read_section(tmp_path / "pipe.vts")


# --- wrong content under right checksums -----------------------------------------------------------------------------


def _row(name: str, place: int, value: object) -> Callable[[VtsParts], VtsParts]:
    def change(parts: VtsParts) -> VtsParts:
        rows = parts.rows
        next(row for row in rows if row[0] == name)[place] = value
        return parts.with_rows(rows)

    return change


@pytest.mark.parametrize(
    "header",
    [b"\x82\xa1b\x01\xa1a\x01", b"\x82\xa1a\x01\xa1a\x01", b"\x81\xa1a\xcc\x01", b"\x81\xa1a\xca\x3f\x80\x00\x00"],
)
def test_headers_in_another_form(path: Path, header: bytes) -> None:
    # Unsorted, repeated, an integer in two bytes, a float in 32 bits.
    body = bytes(64 - 32 - len(header))
    path.write_bytes(VtsParts(header=header, body=body, index=b"\x90").sealed())
    with pytest.raises(MalformedSection, match=r"header: is not in the one form that writers give it"):
        read_columns(path)
    path.write_bytes(VtsParts(header=b"\x81\xa1a\x01", body=bytes(28), index=b"\x90").sealed())
    assert read_columns(path) == ({"a": 1}, {})


def test_wrong_sha256_under_right_crcs(path: Path, parts: VtsParts) -> None:
    path.write_bytes(replace(parts, sha256=bytes(32)).sealed())
    with pytest.raises(ChecksumMismatch, match=r"000007\.vts: SHA-256: expected 0{64}, found [0-9a-f]{64}"):
        read_section(path)
    assert list(read_columns(path, ["depth"])[1]) == ["depth"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_row("depth", 0, "../depth"), r"expected a name like .*, found '\.\./depth'"),
        (_row("depth", 0, "color"), "expected names sorted and unique"),
        (_row("depth", 1, "object"), "found 'depth', 'object'"),
        (_row("depth", 1, "uint32"), r"'depth': uint32 \[20\] takes 80 bytes, which 40 of raw are not"),
        (_row("depth", 2, [2**60]), "'depth': expected at most 8 sizes, found"),
        (_row("depth", 2, [-20]), "'depth': expected at most 8 sizes, found"),
        (_row("depth", 2, [0, 2**60]), "'depth': expected at most 8 sizes, found"),
        (_row("depth", 2, [1] * 9), "'depth': expected at most 8 sizes, found"),
        (_row("depth", 2, [40]), r"'depth': uint16 \[40\] takes 80 bytes, which 40 of raw are not"),
        (_row("depth", 2, 20), r"expected \[name, dtype, shape"),
        (_row("depth", 3, 64), "offset of column 'depth': expected"),
        (_row("depth", 4, 2**62), r"'depth': uint16 \[20\] takes 40 bytes, which \d+ of raw are not"),
        (_row("depth", 4, -1), r"'depth': uint16 \[20\] takes 40 bytes, which -1 of raw are not"),
        (_row("depth", 6, True), r"expected \[name, dtype, shape"),
        (_row("depth", 5, "lz4"), "a codec of raw, .*, found 'depth', 'uint16', 'lz4'"),
        (lambda parts: _row("depth", 5, "planes_lz4")(replace(parts, version=1)), "a codec of raw, found"),
        (_row("depth", 5, "planes_lz4"), "column 'depth': (not an LZ4 block|expected 40 bytes in the LZ4 block)"),
        (_row("depth", 5, "quantised_lz4"), "column 'depth': expected float32 and a grid"),
        (lambda parts: parts.with_rows(parts.rows[:-1]), "offset of the index: expected"),
        (lambda parts: parts.with_rows([*parts.rows[:-1], []]), r"expected \[name, dtype"),
        (lambda parts: parts.with_rows({"a": 1}), "expected a list of at most 256 columns"),
        (lambda parts: replace(parts, index=b""), "index: is not msgpack"),
        (lambda parts: replace(parts, index=b"\xdd\xff\xff\xff\xff" * 20), "index: is not msgpack"),
        (lambda parts: replace(parts, index=b"\x91" * 2000 + b"\xc0"), "index: is not msgpack|nested more"),
        (lambda parts: replace(parts, index=b"\x91" * 20 + b"\xc0"), "index: .* nested more than 16 deep"),
        (lambda parts: replace(parts, index=bytes(65537)), "index: expected at most 65536 bytes that end at"),
        (lambda parts: replace(parts, index=b"\xdc\x00\x0f" + parts.index[1:]), "index: is not in the one form"),
        (lambda parts: replace(parts, header=b"\xc0" + parts.header[1:]), "header: is not msgpack"),
        (lambda parts: replace(parts, header_length=60000), "header length: expected at most"),
        (lambda parts: replace(parts, index_length=2**32 - 1), "index: expected at most 65536 bytes that end at"),
        (lambda parts: replace(parts, index_offset=2**64 - 1), "index: expected at most 65536 bytes that end at"),
        (lambda parts: replace(parts, body=parts.body + bytes(64)), "offset of the index: expected"),
        (lambda parts: replace(parts, body=parts.body[:-1] + b"\1"), r"gap at \d+: expected"),
    ],
)
def test_structure_that_breaks_the_format(
    path: Path, parts: VtsParts, change: Callable[[VtsParts], VtsParts], message: str
) -> None:
    path.write_bytes(change(parts).sealed())
    with pytest.raises(MalformedSection, match=rf"000007\.vts: .*{message}"):
        read_section(path)


def _header(key: str, value: object) -> Callable[[VtsParts], VtsParts]:
    return lambda parts: parts.with_header(lambda header: header.__setitem__(key, value))


def _camera(key: str, value: object) -> Callable[[VtsParts], VtsParts]:
    return lambda parts: parts.with_header(lambda header: header["camera"].__setitem__(key, value))


def _first(name: str, value: object) -> Callable[[VtsParts], VtsParts]:
    def change(parts: VtsParts) -> VtsParts:
        array = getattr(small_section(), name).copy()
        array.flat[0] = value
        return parts.with_column_bytes(name, array.tobytes())

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_header("kind", "journal"), "kind: expected 'section', found 'journal'"),
        (_header("section_id", -1), "section_id: expected an integer of 0 or more, found -1"),
        (_header("section_id", True), "header: expected .*'section_id': 'int'.*, found .*'section_id': 'bool'"),
        (_header("camera", None), "header: expected"),
        (_header("depth_scale_m", 0.0), "depth_scale_m: expected a positive number, found 0.0"),
        (_header("depth_factor", -1.0), "depth_factor: expected a positive number, found -1.0"),
        (_header("depth_factor", 1), "header: expected .*'depth_factor': 'float'"),
        (_header("extra", 1), "header: expected .*, found .*'extra': 'int'"),
        (lambda parts: parts.with_header(lambda header: header.pop("kind")), "header: expected .*'kind': 'str'"),
        (lambda parts: parts.with_header(lambda header: header["camera"].pop("fx")), "camera: expected .*'fx'"),
        (_camera("fx", -5.5), "not a camera"),
        (_camera("width", 7), r"view_depth: expected uint16 \(2, 4, 7\), found uint16 \(2, 4, 6\)"),
        (_camera("width", 2**40), "expected at most 2.31 pixels"),
        (_first("frame_ids", 31), "frame_ids: expected numbers of 0 or more that strictly increase"),
        (_first("frame_ids", -1), "frame_ids: expected numbers of 0 or more that strictly increase"),
        (_first("T_world_section", 2.0), "T_world_section: expected a rigid motion"),
        (_first("T_section_frame", np.nan), "T_section_frame: expected a rigid motion in row 0"),
        (_first("exposure_gain", 0.0), "exposure_gain: expected positive numbers"),
        (_first("exposure_gain", np.inf), "exposure_gain: expected positive numbers"),
        (_first("exposure_offset", np.nan), "exposure_offset: expected finite numbers"),
        (_first("T_section_frame", 1e200), "T_section_frame: expected a rigid motion in row 0"),
        (_first("frame_index", 3), "frame_index: expected 0 to 2, found 0 to 3"),
        (_first("pixel", 24), "pixel: expected 0 to 23, found 1 to 24"),
        (_first("pixel", -1), "pixel: expected 0 to 23, found -1 to 23"),
        (_first("subpixel", 5), "subpixel: expected 0 to 4, found 0 to 5"),
        (_first("depth", 0), "depth: expected 1 to 65535, found 0 to"),
        (_first("color", np.inf), "color: expected finite numbers"),
        (_first("log_radius", -np.inf), "log_radius: expected finite numbers"),
        (_first("opacity_logit", np.nan), "opacity_logit: expected finite numbers"),
        (_first("view_index", 1), "view_index: expected rows that strictly increase"),
        (_first("view_index", 3), "view_index: expected 0 to 2, found 1 to 3"),
    ],
)
def test_content_that_breaks_the_format(
    path: Path, parts: VtsParts, change: Callable[[VtsParts], VtsParts], message: str
) -> None:
    path.write_bytes(change(parts).sealed())
    with pytest.raises(MalformedSection, match=rf"000007\.vts: .*{message}"):
        read_section(path)

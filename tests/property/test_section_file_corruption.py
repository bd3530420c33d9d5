"""Damage is always found and never crashes; files with right checksums are refused, or are proper files."""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import pytest
from helpers.sections import small_section
from helpers.vts_bytes import VtsParts, parts_of
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from vtslam.storage.errors import StorageError
from vtslam.storage.section_file import read_section, write_section

_BUDGET = settings(max_examples=120, deadline=None, derandomize=True, database=None)
_MEMORY_BOUND = 4 * 2**20  # the sample has 3 KB; msgpack may take 256 list slots for each of its 1024 levels

Reader = Callable[[bytes], None]


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("sample") / "a.vts"
    write_section(path, small_section(), "raw")
    return path.read_bytes()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("corruption")


@_BUDGET
@given(data=st.data())
def test_random_damage_is_found(sample: bytes, folder: Path, data: st.DataObject) -> None:
    damaged = bytearray(sample)
    for _ in range(data.draw(st.integers(0, 4), label="bytes changed")):
        damaged[data.draw(st.integers(0, len(sample) - 1))] = data.draw(st.integers(0, 255))
    start = data.draw(st.integers(0, len(damaged)), label="cut from")
    cut = data.draw(st.sampled_from((0, 0, 1, 4, 64, len(damaged))), label="bytes cut")
    del damaged[start : start + cut]
    damaged[start:start] = data.draw(st.binary(max_size=3), label="bytes put in")
    assume(bytes(damaged) != sample)
    path = folder / "damaged.vts"
    path.write_bytes(damaged)
    with pytest.raises(StorageError, match=r"damaged\.vts"):
        read_section(path)


def _refused_or_proper(path: Path, content: bytes) -> None:
    """Reading ``content`` raises StorageError, or gives a record whose file is ``content``; with little memory."""
    path.write_bytes(content)
    tracemalloc.start()
    try:
        record = read_section(path)
    except StorageError:
        return
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < _MEMORY_BOUND
    again = path.with_name("again.vts")
    write_section(again, record, "raw")
    assert again.read_bytes() == content


_numbers = st.sampled_from((-(2**63), -1, 0, 1, 2, 3, 4, 20, 24, 63, 64, 80, 2**16, 2**31, 2**32, 2**62, 2**63 - 1))
_odd = st.none() | st.booleans() | _numbers | st.floats() | st.text(max_size=5) | st.binary(max_size=5)
_anything = st.recursive(
    _odd,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
_dtypes = st.sampled_from(("int8", "uint16", "int32", "float32", "float64", "complex64", "object", "<u2", "O", ""))


def _changed_rows(rows: list[Any], data: st.DataObject) -> object:
    """The index with one to three of its parts changed."""
    for _ in range(data.draw(st.integers(1, 3))):
        number, field = data.draw(st.integers(0, len(rows) - 1)), data.draw(st.integers(0, 6))
        match data.draw(st.sampled_from(("value", "number", "dtype", "shape", "swap", "drop", "repeat"))):
            case "value":
                rows[number][field] = data.draw(_anything)
            case "number":
                rows[number][data.draw(st.sampled_from((3, 4, 6)))] = data.draw(_numbers)
            case "dtype":
                rows[number][1] = data.draw(_dtypes)
            case "shape":
                rows[number][2] = data.draw(st.lists(_numbers, max_size=9))
            case "swap":
                rows[number], rows[0] = rows[0], rows[number]
            case "drop":
                rows[number : number + 1] = []
            case "repeat":
                rows.insert(number, list(rows[number]))
        if not rows or any(len(row) != 7 for row in rows):
            break
    return rows


@_BUDGET
@given(data=st.data())
def test_wrong_index_under_right_checksums(sample: bytes, folder: Path, data: st.DataObject) -> None:
    parts = parts_of(sample)
    _refused_or_proper(folder / "index.vts", parts.with_rows(_changed_rows(parts.rows, data)).sealed())


@_BUDGET
@given(data=st.data())
def test_wrong_header_under_right_checksums(sample: bytes, folder: Path, data: st.DataObject) -> None:
    def change(header: dict[str, Any]) -> None:
        part = header["camera"] if data.draw(st.booleans()) else header
        part[data.draw(st.sampled_from(sorted(part)))] = data.draw(_anything)

    _refused_or_proper(folder / "header.vts", parts_of(sample).with_header(change).sealed())


@_BUDGET
@given(data=st.data())
def test_wrong_columns_under_right_checksums(sample: bytes, folder: Path, data: st.DataObject) -> None:
    parts = parts_of(sample)
    row = data.draw(st.sampled_from(parts.rows))
    place, value = data.draw(st.integers(0, row[4] - 1)), data.draw(st.integers(0, 255))
    content = bytearray(small_section().columns()[row[0]].tobytes())
    content[place] = value
    _refused_or_proper(folder / "column.vts", parts.with_column_bytes(row[0], bytes(content)).sealed())


_sizes = st.none() | st.sampled_from((0, 1, 31, 32, 64, 2**16, 2**16 + 1, 2**31, 2**32 - 1))
_wide_sizes = _sizes | st.sampled_from((2**40, 2**63, 2**64 - 1))
_packed = st.one_of(
    st.none(),
    st.binary(max_size=64),
    _anything.map(msgpack.packb),
    st.sampled_from((b"\x91", b"\xdc\x0f\xff", b"\xdd\x7f\xff\xff\xff", b"\xdf\xff\xff\xff\xff")).map(
        lambda b: b * 2000
    ),
)


@_BUDGET
@given(
    header=_packed,
    index=_packed,
    version=st.sampled_from((0, 2, 2, 2, 3, 2**32 - 1)),
    header_length=_sizes,
    file_size=st.none() | _wide_sizes,
    index_offset=_wide_sizes,
    index_length=_sizes,
)
def test_wrong_sizes_and_bytes_under_right_checksums(
    sample: bytes, folder: Path, header: bytes | None, index: bytes | None, **sizes: int | None
) -> None:
    parts = parts_of(sample)
    parts = replace(
        parts,
        header=parts.header if header is None else header,
        index=parts.index if index is None else index,
        **sizes,  # type: ignore[arg-type]
    )
    _refused_or_proper(folder / "sizes.vts", parts.sealed())


def test_parts_are_those_of_the_sample(sample: bytes) -> None:
    # Otherwise the tests above would only ever meet wrong checksums.
    parts: VtsParts = parts_of(sample)
    assert parts.sealed() == sample
    assert parts.with_rows(parts.rows).with_header(lambda header: None).sealed() == sample

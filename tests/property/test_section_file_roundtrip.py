"""Whatever columns and header are written come back bit by bit, from bytes that depend on the content alone."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from helpers.vts_bytes import parts_of
from hypothesis import given, settings
from hypothesis import strategies as st

from vtslam.storage.section_file import read_columns, write_columns

_DTYPES = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64")


@st.composite
def _arrays(draw: st.DrawFn) -> npt.NDArray[Any]:
    """Arrays of every type and up to 4 axes, any bits, also views that are not contiguous."""
    dtype = np.dtype(draw(st.sampled_from(_DTYPES)))
    shape = tuple(draw(st.lists(st.integers(0, 4), max_size=4)))
    bits = np.random.default_rng(draw(st.integers(0, 2**32))).bytes(int(np.prod(shape)) * dtype.itemsize)
    array = np.frombuffer(bits, dtype).reshape(shape)
    return array.T if draw(st.booleans()) else array


_names = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,10}", fullmatch=True)
_text = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), max_size=8)
_leaves = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False, allow_infinity=False)
)
_values = st.recursive(
    _leaves | _text, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_text, inner, max_size=3), max_leaves=8
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("roundtrip")


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(
    header=st.dictionaries(_text, _values, max_size=4),
    columns=st.dictionaries(_names, _arrays(), max_size=5),
    data=st.data(),
)
def test_columns_come_back(
    folder: Path, header: dict[str, Any], columns: dict[str, npt.NDArray[Any]], data: st.DataObject
) -> None:
    path = folder / "a.vts"
    write_columns(path, header, columns)
    found_header, found = read_columns(path)
    assert found_header == header
    assert {name: (a.dtype, a.shape, a.tobytes()) for name, a in found.items()} == {
        name: (a.dtype, a.shape, a.tobytes()) for name, a in columns.items()
    }
    content = path.read_bytes()
    assert parts_of(content).sealed() == content

    order = data.draw(st.permutations(sorted(columns)))
    write_columns(path, dict(reversed(header.items())), {name: columns[name] for name in order})
    assert path.read_bytes() == content

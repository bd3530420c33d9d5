"""Codecs of sections: what is kept exactly, how far off the rest is, what cannot be stored, packing again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.sections import assert_same_section, small_section, surface_section
from hypothesis import given, settings
from hypothesis import strategies as st

from vtslam.storage import _coder
from vtslam.storage.column_codecs import DIFFERENCES, PLANES, QUANTISED, ColumnCodec, decode_column, encode_column
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.errors import MalformedSection
from vtslam.storage.section_codecs import SECTION_CODECS, SectionCodec
from vtslam.storage.section_file import (
    column_bytes,
    decode_section,
    encode_section,
    read_columns,
    read_section,
    write_section,
)
from vtslam.storage.section_record import SectionRecord

NAME = Path("section")
LEARNED = ("color", "log_radius", "opacity_logit")


def through(record: SectionRecord, codec: SectionCodec, grid: DenseGrid | None = None) -> SectionRecord:
    return decode_section(encode_section(record, codec, name=NAME, grid=grid), name=NAME)


def assert_same_but_learned(found: SectionRecord, expected: SectionRecord) -> None:
    assert found.header() == expected.header()
    for name, array in expected.columns().items():
        if name not in LEARNED:
            assert getattr(found, name).tobytes() == array.tobytes(), name


def angles(record: SectionRecord) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return 2.0 * np.arctan(np.exp(0.5 * record.opacity_logit.astype(np.float64)))


@pytest.mark.parametrize("codec", ["raw", "lossless"])
def test_exact_codecs_keep_every_bit(codec: SectionCodec) -> None:
    assert_same_section(through(surface_section(), codec), surface_section())


@pytest.mark.parametrize("codec", SECTION_CODECS)
def test_sections_without_gaussians_or_views(codec: SectionCodec) -> None:
    for record in (
        small_section(num_gaussians=0),
        small_section(num_views=0),
        small_section(num_gaussians=0, num_views=0),
    ):
        assert_same_but_learned(through(record, codec), record if codec != "dense" else in_order(record))


def in_order(record: SectionRecord) -> SectionRecord:
    """The record with its Gaussians as the dense form orders them."""
    order = np.lexsort((record.subpixel, record.pixel, record.subpixel > 0, record.frame_index))
    names = ("frame_index", "pixel", "subpixel", "depth", *LEARNED)
    return replace(record, **{name: getattr(record, name)[order] for name in names})


def test_fast_rounds_finely() -> None:
    record = surface_section()
    found = through(record, "fast")
    assert_same_but_learned(found, record)
    for name, step in (("color", 1 / 256), ("log_radius", 1 / 64), ("opacity_logit", 1 / 32)):
        error = np.abs(getattr(found, name).astype(np.float64) - getattr(record, name)).max()
        assert 0 < error < 0.501 * step, name


def test_fast_holds_values_of_any_range() -> None:
    record = surface_section()
    color = record.color.copy()
    color[0] = [-3000.0, 0.0, 5000.0]
    error = np.abs(through(replace(record, color=color), "fast").color - color).max()
    assert error < 0.51 * 8000 / 65534


def test_dense_keeps_ties_and_rounds_to_its_grid() -> None:
    record, grid = surface_section(), DenseGrid()
    found = through(record, "dense")
    assert_same_but_learned(found, record)
    assert np.abs(angles(found) - angles(record)).max() <= 0.5 * grid.opacity + 1e-3
    scale = np.where(angles(found) < grid.fainter, 4, np.where(angles(found) < grid.faint, 2, 1))
    radius_error = np.abs(found.log_radius - record.log_radius)
    assert (radius_error <= 0.5 * grid.radius * scale + 1e-5).all()
    luma = np.abs((found.color - record.color) @ np.array([0.25, 0.5, 0.25]))
    assert (luma <= 0.5 * grid.luma * scale + 1e-6).all()
    assert (np.abs(found.color - record.color).max(axis=1) <= (0.5 * grid.luma + grid.chroma) * scale).all()
    assert set(scale) == {1, 2, 4}


def test_dense_is_stable_and_much_smaller() -> None:
    record = surface_section(frames=6, width=64, height=48)
    sizes = {codec: len(encode_section(record, codec, name=NAME)) for codec in SECTION_CODECS}
    assert sizes["raw"] > sizes["lossless"] > sizes["fast"] > 2 * sizes["dense"]
    finer, coarser = (len(encode_section(record, "dense", name=NAME, grid=DenseGrid().coarser(f))) for f in (0.5, 2.0))
    assert finer > sizes["dense"] > coarser
    once = encode_section(record, "dense", name=NAME)
    assert encode_section(record, "dense", name=NAME) == once


def test_dense_puts_gaussians_in_the_order_of_the_mapper() -> None:
    record = small_section()
    assert_same_but_learned(through(record, "dense"), in_order(record))


def test_dense_refuses_what_it_cannot_hold() -> None:
    record = surface_section()
    twice = replace(record, pixel=np.where(np.arange(record.num_gaussians) == 1, record.pixel[0], record.pixel))
    with pytest.raises(
        MalformedSection, match="section: cannot be written: Gaussians are doubled, missing or out of order"
    ):
        encode_section(twice, "dense", name=NAME)
    color = record.color.copy()
    color[3] = 1e30
    with pytest.raises(MalformedSection, match="an attribute is too large for the dense form"):
        encode_section(replace(record, color=color), "dense", name=NAME)


def test_files_are_packed_again(tmp_path: Path) -> None:
    path = tmp_path / "000005.vts"
    write_section(path, surface_section())
    before = path.stat().st_size
    write_section(path, read_section(path), "dense")
    assert read_columns(path)[0]["codec"] == "dense"
    assert path.stat().st_size < before / 2
    assert_same_but_learned(read_section(path), surface_section())
    dense = read_section(path)
    write_section(path, dense, "raw")
    assert "codec" not in read_columns(path)[0]
    assert_same_section(read_section(path), dense)


def test_bytes_of_columns() -> None:
    data = encode_section(surface_section(), "dense", name=NAME)
    stored = column_bytes(data, name=NAME)
    assert {"gaussian_stream", "view_stream", "frame_ids"} <= set(stored)
    assert "color" not in stored
    assert 0.3 * len(data) < sum(stored.values()) < len(data)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(seed=st.integers(0, 2**32), shape=st.lists(st.integers(0, 20), min_size=1, max_size=3), kind=st.integers(0, 3))
def test_columns_come_back_from_every_codec(seed: int, shape: list[int], kind: int) -> None:
    random = np.random.default_rng(seed)
    dtype = np.dtype(("uint8", "int16", "float32", "int64")[kind])
    # A walk, which gains from differences; noise would be stored as it is.
    walk = np.cumsum(random.integers(-2, 3, shape), axis=0)
    array = np.ascontiguousarray((walk / 8 if dtype.kind == "f" else walk).astype(dtype))
    for name in (PLANES, DIFFERENCES, *((QUANTISED,) if kind == 2 else ())):
        used, data = encode_column(array, ColumnCodec(name=name, step=1 / 8))
        found = decode_column(data, used, array.dtype, array.shape)
        assert found.shape == array.shape
        if name == QUANTISED:
            assert np.allclose(found, array, rtol=0, atol=1e-5)
        else:
            assert found.tobytes() == array.tobytes()


@settings(max_examples=30, deadline=None, derandomize=True, database=None)
@given(seed=st.integers(0, 2**32), largest=st.sampled_from((0, 1, 300, 65535)), smooth=st.booleans())
def test_depth_images_come_back(seed: int, largest: int, smooth: bool) -> None:
    random = np.random.default_rng(seed)
    images = random.integers(0, largest + 1, (2, 7, 9)).astype(np.int32)
    if smooth:
        images = np.sort(images, axis=2)
    data = _coder.encode_depth_images(images, largest)
    assert np.array_equal(_coder.decode_depth_images(data, images.shape, largest).reshape(images.shape), images)
    with pytest.raises(ValueError, match="bytes are left"):
        _coder.decode_depth_images(data + b"\0", images.shape, largest)

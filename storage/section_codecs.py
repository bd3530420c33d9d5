"""The ways a section can be stored, and the columns that each of them writes (docs/format-section.md, 5)."""

from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy.typing as npt

from vtslam.storage.column_codecs import DIFFERENCES, PLANES, QUANTISED, RAW, ColumnCodec
from vtslam.storage.dense_section import DENSE_COLUMNS, GAUSSIAN_COLUMNS, DenseGrid, dense_columns, gaussian_columns
from vtslam.storage.section_record import SectionRecord

SectionCodec = Literal["raw", "lossless", "fast", "dense"]
SECTION_CODECS: tuple[SectionCodec, ...] = get_args(SectionCodec)
ROUNDING_CODECS: tuple[SectionCodec, ...] = ("fast", "dense")

AnyArray = npt.NDArray[Any]
_CODEC_KEY, _GRID_KEY = "codec", "grid"
_FAST_STEPS = {"color": 1.0 / 256.0, "log_radius": 1.0 / 64.0, "opacity_logit": 1.0 / 32.0}


def encoded_record(
    record: SectionRecord, codec: SectionCodec, grid: DenseGrid | None = None
) -> tuple[dict[str, Any], dict[str, AnyArray], dict[str, ColumnCodec]]:
    """Header, columns and how to store each column.

    Args:
        record: The section.
        codec: ``raw`` and ``lossless`` keep every bit, ``fast`` rounds attributes finely, ``dense`` to ``grid``.
        grid: Used by ``dense``; None for the usual one.

    Raises:
        ValueError: The codec cannot hold this section.
    """
    header, columns = record.header(), record.columns()
    if codec != "raw":
        header[_CODEC_KEY] = codec
    if codec == "dense":
        header[_GRID_KEY], dense = dense_columns(record, DenseGrid() if grid is None else grid)
        columns = {name: array for name, array in columns.items() if name not in GAUSSIAN_COLUMNS} | dense
    return header, columns, {name: _column_codec(name, array, codec) for name, array in columns.items()}


def decoded_record(header: Mapping[str, Any], columns: Mapping[str, AnyArray]) -> SectionRecord:
    """The section of a header and columns, which are not trusted; raises ValueError."""
    rest = dict(header)
    codec = rest.pop(_CODEC_KEY, "raw")
    if codec not in SECTION_CODECS or (codec == "raw" and _CODEC_KEY in header):
        raise ValueError(f"codec: expected one of {', '.join(SECTION_CODECS[1:])} or no key, found {codec!r:.40}")
    if codec == "dense":
        gaussians = gaussian_columns(rest, rest.pop(_GRID_KEY, None), columns)
        columns = {name: array for name, array in columns.items() if name not in DENSE_COLUMNS} | gaussians
    return SectionRecord.from_parts(rest, columns)


def codec_of_header(header: Mapping[str, Any]) -> str:
    """The codec that a file's header names."""
    return str(header.get(_CODEC_KEY, "raw"))


def _column_codec(name: str, array: AnyArray, codec: SectionCodec) -> ColumnCodec:
    if codec == "raw" or name in ("gaussian_stream", "view_stream"):
        return ColumnCodec(name=RAW)
    if codec == "fast" and name in _FAST_STEPS:
        return ColumnCodec(name=QUANTISED, step=_FAST_STEPS[name])
    return ColumnCodec(name=PLANES if array.dtype.kind == "f" or array.itemsize == 1 else DIFFERENCES)

"""Codecs of single columns: how an array's elements become the bytes of a section file (docs/format-section.md, 4)."""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import lz4.block
import numpy as np
import numpy.typing as npt

from vtslam.storage import _coder

AnyArray = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]

RAW, PLANES, DIFFERENCES, QUANTISED = "raw", "planes_lz4", "differences_lz4", "quantised_lz4"

_LZ4_MOST_RATIO = 255  # an LZ4 block cannot hold more than so many times its own length
_GRID = struct.Struct("<ff")  # low, step
_MOST_LEVEL = 65535
_MOST_INTERLEAVED = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnCodec:
    """How to store a column: the codec's id, and for ``quantised_lz4`` the grid's step."""

    name: str
    step: float = 0.0


def encode_column(array: AnyArray, codec: ColumnCodec) -> tuple[str, Bytes]:
    """The id and bytes uint8 [L] of a contiguous little-endian array; raw if the codec asked for gains nothing.

    Raises:
        ValueError: The codec cannot hold the array.
    """
    raw = array.reshape(-1).view(np.uint8)
    if codec.name == RAW:
        return RAW, raw
    if codec.name == QUANTISED:
        encoded = _quantised(array, codec.step)
    else:
        stride = _stride(array.shape) if codec.name == DIFFERENCES else 0
        encoded = _compressed(_coder.split_planes(raw, array.itemsize, stride))
    return (codec.name, np.frombuffer(encoded, np.uint8)) if len(encoded) < raw.size else (RAW, raw)


def most_decoded_bytes(codec: str, length: int) -> int:
    """What a chunk of ``length`` bytes can at most decode to: a limit on what a reader believes."""
    return length if codec == RAW else 2 * _LZ4_MOST_RATIO * length


def decode_column(data: Bytes, codec: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> AnyArray:
    """A new array from its stored bytes.

    Raises:
        ValueError: They are not those of such an array.
    """
    if codec == RAW:
        flat: AnyArray = data
    else:
        flat = _DECODERS[codec](data, dtype, shape)
    return flat.view(dtype).reshape(shape)


def _stride(shape: tuple[int, ...]) -> int:
    """The element a difference is taken to lies so far back: one row of narrow tables, else one element."""
    return shape[-1] if len(shape) == 2 and 1 <= shape[-1] <= _MOST_INTERLEAVED else 1


def _compressed(data: Bytes) -> bytes:
    out: bytes = lz4.block.compress(data, store_size=False)
    return out


def _decompressed(data: Bytes, size: int) -> Bytes:
    if size > _LZ4_MOST_RATIO * data.size:
        raise ValueError(f"{data.size} bytes of LZ4 cannot hold {size}")
    try:
        out = lz4.block.decompress(data, uncompressed_size=size)
    except lz4.block.LZ4BlockError as error:
        raise ValueError(f"not an LZ4 block: {error}") from error
    if len(out) != size:
        raise ValueError(f"expected {size} bytes in the LZ4 block, found {len(out)}")
    return np.frombuffer(out, np.uint8)


def _decode_planes(data: Bytes, dtype: np.dtype[Any], shape: tuple[int, ...], *, stride: int = 0) -> Bytes:
    size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    return _coder.join_planes(_decompressed(data, size), dtype.itemsize, stride)


def _decode_differences(data: Bytes, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Bytes:
    return _decode_planes(data, dtype, shape, stride=_stride(shape))


def _quantised(array: AnyArray, step: float) -> bytes:
    """Differences of grid levels, behind the grid; the step grows if 16 bits do not span the values."""
    if array.dtype != np.float32:
        raise ValueError(f"only float32 can be quantised, not {array.dtype}")
    if not array.size:
        return _GRID.pack(0.0, step)
    low, high = np.float32(array.min()), np.float32(array.max())
    if not (np.isfinite(low) and np.isfinite(high) and np.isfinite(high - low)):
        raise ValueError("only finite numbers of a finite range can be quantised")
    step = float(np.float32(max(step, float(high - low) / (_MOST_LEVEL - 1))))
    levels = _coder.quantise(array.reshape(-1), float(low), step)
    return _GRID.pack(low, step) + _compressed(_coder.split_planes(levels.view(np.uint8), 2, _stride(array.shape)))


def _decode_quantised(data: Bytes, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Bytes:
    if dtype != np.float32 or data.size < _GRID.size:
        raise ValueError("expected float32 and a grid")
    low, step = _GRID.unpack(data[: _GRID.size].tobytes())
    if not (np.isfinite(low) and np.isfinite(step) and step > 0):
        raise ValueError(f"expected a grid of finite numbers and a positive step, found {low}, {step}")
    count = int(np.prod(shape, dtype=np.int64))
    planes = _decompressed(data[_GRID.size :], 2 * count)
    levels = _coder.join_planes(planes, 2, _stride(shape)).view(np.uint16)
    return _coder.dequantise(levels, low, step).view(np.uint8)


_DECODERS: dict[str, Callable[[Bytes, np.dtype[Any], tuple[int, ...]], Bytes]] = {
    PLANES: _decode_planes,
    DIFFERENCES: _decode_differences,
    QUANTISED: _decode_quantised,
}
CODECS = (RAW, *_DECODERS)

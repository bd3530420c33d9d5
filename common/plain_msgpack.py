"""Plain values as msgpack bytes in one form only: equal values give equal bytes, and nothing else is accepted."""

import math
from typing import Any

import msgpack  # type: ignore[import-untyped]

MAX_BYTES = 65536  # of one packed value: bounds what a claimed length inside it can cost
_MAX_DEPTH = 16
_MAX_ITEMS = 256  # of one array or map: unpacking takes memory for a claimed length before it sees the items


def pack(value: Any) -> bytes:  # noqa: ANN401
    """The bytes of a value made of None, bool, int64, finite float, str, list, tuple and dict with str keys.

    Raises:
        ValueError: A value of another type or range, nested too deep, or more than 65536 bytes.
    """
    data: bytes = msgpack.packb(_plain(value, "", 0), use_bin_type=True)
    if len(data) > MAX_BYTES:
        raise ValueError(f"takes {len(data)} bytes, at most {MAX_BYTES} fit")
    return data


def unpack(data: bytes) -> Any:  # noqa: ANN401
    """The value of :func:`pack`'s bytes; arrays come back as lists.

    Raises:
        ValueError: The bytes are not what :func:`pack` would have written.
    """
    if len(data) > MAX_BYTES:
        raise ValueError(f"takes {len(data)} bytes, at most {MAX_BYTES} are read")
    value, length = unpack_first(data)
    if length != len(data):
        raise ValueError(f"is not msgpack as this format allows it ({len(data) - length} bytes after the value)")
    if pack(value) != data:
        raise ValueError("is not in the one form that writers give it (sorted keys, shortest encodings)")
    return value


def unpack_first(data: bytes | memoryview) -> tuple[Any, int]:
    """The first value of ``data`` in any encoding, and the bytes it takes; at most 65536 are looked at.

    Nothing is said of the types inside; the memory taken is bounded by the bytes there, not by lengths they claim.

    Raises:
        ValueError: The bytes are not msgpack, are cut off, or claim more items or longer text than allowed.
    """
    unpacker = msgpack.Unpacker(
        max_buffer_size=MAX_BYTES,
        max_array_len=_MAX_ITEMS,
        max_map_len=_MAX_ITEMS,
        max_str_len=MAX_BYTES,
        max_bin_len=0,
        max_ext_len=0,
    )
    try:
        unpacker.feed(data[:MAX_BYTES])
        return unpacker.unpack(), unpacker.tell()
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise ValueError(f"is not msgpack as this format allows it ({error or type(error).__name__})") from error


def _plain(value: Any, place: str, depth: int) -> Any:  # noqa: ANN401
    """``value`` with sorted maps, or a ValueError that says where it is not plain."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"{place} is nested more than {_MAX_DEPTH} deep")
    if value is None or isinstance(value, bool):
        return value
    if type(value) is int and -(2**63) <= value < 2**63:
        return value
    if type(value) is float and math.isfinite(value):
        return value
    if type(value) is str and value.isprintable():
        return value
    if isinstance(value, list | tuple) and len(value) <= _MAX_ITEMS:
        return [_plain(item, f"{place}[{number}]", depth + 1) for number, item in enumerate(value)]
    if (
        type(value) is dict
        and len(value) <= _MAX_ITEMS
        and all(type(key) is str and key.isprintable() for key in value)
    ):
        return {key: _plain(value[key], f"{place}.{key}", depth + 1) for key in sorted(value)}
    raise ValueError(
        f"{place or 'the value'} must be null, a boolean, a 64-bit integer, a finite number, printable text, a list "
        f"or a map with text keys, got {type(value).__name__} {value!r:.60}"
    )

"""Messages as bytes: a msgpack record in an envelope, then raw pixels if the message has any.

The envelope is the array ``[protocol, kind, version, origin, sequence, publish_time_ns, fields]``. ``origin`` is drawn
anew by every publisher, ``sequence`` counts its messages from 0. Reading is strict: unknown versions, missing and
unknown fields, other types, shapes and ranges, and bytes too many or too few are refused with a `MessageError`.
"""

from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast, get_args, get_type_hints

import msgpack  # type: ignore[import-untyped]
import numpy as np

from vtslam.common import plain_msgpack
from vtslam.common.geometry.camera import Camera
from vtslam.common.messages.base import Message, Pixels
from vtslam.common.messages.rules import MAX_INT, Fields, MessageError, Reason, Rule, refused

PROTOCOL = 1

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Envelope(Generic[M]):
    """A message with what the bus knows of it.

    Attributes:
        message: The record.
        origin: Drawn anew by every publisher.
        sequence: Counts the publisher's messages, from 0.
        publish_time_ns: The publisher's wall clock.
    """

    message: M
    origin: int
    sequence: int
    publish_time_ns: int


_Layout = tuple[Fields, dict[str, Pixels]]
_LAYOUTS: dict[type[Message], _Layout] = {}  # worked out once for each kind


def _layout(kind: type[Message]) -> _Layout:
    """The rules of a message's fields, and those fields that travel as raw bytes."""
    if kind not in _LAYOUTS:
        _LAYOUTS[kind] = _layout_of(kind)
    return _LAYOUTS[kind]


def _layout_of(kind: type[Message]) -> _Layout:
    rules: dict[str, Rule] = {}
    pixels: dict[str, Pixels] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if name in ("KIND", "VERSION"):
            continue
        mark = get_args(hint)[1]
        if isinstance(mark, Pixels):
            pixels[name] = mark
        else:
            rules[name] = cast(Rule, mark)
    return Fields(kind, rules), pixels


def encode(message: Message, *, origin: int, sequence: int, publish_time_ns: int, max_bytes: int) -> bytes:
    """The bytes of a message.

    Args:
        message: The record.
        origin: See `Envelope`; 0 to 2**63 - 1, like the next two.
        sequence: See `Envelope`.
        publish_time_ns: See `Envelope`.
        max_bytes: Most bytes its topic takes.

    Raises:
        MessageError: A field holds what readers would refuse, or the message is too long.
    """
    fields, pixels = _layout(type(message))
    plain = fields.to_plain(message, "")
    head: bytes = msgpack.packb(
        [PROTOCOL, message.KIND, message.VERSION, origin, sequence, publish_time_ns, plain], use_bin_type=True
    )
    data = b"".join([head, *(_raw(message, name, mark) for name, mark in pixels.items())])
    if len(data) > max_bytes:
        raise MessageError(Reason.TOO_LONG, "", expected=f"at most {max_bytes} bytes", found=str(len(data)))
    return data


def decode(kind: type[M], data: bytes, *, max_bytes: int) -> Envelope[M]:
    """The message in ``data``; images are read-only views of it.

    Raises:
        MessageError: It is not a message of this kind; the error names the field.
    """
    if len(data) > max_bytes:
        raise MessageError(Reason.TOO_LONG, "", expected=f"at most {max_bytes} bytes", found=str(len(data)))
    try:
        envelope, length = plain_msgpack.unpack_first(data)
    except ValueError as error:
        raise MessageError(Reason.NOT_MSGPACK, "", expected="msgpack", found=str(error)) from error
    origin, sequence, publish_time_ns, plain = _opened(kind, envelope)
    fields, pixels = _layout(kind)
    values = fields.values(plain, "")
    values |= _images(values, pixels, memoryview(data)[length:])
    try:
        message = kind(**values)
    except ValueError as error:
        raise MessageError(Reason.VALUE, "", expected="a consistent record", found=str(error)) from error
    return Envelope(message=message, origin=origin, sequence=sequence, publish_time_ns=publish_time_ns)


def _opened(kind: type[Message], envelope: Any) -> tuple[int, int, int, Any]:  # noqa: ANN401
    if type(envelope) is not list or len(envelope) != 7:
        raise MessageError(Reason.ENVELOPE, "", expected="an array of 7 values", found=f"{envelope!r:.60}")
    protocol, name, version, *counts, plain = envelope
    if type(protocol) is not int or protocol != PROTOCOL:
        raise MessageError(Reason.VERSION, "protocol", expected=str(PROTOCOL), found=f"{protocol!r:.60}")
    if name != kind.KIND:
        raise MessageError(Reason.KIND, "kind", expected=kind.KIND, found=f"{name!r:.60}")
    if type(version) is not int or version != kind.VERSION:
        raise MessageError(Reason.VERSION, "version", expected=str(kind.VERSION), found=f"{version!r:.60}")
    for place, count in zip(("origin", "sequence", "publish_time_ns"), counts, strict=True):
        if type(count) is not int or not 0 <= count <= MAX_INT:
            raise MessageError(Reason.ENVELOPE, place, expected="an integer in 0..2**63-1", found=f"{count!r:.60}")
    return counts[0], counts[1], counts[2], plain


def _raw(message: Message, name: str, mark: Pixels) -> bytes:
    image, shape = getattr(message, name), mark.shape(getattr(message, "camera"))  # noqa: B009
    if not isinstance(image, np.ndarray) or image.dtype != mark.dtype or image.shape != shape:
        raise refused(name, f"{mark.dtype} {list(shape)}", image)
    return image.tobytes()


def _images(values: dict[str, Any], pixels: dict[str, Pixels], tail: memoryview) -> dict[str, Any]:
    camera: Camera | None = values.get("camera")
    shapes = {} if camera is None else {name: mark.shape(camera) for name, mark in pixels.items()}
    sizes = {name: int(np.prod(shape)) * pixels[name].dtype.itemsize for name, shape in shapes.items()}
    if len(tail) != sum(sizes.values()):
        raise MessageError(
            Reason.TAIL, "", expected=f"{sum(sizes.values())} bytes after the record", found=str(len(tail))
        )
    images: dict[str, Any] = {}
    start = 0
    for name, shape in shapes.items():
        part = tail[start : start + sizes[name]]
        images[name] = np.frombuffer(part, pixels[name].dtype).reshape(shape)
        start += sizes[name]
    return images

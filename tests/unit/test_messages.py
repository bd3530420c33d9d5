"""Messages keep their content; what readers must not take is refused, and the error says where it is."""

from dataclasses import fields, replace
from typing import TypeVar

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
from helpers.bus_messages import MAX_BYTES, RANDOM, descriptor, status

from vtslam.common.messages import Message, MessageError, Reason, decode, encode
from vtslam.common.messages.mapping import FrameCommitted, TrackedPose
from vtslam.common.messages.sensing import FrameDescriptor, FramePixels
from vtslam.common.topics import QUERIES, TOPICS
from vtslam.services.mapper.state import CommitRecord
from vtslam.services.tracker.state import TrackResult

M = TypeVar("M", bound=Message)


def _bytes(message: Message) -> bytes:
    return encode(message, origin=5, sequence=6, publish_time_ns=7, max_bytes=MAX_BYTES)


def _random(kind: type[M], seed: int = 0) -> M:
    message = RANDOM[kind](np.random.default_rng(seed))
    assert isinstance(message, kind)
    return message


def _changed(kind: type[Message], field: str, value: object) -> bytes:
    """The bytes of a good message with one field replaced, past the writer's own checks."""
    data = _bytes(_random(kind))
    unpacker = msgpack.Unpacker()
    unpacker.feed(data)
    envelope = unpacker.unpack()
    envelope[6][field] = value
    packed: bytes = msgpack.packb(envelope)
    return packed + data[unpacker.tell() :]


def _refusal(kind: type[Message], data: bytes, max_bytes: int = MAX_BYTES) -> MessageError:
    with pytest.raises(MessageError) as caught:
        decode(kind, data, max_bytes=max_bytes)
    return caught.value


def test_every_message_of_the_topic_table_is_tried_here() -> None:
    kinds = {topic.message for topic in TOPICS} | {kind for query in QUERIES for kind in (query.request, query.reply)}
    assert kinds == set(RANDOM)
    assert len({kind.KIND for kind in kinds}) == len(kinds)


@pytest.mark.parametrize("kind", RANDOM, ids=lambda kind: kind.KIND)
def test_a_message_comes_back_with_the_same_values(kind: type[Message]) -> None:
    for seed in range(20):
        message = _random(kind, seed)
        envelope = decode(kind, _bytes(message), max_bytes=MAX_BYTES)
        assert (envelope.origin, envelope.sequence, envelope.publish_time_ns) == (5, 6, 7)
        assert type(envelope.message) is kind
        for field in fields(kind):  # type: ignore[arg-type]
            sent, came = getattr(message, field.name), getattr(envelope.message, field.name)
            if isinstance(sent, np.ndarray):
                assert (came.dtype, came.shape) == (sent.dtype, sent.shape)
                assert came.tobytes() == sent.tobytes()
        assert _bytes(envelope.message) == _bytes(message)


@pytest.mark.parametrize("kind", RANDOM, ids=lambda kind: kind.KIND)
def test_every_cut_message_is_refused(kind: type[Message]) -> None:
    data = _bytes(_random(kind))
    for length in range(0, len(data), max(1, len(data) // 50)):
        assert _refusal(kind, data[:length]).reason in (Reason.NOT_MSGPACK, Reason.TAIL)
    assert _refusal(kind, data + b"\0").reason is Reason.TAIL


def _not_a_rotation() -> list[float]:
    flat = np.eye(4).ravel()
    flat[0] = 1.01
    return [float(x) for x in flat]


@pytest.mark.parametrize(
    ("kind", "field", "value", "place"),
    [
        (FrameDescriptor, "frame_id", -1, "frame_id"),
        (FrameDescriptor, "frame_id", 2**63, "frame_id"),
        (FrameDescriptor, "frame_id", 1.0, "frame_id"),
        (FrameDescriptor, "frame_id", True, "frame_id"),
        (FrameDescriptor, "width", 8193, "width"),
        (FrameDescriptor, "condition", "strange", "condition"),
        (FrameDescriptor, "condition", 1, "condition"),
        (TrackedPose, "T_world_camera", [float("nan")] * 16, "T_world_camera"),
        (TrackedPose, "T_world_camera", [0.0] * 15, "T_world_camera"),
        (TrackedPose, "T_world_camera", [0] * 16, "T_world_camera"),
        (TrackedPose, "T_world_camera", _not_a_rotation(), "T_world_camera"),
        (TrackedPose, "covariance", [float("inf")] * 36, "covariance"),
        (TrackedPose, "covariance", [float(i) for i in range(36)], "covariance"),
        (TrackedPose, "covariance", [float(x) for x in (-np.eye(6)).ravel()], "covariance"),
        (TrackedPose, "quality", {"renders": 1}, "quality"),
        (TrackedPose, "state", "excellent", "state"),
        (FrameCommitted, "block", "../../etc/passwd", "block"),
        (FrameCommitted, "block", "a" * 65, "block"),
        (FrameCommitted, "loss", float("nan"), "loss"),
        (FrameCommitted, "held_out", 1, "held_out"),
        (FrameCommitted, "exposure", {"gain": [0.1] * 3, "offset": [0.0] * 3}, "exposure.gain"),
        (FrameCommitted, "exposure", {"gain": [1e300] * 3, "offset": [0.0] * 3}, "exposure.gain"),
        (FramePixels, "depth_scale_m", 0.0, "depth_scale_m"),
        (FramePixels, "camera", None, "camera"),
    ],
)  # fmt: skip
def test_a_wrong_value_is_refused_by_its_name(kind: type[Message], field: str, value: object, place: str) -> None:
    error = _refusal(kind, _changed(kind, field, value))
    assert error.place == place
    assert error.reason is (Reason.FIELDS if value == {"renders": 1} else Reason.VALUE)
    assert place in str(error)


def test_unknown_versions_kinds_and_fields_are_told_apart() -> None:
    data = _bytes(descriptor(1))
    envelope = msgpack.unpackb(data)

    def with_value(place: int, value: object) -> bytes:
        packed: bytes = msgpack.packb([*envelope[:place], value, *envelope[place + 1 :]])
        return packed

    assert _refusal(FrameDescriptor, with_value(0, 2)).reason is Reason.VERSION
    assert _refusal(FrameDescriptor, with_value(1, "frame_pixels")).reason is Reason.KIND
    assert _refusal(FrameDescriptor, with_value(2, 2)).reason is Reason.VERSION
    assert _refusal(FrameDescriptor, with_value(2, True)).reason is Reason.VERSION
    assert _refusal(FrameDescriptor, with_value(3, -1)).place == "origin"
    assert _refusal(FrameDescriptor, with_value(6, {**envelope[6], "more": 1})).reason is Reason.FIELDS
    assert _refusal(FrameDescriptor, msgpack.packb(envelope[:6])).reason is Reason.ENVELOPE
    assert _refusal(FrameDescriptor, data, max_bytes=len(data) - 1).reason is Reason.TOO_LONG
    assert _refusal(FrameDescriptor, b"").reason is Reason.NOT_MSGPACK


def test_claimed_lengths_take_no_memory() -> None:
    for claim in (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff"):
        assert _refusal(FrameDescriptor, claim + bytes(64)).reason is Reason.NOT_MSGPACK
    assert _refusal(FrameDescriptor, b"\x91" * 60000).reason is Reason.NOT_MSGPACK


def test_an_image_larger_than_its_record_says_is_refused() -> None:
    camera = {"width": 8192, "height": 8192, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
    assert _refusal(FramePixels, _changed(FramePixels, "camera", camera)).reason is Reason.TAIL


@pytest.mark.parametrize(
    "message",
    [
        descriptor(1, epoch=np.int64(3)),
        descriptor(1, condition="ok"),
        status("Tracker"),
        status("tracker", detail="two\nlines"),
        status("tracker", counters={f"n{i}": i for i in range(65)}),
        status("tracker", gauges={"rate": float("nan")}),
        replace(_random(TrackedPose), T_world_camera=np.full((4, 4), np.nan)),
        replace(_random(TrackedPose), T_world_camera=np.eye(4, dtype=np.float32)),
        replace(_random(FramePixels), depth=np.zeros((1, 1), np.uint8)),
    ],
)
def test_a_writer_refuses_what_readers_would(message: Message) -> None:
    with pytest.raises(MessageError):
        _bytes(message)


def test_results_of_the_cores_fit_into_messages() -> None:
    def names(kind: type[object]) -> set[str]:
        return {field.name for field in fields(kind)}  # type: ignore[arg-type]

    assert names(TrackResult) <= names(TrackedPose)
    assert names(CommitRecord) <= names(FrameCommitted)

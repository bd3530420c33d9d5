"""Messages of recordings as plain records: from Foxglove's protobuf schemas and from ROS 2."""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.exceptions import McapError
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_ros2.decoder import DecoderFactory

from vtslam.common.external_pose import ExternalPose
from vtslam.common.geometry import se3
from vtslam.storage.errors import MalformedRecording
from vtslam.storage.recording import topics
from vtslam.storage.recording.mcap_file import Topic

_ROS, _FOXGLOVE = ("cdr", "ros2msg"), (MessageEncoding.Protobuf, SchemaEncoding.Protobuf)
_DAMAGED = (ValueError, TypeError, AttributeError, LookupError, OverflowError, RecursionError, struct.error,
            NotImplementedError, McapError, DecodeError)  # fmt: skip

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageMessage:
    """An image as it was recorded.

    Attributes:
        stamp_ns: Capture time.
        frame_id: Coordinate frame of its camera.
        encoding: Of raw pixels ("rgb8", "16UC1", ...); empty for compressed images.
        format: Of compressed images ("png", "jpeg", ...); empty for raw pixels.
        width, height, step: Of raw pixels, the last in bytes per row; 0 for compressed images.
        is_bigendian: Byte order of raw pixels.
        data: Pixels or file.
    """

    stamp_ns: int
    frame_id: str
    data: bytes
    encoding: str = ""
    format: str = ""
    width: int = 0
    height: int = 0
    step: int = 0
    is_bigendian: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationMessage:
    """Intrinsics as they were recorded, pixel centres at whole numbers.

    Attributes:
        width, height: Of the image.
        matrix: K, 9 numbers by rows.
        distortion: Coefficients of the lens distortion, maybe none.
        rectified: The left 3x3 of P, 9 numbers by rows; zeros if not given.
    """

    width: int
    height: int
    matrix: tuple[float, ...]
    distortion: tuple[float, ...]
    rectified: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransformMessage:
    """``T_parent_child`` float64 [4,4] at a time."""

    stamp_ns: int
    parent: str
    child: str
    T_parent_child: npt.NDArray[np.float64]


def is_image(topic: Topic) -> bool:
    """Whether a topic has images that can be read."""
    return _name(topic) in _IMAGES


def is_calibration(topic: Topic) -> bool:
    """Whether a topic has intrinsics."""
    return _name(topic) in _CALIBRATIONS


def is_transform(topic: Topic) -> bool:
    """Whether a topic has transforms."""
    return _name(topic) in _TRANSFORMS


def image_of(topic: Topic, data: bytes, where: str) -> ImageMessage:
    """An image message; raises MalformedRecording."""
    return _decoded(_IMAGES[_name(topic)], topic, data, where)


def calibration_of(topic: Topic, data: bytes, where: str) -> CalibrationMessage:
    """A message of intrinsics; raises MalformedRecording."""
    return _decoded(_CALIBRATIONS[_name(topic)], topic, data, where)


def transforms_of(topic: Topic, data: bytes, where: str) -> list[TransformMessage]:
    """The transforms of one message; raises MalformedRecording."""
    return _decoded(_TRANSFORMS[_name(topic)], topic, data, where)


def prior_of(data: bytes, where: str) -> ExternalPose:
    """A pose prior that this program wrote; raises MalformedRecording."""

    def read(plain: Any) -> ExternalPose:  # noqa: ANN401
        pose, covariance = (np.array(plain[key], np.float64) for key in ("T_world_camera", "covariance"))
        return ExternalPose(T_world_camera=pose.reshape(4, 4), covariance=covariance.reshape(6, 6))

    try:
        return read(json.loads(data))
    except _DAMAGED as error:
        raise MalformedRecording(f"{where}: expected a {topics.PRIOR_SCHEMA}, found {error}") from error


def stamp_of(topic: Topic, data: bytes, where: str) -> int:
    """The capture time (ns) of an image message, without looking at the rest of it if that can be."""
    if _is_ros(topic):
        if len(data) < 12:
            raise MalformedRecording(f"{where}: expected a message with a header, found {len(data)} bytes")
        try:
            return _time_ns(*struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4))
        except ValueError as error:
            raise MalformedRecording(f"{where}: expected a time stamp, found {error}") from error
    return image_of(topic, data, where).stamp_ns


def _decoded(read: Callable[[Any], T], topic: Topic, data: bytes, where: str) -> T:
    try:
        return read(_message(topic, data))
    except _DAMAGED as error:
        kind = _name(topic)
        raise MalformedRecording(f"{where}: expected a {kind}, found {type(error).__name__}: {error}") from error


def _message(topic: Topic, data: bytes) -> Any:  # noqa: ANN401
    assert topic.schema is not None
    if not _is_ros(topic):
        return _PROTOBUF[topic.schema.name].FromString(data)
    return _ros_decoder(topic)(data)


@lru_cache(maxsize=64)
def _ros_decoder(topic: Topic) -> Callable[[bytes], Any]:
    """The decoder that follows from a topic's schema; making one takes longer than using it."""
    decoder = DecoderFactory().decoder_for(topic.channel.message_encoding, topic.schema)
    assert decoder is not None
    return decoder


def _name(topic: Topic) -> str:
    """The kind of message by its name in a schema of a known encoding; empty for others."""
    if topic.schema is None:
        return ""
    encodings = topic.channel.message_encoding, topic.schema.encoding
    known = encodings == _FOXGLOVE if topic.schema.name in _PROTOBUF else encodings == _ROS
    return topic.schema.name if known else ""


def _is_ros(topic: Topic) -> bool:
    return topic.channel.message_encoding == _ROS[0]


def _time_ns(seconds: int, nanoseconds: int) -> int:
    time_ns = seconds * 10**9 + nanoseconds
    if seconds < 0 or not 0 <= nanoseconds < 10**9 or time_ns >= 2**63:
        raise ValueError(f"a time of {seconds} s and {nanoseconds} ns")
    return time_ns


def _ros_time_ns(message: Any) -> int:  # noqa: ANN401
    return _time_ns(message.header.stamp.sec, message.header.stamp.nanosec)


def _protobuf_time_ns(stamp: Timestamp) -> int:
    return _time_ns(stamp.seconds, stamp.nanos)


def _ros_image(message: Any) -> ImageMessage:  # noqa: ANN401
    return ImageMessage(
        stamp_ns=_ros_time_ns(message),
        frame_id=message.header.frame_id,
        encoding=message.encoding,
        width=message.width,
        height=message.height,
        step=message.step,
        is_bigendian=bool(message.is_bigendian),
        data=bytes(message.data),
    )


def _ros_compressed(message: Any) -> ImageMessage:  # noqa: ANN401
    return ImageMessage(
        stamp_ns=_ros_time_ns(message),
        frame_id=message.header.frame_id,
        format=message.format,
        data=bytes(message.data),
    )


def _foxglove_image(message: RawImage) -> ImageMessage:
    return ImageMessage(
        stamp_ns=_protobuf_time_ns(message.timestamp),
        frame_id=message.frame_id,
        encoding=message.encoding,
        width=message.width,
        height=message.height,
        step=message.step,
        data=message.data,
    )


def _foxglove_compressed(message: CompressedImage) -> ImageMessage:
    return ImageMessage(
        stamp_ns=_protobuf_time_ns(message.timestamp),
        frame_id=message.frame_id,
        format=message.format,
        data=message.data,
    )


def _ros_calibration(message: Any) -> CalibrationMessage:  # noqa: ANN401
    return _calibration(message.width, message.height, message.k, message.d, message.p)


def _foxglove_calibration(message: CameraCalibration) -> CalibrationMessage:
    return _calibration(message.width, message.height, message.K, message.D, message.P)


def _calibration(width: int, height: int, k: Any, d: Any, p: Any) -> CalibrationMessage:  # noqa: ANN401
    matrix, distortion, projection = (tuple(float(value) for value in values) for values in (k, d, p))
    if len(matrix) != 9 or len(projection) not in (0, 12) or not np.isfinite([*matrix, *distortion, *projection]).all():
        raise ValueError(f"a K of {len(matrix)} and a P of {len(projection)} finite numbers")
    rectified = (*projection[0:3], *projection[4:7], *projection[8:11]) if projection else (0.0,) * 9
    return CalibrationMessage(width=width, height=height, matrix=matrix, distortion=distortion, rectified=rectified)


def _ros_transforms(message: Any) -> list[TransformMessage]:  # noqa: ANN401
    return [
        TransformMessage(
            stamp_ns=_ros_time_ns(each),
            parent=each.header.frame_id.lstrip("/"),
            child=each.child_frame_id.lstrip("/"),
            T_parent_child=_motion(each.transform.translation, each.transform.rotation),
        )
        for each in message.transforms
    ]


def _foxglove_transform(message: FrameTransform) -> list[TransformMessage]:
    return [
        TransformMessage(
            stamp_ns=_protobuf_time_ns(message.timestamp),
            parent=message.parent_frame_id,
            child=message.child_frame_id,
            T_parent_child=_motion(message.translation, message.rotation),
        )
    ]


def _foxglove_transforms(message: FrameTransforms) -> list[TransformMessage]:
    return [transform for each in message.transforms for transform in _foxglove_transform(each)]


def _motion(translation: Any, rotation: Any) -> npt.NDArray[np.float64]:  # noqa: ANN401
    t, q = [translation.x, translation.y, translation.z], rotation
    if not np.isfinite(t).all():
        raise ValueError(f"a translation {t}")
    return se3.from_quaternion_xyzw(t, [q.x, q.y, q.z, q.w])


_PROTOBUF: dict[str, type[Any]] = {
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.RawImage": RawImage,
    "foxglove.CameraCalibration": CameraCalibration,
    "foxglove.FrameTransform": FrameTransform,
    "foxglove.FrameTransforms": FrameTransforms,
}
_IMAGES: dict[str, Callable[[Any], ImageMessage]] = {
    "sensor_msgs/msg/Image": _ros_image,
    "sensor_msgs/msg/CompressedImage": _ros_compressed,
    "foxglove.RawImage": _foxglove_image,
    "foxglove.CompressedImage": _foxglove_compressed,
}
_CALIBRATIONS: dict[str, Callable[[Any], CalibrationMessage]] = {
    "sensor_msgs/msg/CameraInfo": _ros_calibration,
    "foxglove.CameraCalibration": _foxglove_calibration,
}
_TRANSFORMS: dict[str, Callable[[Any], list[TransformMessage]]] = {
    "tf2_msgs/msg/TFMessage": _ros_transforms,
    "foxglove.FrameTransform": _foxglove_transform,
    "foxglove.FrameTransforms": _foxglove_transforms,
}

"""Writes a recording: frames, poses and events as MCAP in Foxglove's schemas (docs/format-recording.md)."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import cv2
import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.storage.errors import WriteFailed
from vtslam.storage.recording import topics

CHUNK_BYTES = 1 << 20
_PNG_LEVEL = 1
_MAX_CHUNK_BYTES = 1 << 40  # chunks end when this module says so
_PRIOR_SCHEMA = {
    "type": "object",
    "title": topics.PRIOR_SCHEMA,
    "description": "T_world_camera [4,4] and covariance [6,6] of a left twist on T_camera_world, m and rad, by rows",
    "properties": {
        "T_world_camera": {"type": "array", "items": {"type": "number"}},
        "covariance": {"type": "array", "items": {"type": "number"}},
    },
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ColorFormat:
    """How colour is kept; depth is always lossless.

    Attributes:
        name: "png" keeps every bit, "jpeg" is several times smaller.
        jpeg_quality: 1 to 100.
    """

    name: Literal["png", "jpeg"] = "png"
    jpeg_quality: int = 95


class RecordingWriter:
    """An MCAP file that grows; a context manager. Complete chunks of about 1 MiB are synced to disk as they end.

    Messages have the capture time of their frame as log time, in lossless recordings to the nanosecond.

    Args:
        path: The file to make.
        family: The settings family that fits the frames.
        color: How colour is kept.

    Raises:
        WriteFailed: It cannot be made, or is there already.
    """

    def __init__(self, path: Path, *, family: str, color: ColorFormat | None = None) -> None:
        self.path, self._family, self._color = path, family, color or ColorFormat()
        try:
            self._file = open(path, "xb")  # noqa: SIM115 (closed in close)
        except FileExistsError:
            raise WriteFailed(f"{path}: expected no such file yet, found one") from None
        except OSError as error:
            raise self._failed(error) from error
        self._writer = Writer(self._file, chunk_size=_MAX_CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(topics.PROFILE, library="vtslam")
        self._channels: dict[str, int] = {}
        self._pending_bytes = 0
        self.num_frames = 0

    def add_frame(self, frame: Frame) -> None:
        """Images, calibration and pose prior of a frame; raises WriteFailed."""
        stamp, camera = _stamp(frame.capture_time_ns), topics.CAMERA
        if not self._channels:
            scale = {topics.DEPTH_SCALE_KEY: repr(float(frame.depth_scale_m)), topics.FAMILY_KEY: self._family}
            self._add_channel(topics.COLOR, CompressedImage, {})
            self._add_channel(topics.DEPTH, CompressedImage, scale)
        color = CompressedImage(timestamp=stamp, frame_id=camera, format=self._color.name, data=self._color_of(frame))
        depth = CompressedImage(timestamp=stamp, frame_id=camera, format="png", data=_png(frame.depth))
        calibration = _calibration(frame.camera, stamp)
        for topic, message in ((topics.COLOR, color), (topics.DEPTH, depth), (topics.CALIBRATION, calibration)):
            self._add(topic, message, frame.capture_time_ns, frame.frame_id)
        self._add_prior(frame)
        self.num_frames += 1
        if self.num_frames == 1:
            self.sync()  # so that a file with a frame plays, whenever its writer is killed
        self._end_chunk_if_full()

    def add_pose(self, frame_id: int, capture_time_ns: int, T_world_camera: npt.NDArray[np.float64]) -> None:
        """The committed pose of a frame, float64 [4,4], as pose and as transform; raises WriteFailed."""
        stamp, t, q = _stamp(capture_time_ns), T_world_camera[:3, 3], se3.quaternion_xyzw(T_world_camera)
        translation = Vector3(x=float(t[0]), y=float(t[1]), z=float(t[2]))
        rotation = Quaternion(x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))
        pose = PoseInFrame(
            timestamp=stamp, frame_id=topics.WORLD, pose=Pose(position=translation, orientation=rotation)
        )
        transform = FrameTransform(
            timestamp=stamp,
            parent_frame_id=topics.WORLD,
            child_frame_id=topics.CAMERA,
            translation=translation,
            rotation=rotation,
        )
        self._add(topics.POSE, pose, capture_time_ns, frame_id)
        self._add(topics.TRANSFORMS, transform, capture_time_ns, frame_id)
        self._end_chunk_if_full()

    def add_event(self, service: str, text: str, *, wall_time_ns: int, capture_time_ns: int, warning: bool) -> None:
        """Something that happened at ``wall_time_ns``, filed under the time of a frame; raises WriteFailed."""
        level = Log.WARNING if warning else Log.INFO
        event = Log(timestamp=_stamp(wall_time_ns), level=level, name=service, message=text)
        self._add(topics.EVENTS, event, capture_time_ns, 0)
        self._end_chunk_if_full()

    def sync(self) -> None:
        """End the chunk in progress, and wait until all is on disk; raises WriteFailed."""
        try:
            self._writer.flush()
            os.fdatasync(self._file.fileno())
        except OSError as error:
            raise self._failed(error) from error
        self._pending_bytes = 0

    def close(self) -> None:
        """Write the index and end the file, or remove it if there was no frame; further calls do nothing.

        Raises:
            WriteFailed: It cannot be written.
        """
        if self._file.closed:
            return
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._failed(error) from error
        finally:
            self._file.close()
        if self.num_frames == 0:
            self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _color_of(self, frame: Frame) -> bytes:
        if self._color.name == "png":
            return _png(frame.rgb[..., ::-1])
        return _encoded(".jpg", frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self._color.jpeg_quality])

    def _add_prior(self, frame: Frame) -> None:
        prior = frame.pose_prior
        if prior is None:
            return
        if topics.PRIOR not in self._channels:
            schema = json.dumps(_PRIOR_SCHEMA).encode()
            schema_id = self._writer.register_schema(topics.PRIOR_SCHEMA, SchemaEncoding.JSONSchema, schema)
            self._channels[topics.PRIOR] = self._writer.register_channel(topics.PRIOR, MessageEncoding.JSON, schema_id)
        values = {
            "T_world_camera": prior.T_world_camera.ravel().tolist(),
            "covariance": prior.covariance.ravel().tolist(),
        }
        self._write(topics.PRIOR, json.dumps(values).encode(), frame.capture_time_ns, frame.frame_id)

    def _add(self, topic: str, message: Message, log_time_ns: int, sequence: int) -> None:
        if topic not in self._channels:
            self._add_channel(topic, type(message), {})
        self._write(topic, message.SerializeToString(), log_time_ns, sequence)

    def _add_channel(self, topic: str, kind: type[Message], metadata: dict[str, str]) -> None:
        schema_id = register_schema(self._writer, kind)
        self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.Protobuf, schema_id, metadata)

    def _write(self, topic: str, data: bytes, log_time_ns: int, sequence: int) -> None:
        self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns, sequence % 2**32)
        self._pending_bytes += len(data)

    def _end_chunk_if_full(self) -> None:
        if self._pending_bytes >= CHUNK_BYTES:
            self.sync()

    def _failed(self, error: OSError) -> WriteFailed:
        return WriteFailed(f"{self.path}: cannot write: {error.strerror}")


def _calibration(camera: Camera, stamp: Timestamp) -> CameraCalibration:
    """Foxglove's convention has pixel centres at whole numbers."""
    cx, cy = camera.cx - 0.5, camera.cy - 0.5
    return CameraCalibration(
        timestamp=stamp,
        frame_id=topics.CAMERA,
        width=camera.width,
        height=camera.height,
        K=[camera.fx, 0.0, cx, 0.0, camera.fy, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[camera.fx, 0.0, cx, 0.0, 0.0, camera.fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def _stamp(time_ns: int) -> Timestamp:
    return Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9)


def _png(image: npt.NDArray[np.generic]) -> bytes:
    return _encoded(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])


def _encoded(suffix: str, image: npt.NDArray[np.generic], parameters: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, np.ascontiguousarray(image), parameters)
    assert done, "OpenCV writes uint8 and uint16 images"
    return bytes(data)

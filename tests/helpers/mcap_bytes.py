"""MCAP files that tests write: recordings of synthetic frames, ROS 2 bags, and files that are wrong on purpose."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from helpers.recordings import camera_path, images
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from vtslam.common.external_pose import ExternalPose
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.storage.recording.writer import ColorFormat, RecordingWriter

CAMERA = Camera(width=48, height=36, fx=40.0, fy=42.0, cx=24.25, cy=18.125)
STEP_NS = 33_333_333
TYPES = get_typestore(Stores.ROS2_HUMBLE)


def frames(num_frames: int, *, priors: bool = False) -> list[Frame]:
    rgb, depth = images(num_frames, width=CAMERA.width, height=CAMERA.height)
    poses = camera_path(num_frames)
    covariance = np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]) / 7.0
    return [
        Frame(
            frame_id=index,
            capture_time_ns=1_700_000_000_000_000_000 + index * STEP_NS,
            rgb=rgb[index],
            depth=depth[index],
            depth_scale_m=1.0 / 6553.5,
            camera=CAMERA,
            pose_prior=ExternalPose(T_world_camera=poses[index], covariance=covariance) if priors else None,
        )
        for index in range(num_frames)
    ]


def write_recording(
    path: Path, recorded: Sequence[Frame], *, color: ColorFormat | None = None, finish: bool = True
) -> Path:
    """A recording of this program, with a pose for each frame; without ``finish`` it lacks its end."""
    writer = RecordingWriter(path, family="tum", color=color)
    for frame, T_world_camera in zip(recorded, camera_path(len(recorded)), strict=True):
        writer.add_frame(frame)
        writer.add_pose(frame.frame_id, frame.capture_time_ns, T_world_camera)
    writer.add_event("mapper", "section 0", wall_time_ns=1, capture_time_ns=recorded[-1].capture_time_ns, warning=False)
    if finish:
        writer.close()
    else:
        writer.sync()
        writer._file.close()
    return path


def record(opcode: int, content: bytes) -> bytes:
    """A record of an MCAP file."""
    return struct.pack("<BQ", opcode, len(content)) + content


def _stamp(time_ns: int) -> Any:  # noqa: ANN401
    return TYPES.types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)


def _header(time_ns: int, frame_id: str) -> Any:  # noqa: ANN401
    return TYPES.types["std_msgs/msg/Header"](stamp=_stamp(time_ns), frame_id=frame_id)


def _matrix(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, 0, camera.cx - 0.5, 0, camera.fy, camera.cy - 0.5, 0, 0, 1], np.float64)


@dataclass(slots=True)
class BagWriter:
    """A ROS 2 bag in one MCAP file, as rosbag2 writes them; messages are encoded by rosbags.

    Attributes:
        compression: Of its chunks.
        chunk_size: Of its chunks.
        use_chunking: Whether there are any.
    """

    compression: CompressionType = CompressionType.NONE
    chunk_size: int = 1 << 20
    use_chunking: bool = True
    _out: BytesIO = field(default_factory=BytesIO)
    _channels: dict[str, int] = field(default_factory=dict)
    _writer: Writer | None = None

    def add(self, topic: str, kind: str, message: Any, log_time_ns: int) -> None:  # noqa: ANN401
        if self._writer is None:
            self._writer = Writer(
                self._out,
                chunk_size=self.chunk_size,
                compression=self.compression,
                use_chunking=self.use_chunking,
            )
            self._writer.start("ros2", library="test")
        if topic not in self._channels:
            text, _ = TYPES.generate_msgdef(kind, ros_version=2)
            schema_id = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema_id)
        self._writer.add_message(
            self._channels[topic], log_time_ns, bytes(TYPES.serialize_cdr(message, kind)), log_time_ns
        )

    def add_image(self, topic: str, pixels: np.ndarray, encoding: str, time_ns: int, *, late_ns: int = 0) -> None:
        """A ``sensor_msgs/Image``, recorded ``late_ns`` after its time stamp."""
        height, width = pixels.shape[:2]
        data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
        message = TYPES.types["sensor_msgs/msg/Image"](
            header=_header(time_ns, "optical"),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=data.size // height,
            data=data,
        )
        self.add(topic, "sensor_msgs/msg/Image", message, time_ns + late_ns)

    def add_compressed(self, topic: str, data: bytes, image_format: str, time_ns: int) -> None:
        message = TYPES.types["sensor_msgs/msg/CompressedImage"](
            header=_header(time_ns, "optical"), format=image_format, data=np.frombuffer(data, np.uint8)
        )
        self.add(topic, "sensor_msgs/msg/CompressedImage", message, time_ns)

    def add_calibration(
        self,
        topic: str,
        camera: Camera,
        time_ns: int,
        *,
        distortion: Sequence[float] = (0.0,) * 5,
        rectified: Camera | None = None,
    ) -> None:
        """A ``sensor_msgs/CameraInfo``; P is that of ``rectified``, or else K."""
        k, p = _matrix(camera), _matrix(rectified or camera)
        roi = TYPES.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        message = TYPES.types["sensor_msgs/msg/CameraInfo"](
            header=_header(time_ns, "optical"),
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            d=np.array(distortion, np.float64),
            k=k,
            r=np.eye(3).ravel(),
            p=np.concatenate([p.reshape(3, 3), np.zeros((3, 1))], axis=1).ravel(),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )
        self.add(topic, "sensor_msgs/msg/CameraInfo", message, time_ns)

    def add_transform(self, topic: str, parent: str, child: str, T_parent_child: np.ndarray, time_ns: int) -> None:
        x, y, z, w = (float(value) for value in se3.quaternion_xyzw(T_parent_child))
        t = [float(value) for value in T_parent_child[:3, 3]]
        kinds = TYPES.types
        transform = kinds["geometry_msgs/msg/Transform"](
            translation=kinds["geometry_msgs/msg/Vector3"](x=t[0], y=t[1], z=t[2]),
            rotation=kinds["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        )
        stamped = kinds["geometry_msgs/msg/TransformStamped"](
            header=_header(time_ns, parent), child_frame_id=child, transform=transform
        )
        self.add(topic, "tf2_msgs/msg/TFMessage", kinds["tf2_msgs/msg/TFMessage"](transforms=[stamped]), time_ns)

    def add_frame(self, frame: Frame, *, apart_ns: int = 0) -> None:
        """Colour, depth ``apart_ns`` later, and intrinsics, raw and by the usual names."""
        time_ns = frame.capture_time_ns
        self.add_calibration("/camera/color/camera_info", frame.camera, time_ns)
        self.add_image("/camera/color/image_raw", frame.rgb, "rgb8", time_ns)
        self.add_image("/camera/aligned_depth_to_color/image_raw", frame.depth, "16UC1", time_ns + apart_ns)

    def write(self, path: Path, *, finish: bool = True) -> Path:
        assert self._writer is not None
        if finish:
            self._writer.finish()
        path.write_bytes(self._out.getvalue())
        return path

"""``mcap:FILE``: recordings of this program, and ROS 2 bags and others in MCAP files.

Colour and depth are two topics of images (``sensor_msgs/Image``, ``CompressedImage``, or Foxglove's), registered to
each other; intrinsics come from a ``CameraInfo`` or its like, poses from transforms. A file that was cut plays up to
its last whole chunk.
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.external_pose import ExternalPose
from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources import mcap_topics
from vtslam.services.sensor.sources import recording_files as files
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.mcap_poses import TransformPoses
from vtslam.services.sensor.sources.message_images import color_of, depth_of
from vtslam.storage.errors import StorageError
from vtslam.storage.recording import decoding, topics
from vtslam.storage.recording.mcap_file import McapFile, StoredMessage, Topic

_OPTIONS = ("color", "depth", "camera", "tolerance_ms", "stamp", "depth_scale", "distortion", "world")
_DEFAULT_TOLERANCE_MS = 15.0
_DEFAULT_UNITS_PER_M = 1000.0
_MAX_SIDE = 16384


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class McapRecording:
    """Paired images of an MCAP file (the `Source` protocol).

    Attributes:
        uri, family, camera, depth_scale_m: As in `Source`.
        file: The file.
        color, depth: The topics of images.
        prior: The topic of pose priors that this program recorded, or None.
        pairs: int64 [F,2]: which images are a frame.
        times_ns: int64 [F]: capture times, those of the colour images.
        world: The coordinate frame that poses refer to; None for the one that everything hangs on.
    """

    uri: str
    family: str
    camera: Camera
    depth_scale_m: float
    file: McapFile
    color: Topic
    depth: Topic
    prior: Topic | None
    pairs: npt.NDArray[np.int64]
    times_ns: npt.NDArray[np.int64]
    world: str | None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.pairs)

    def frame(self, index: int) -> Frame:
        """Frame ``index``, 0 to F-1.

        Raises:
            SourceError: An image is damaged, or not of the intrinsics' size.
            IndexError: There is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.uri}: frame {index} of {len(self)}")
        time_ns, size = int(self.times_ns[index]), (self.camera.width, self.camera.height)
        color_at, depth_at = (int(value) for value in self.pairs[index])
        with _as_source_error():
            color, color_place = self._image(self.color, color_at)
            depth, depth_place = self._image(self.depth, depth_at)
            prior = self._prior(time_ns)
        return Frame(
            frame_id=index,
            capture_time_ns=time_ns,
            rgb=color_of(color, size, color_place),
            depth=depth_of(depth, size, 1.0 / self.depth_scale_m, depth_place),
            depth_scale_m=self.depth_scale_m,
            camera=self.camera,
            pose_prior=prior,
        )

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        """None: a recording does not say which of its poses are true."""
        return None

    def pose_topics(self) -> list[str]:
        """Topics of transforms."""
        return [name for name, topic in self.file.topics.items() if decoding.is_transform(topic)]

    def poses(self, topic: str) -> Callable[[int], npt.NDArray[np.float64] | None] | None:
        """``T_world_camera`` at a time (ns) by a topic of transforms; None if there is no such topic.

        Raises:
            SourceError: Its transforms do not lead from the camera to the world.
        """
        if topic not in self.pose_topics():
            return None
        with _as_source_error():
            frame_id = self._image(self.color, int(self.pairs[0, 0]))[0].frame_id
            return TransformPoses(self.file, topic, frame_id, self.world).at

    def _image(self, topic: Topic, index: int) -> tuple[decoding.ImageMessage, str]:
        message = self.file.message(topic, index)
        where = _place(self.file, topic, message)
        return decoding.image_of(topic, message.data, where), where

    def _prior(self, time_ns: int) -> ExternalPose | None:
        if self.prior is None:
            return None
        at = int(np.searchsorted(self.prior.places[:, 0], time_ns))
        if at == len(self.prior) or self.prior.places[at, 0] != time_ns:
            return None
        message = self.file.message(self.prior, at)
        return decoding.prior_of(message.data, _place(self.file, self.prior, message))


def open_mcap(uri: SourceUri) -> McapRecording:
    """Open a recording.

    Options: ``color``, ``depth``, ``camera``: topics, found by their names unless given; ``tolerance_ms`` (15) between
    colour and depth; ``stamp=log`` to pair by the time of recording, not by the messages' headers; ``depth_scale``:
    units of 16-bit depth to a metre (1000); ``distortion=ignore``; ``fx fy cx cy`` (pixel centres at whole numbers);
    ``world``: the coordinate frame of poses.

    Raises:
        SourceError: The file is missing or damaged, or lacks a topic; images are checked when read.
    """
    files.check_options(uri, (*files.INTRINSICS_OPTIONS, *_OPTIONS))
    path = Path(os.path.abspath(os.path.expanduser(uri.path)))
    with _as_source_error():
        file = McapFile(path)
        if not file.topics:
            raise SourceError(
                f"{path}: expected recorded messages, found {'no whole chunk' if file.is_cut else 'none'}"
            )
        color = mcap_topics.chosen_topic(file, "color", uri.options.get("color"))
        depth = mcap_topics.chosen_topic(file, "depth", uri.options.get("depth"))
        facts = depth.channel.metadata
        is_own = topics.DEPTH_SCALE_KEY in facts
        if is_own:
            _refuse_options_of_others(uri, path)
        by_log_time = is_own or _choice(uri, "stamp", ("header", "log")) == "log"
        color_ns = mcap_topics.image_times_ns(file, color, by_log_time=by_log_time)
        depth_ns = mcap_topics.image_times_ns(file, depth, by_log_time=by_log_time)
        tolerance_ns = round(1e6 * files.positive_option(uri, "tolerance_ms", _DEFAULT_TOLERANCE_MS))
        pairs = mcap_topics.pairs(color_ns, depth_ns, 0 if is_own else tolerance_ns)
        if not len(pairs):
            raise SourceError(_no_pairs(path, color, color_ns, depth, depth_ns, tolerance_ns))
        return McapRecording(
            uri=str(replace(uri, path=str(path))),
            family=facts.get(topics.FAMILY_KEY, "tum") if is_own else "tum",
            camera=_camera(uri, file, color),
            depth_scale_m=_recorded_scale(path, facts) if is_own else 1.0 / _units_per_m(uri),
            file=file,
            color=color,
            depth=depth,
            prior=file.topics.get(topics.PRIOR) if is_own else None,
            pairs=pairs,
            times_ns=color_ns[pairs[:, 0]],
            world=uri.options.get("world"),
        )


def _refuse_options_of_others(uri: SourceUri, path: Path) -> None:
    """Refuse options that say what a recording of this program says itself."""
    given = [key for key in ("depth_scale", "tolerance_ms", "stamp") if key in uri.options]
    if given:
        raise SourceError(f"{path}: option {given[0]}: expected for recordings of others, found one of this program")


def _camera(uri: SourceUri, file: McapFile, color: Topic) -> Camera:
    topic = mcap_topics.calibration_topic(file, color, uri.options.get("camera"))
    if topic is None:
        raise SourceError(f"{file.path}: expected a topic of intrinsics (sensor_msgs/CameraInfo), found none")
    message = file.message(topic, 0)
    where = _place(file, topic, message)
    found = decoding.calibration_of(topic, message.data, where)
    matrix = _matrix(uri, found, where, is_rectified=mcap_topics.is_rectified(color))
    if not (1 <= found.width <= _MAX_SIDE and 1 <= found.height <= _MAX_SIDE):
        raise SourceError(f"{where}: expected images of 1 to {_MAX_SIDE} pixels, found {found.width}x{found.height}")
    intrinsics = {"fx": matrix[0], "fy": matrix[4], "cx": matrix[2], "cy": matrix[5]}
    try:
        return files.integer_centred_camera(uri, width=found.width, height=found.height, intrinsics=intrinsics)
    except ValueError as error:
        raise SourceError(f"{where}: expected intrinsics, found {error}") from error


def _matrix(uri: SourceUri, found: decoding.CalibrationMessage, where: str, *, is_rectified: bool) -> tuple[float, ...]:
    """The 3x3 of the images by rows: K, or where they are rectified P."""
    refuses = _choice(uri, "distortion", ("refuse", "ignore")) == "refuse"
    if is_rectified and found.rectified[0] != 0.0:
        return found.rectified
    if any(found.distortion) and refuses:
        wanted = "the matrix P of rectified images" if is_rectified else "images without lens distortion"
        raise SourceError(
            f"{where}: expected {wanted}, found coefficients {list(found.distortion)}; "
            "rectify them first, or see what comes of it with distortion=ignore"
        )
    return found.matrix


def _units_per_m(uri: SourceUri) -> float:
    return files.positive_option(uri, "depth_scale", _DEFAULT_UNITS_PER_M)


def _recorded_scale(path: Path, facts: dict[str, str]) -> float:
    text = facts[topics.DEPTH_SCALE_KEY]
    try:
        scale = float(text)
    except ValueError:
        scale = 0.0
    if not 0.0 < scale < float("inf"):
        raise SourceError(f"{path}: {topics.DEPTH_SCALE_KEY}: expected a positive number, found {text!r:.40}")
    return scale


def _choice(uri: SourceUri, key: str, known: tuple[str, ...]) -> str:
    """An option that is one of a few words, by default the first."""
    text = uri.options.get(key, known[0])
    if text not in known:
        raise SourceError(f"{uri.scheme}: option {key}: expected one of {', '.join(known)}, found {text!r}")
    return text


def _no_pairs(
    path: Path,
    color: Topic,
    color_ns: npt.NDArray[np.int64],
    depth: Topic,
    depth_ns: npt.NDArray[np.int64],
    tolerance_ns: int,
) -> str:
    def span(times_ns: npt.NDArray[np.int64]) -> str:
        return f"{1e-9 * float(times_ns.min()):.3f} to {1e-9 * float(times_ns.max()):.3f} s"

    return (
        f"{path}: expected images of {color.name} and {depth.name} within {1e-6 * tolerance_ns:g} ms of each other "
        f"(option tolerance_ms), found none: {span(color_ns)}, {span(depth_ns)}"
    )


def _place(file: McapFile, topic: Topic, message: StoredMessage) -> str:
    return f"{file.path}: {topic.name} at {1e-9 * message.log_time_ns:.6f} s"


@contextlib.contextmanager
def _as_source_error() -> Iterator[None]:
    """What is wrong with the file, as a source says it."""
    try:
        yield
    except StorageError as error:
        raise SourceError(str(error)) from error

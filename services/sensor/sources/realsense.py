"""``realsense:`` and ``realsense:SERIAL``: a RealSense camera, through ``pyrealsense2``.

Tested with a stand-in for the library; no real device was ever attached. Depth is aligned to colour by the library,
intrinsics and depth scale are the device's; its lens distortion, small for colour, is not removed.
"""

import sys
from dataclasses import dataclass, field
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.recording_files import check_options, positive_option

ENDLESS = sys.maxsize  # number of frames of a camera
_SIZE = (640, 480)
_FPS = 30.0
_PATIENCE_MS = 5000


@dataclass(slots=True, kw_only=True, eq=False)
class RealSenseSource:
    """A live camera (the `Source` protocol, but each frame is there once): it starts when the first one is asked for.

    Attributes:
        uri, family, camera, depth_scale_m: As in `Source`.
        counters: Frames that the camera took and that never came (``color_dropped``, ``depth_dropped``), and pairs of
            which one half was missing (``incomplete``).
    """

    uri: str
    camera: Camera
    depth_scale_m: float
    library: ModuleType
    config: Any
    family: str = "tum"
    counters: dict[str, int] = field(default_factory=lambda: {"color_dropped": 0, "depth_dropped": 0, "incomplete": 0})
    _pipeline: Any = None
    _align: Any = None
    _next: int = 0
    _last: Frame | None = None
    _numbers: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        """`ENDLESS`."""
        return ENDLESS

    def frame(self, index: int) -> Frame:
        """The frame ``index``: the last one again, or one that is still to come, which is waited for.

        Raises:
            SourceError: The camera gives no frames, or others than it said.
            IndexError: That frame is gone.
        """
        if self._last is not None and index == self._last.frame_id:
            return self._last
        if index < self._next:
            raise IndexError(f"{self.uri}: frame {index} is gone: a camera gives each frame once")
        while self._next <= index:
            self._last = self._taken(self._next)
            self._next += 1
        assert self._last is not None
        return self._last

    def ground_truth(self) -> None:
        """A camera does not know where it is."""

    def close(self) -> None:
        """Stop the camera, if it was started."""
        if self._pipeline is not None:
            self._pipeline.stop()
            self._pipeline = None

    def _taken(self, frame_id: int) -> Frame:
        """The camera's next pair of images."""
        while True:
            frames = self._waited()
            color, depth = frames.get_color_frame(), frames.get_depth_frame()
            if not color or not depth:
                self.counters["incomplete"] += 1
                continue
            self._count_gaps({"color_dropped": color.get_frame_number(), "depth_dropped": depth.get_frame_number()})
            return Frame(
                frame_id=frame_id,
                capture_time_ns=round(color.get_timestamp() * 1e6),
                rgb=self._image(color.get_data(), np.dtype(np.uint8), (3,)),
                depth=self._image(depth.get_data(), np.dtype(np.uint16), ()),
                depth_scale_m=self.depth_scale_m,
                camera=self.camera,
            )

    def _waited(self) -> Any:  # noqa: ANN401
        try:
            if self._pipeline is None:
                self._pipeline = self.library.pipeline()
                self._pipeline.start(self.config)
                self._align = self.library.align(self.library.stream.color)
            return self._align.process(self._pipeline.wait_for_frames(_PATIENCE_MS))
        except RuntimeError as error:
            raise SourceError(f"{self.uri}: expected a frame from the camera, found: {error}") from error

    def _count_gaps(self, numbers: dict[str, int]) -> None:
        for key, number in numbers.items():
            before = self._numbers.get(key)
            if before is not None and number > before + 1:
                self.counters[key] += number - before - 1
            self._numbers[key] = number

    def _image(self, data: object, dtype: np.dtype[Any], channels: tuple[int, ...]) -> npt.NDArray[Any]:
        image = np.array(data)  # a copy: the library uses its memory again
        shape = (self.camera.height, self.camera.width, *channels)
        if image.shape != shape or image.dtype != dtype:
            raise SourceError(f"{self.uri}: expected images {dtype} {shape}, found {image.dtype} {image.shape}")
        return image


def open_realsense(uri: SourceUri, size: tuple[int, int] | None) -> RealSenseSource:
    """The camera with the serial number that ``uri`` names, or the first one; option ``fps``.

    Args:
        uri: ``realsense:`` or ``realsense:SERIAL``.
        size: Width and height of its images; None for 640x480.

    Raises:
        SourceError: ``pyrealsense2`` is not installed, there is no such camera, or it has no such images.
    """
    check_options(uri, ("fps",))
    fps = positive_option(uri, "fps", _FPS)
    library = _library()
    width, height = size or _SIZE
    config = library.config()
    try:
        if uri.path:
            config.enable_device(uri.path)
        config.enable_stream(library.stream.depth, width, height, library.format.z16, int(fps))
        config.enable_stream(library.stream.color, width, height, library.format.rgb8, int(fps))
        profile = config.resolve(library.pipeline_wrapper(library.pipeline()))
        found = profile.get_stream(library.stream.color).as_video_stream_profile().get_intrinsics()
        depth_scale_m = float(profile.get_device().first_depth_sensor().get_depth_scale())
    except RuntimeError as error:
        raise SourceError(
            f"{uri}: expected a camera with colour and depth of {width}x{height} at {fps:g} Hz, found: {error}"
        ) from error
    if not 0.0 < depth_scale_m < 1.0:
        raise SourceError(f"{uri}: expected a depth scale between 0 and 1 m, found {depth_scale_m!r}")
    return RealSenseSource(
        uri=str(uri), camera=_camera(uri, found), depth_scale_m=depth_scale_m, library=library, config=config
    )


def _library() -> ModuleType:
    try:
        return import_module("pyrealsense2")
    except ImportError as error:
        raise SourceError(
            f'realsense: expected the package pyrealsense2, found: {error}; pip install "vtslam[realsense]"'
        ) from error


def _camera(uri: SourceUri, found: Any) -> Camera:  # noqa: ANN401
    """The library puts pixel centres at whole numbers."""
    try:
        return Camera.from_integer_centred(
            width=found.width, height=found.height, fx=found.fx, fy=found.fy, cx=found.ppx, cy=found.ppy
        )
    except ValueError as error:
        raise SourceError(f"{uri}: expected intrinsics of the camera, found: {error}") from error

"""Parts handed to rerun: to a browser's page, a window, a file."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.settings import ViewerSettings
from vtslam.services.viewer import names, parts
from vtslam.services.viewer.errors import ViewerError
from vtslam.services.viewer.rerun_process import RerunProcess

try:
    import rerun as rr
except ImportError as error:
    raise ViewerError(f"rerun cannot be used ({error}): pip install 'vtslam[viewer]'") from error

from vtslam.services.viewer.blueprint import blueprint  # needs rerun

FRAME = "frame"  # the time line: frames by their number
_JPEG_QUALITY = 85
_PNG_LEVEL = 1
_FLUSH_S = 0.5  # of waiting for rerun to take an update; it then gets no other one until it has
_CLOSE_S = 20.0
_POINT_RADIUS_PX = -1.5  # rerun takes negative radii for pixels
_LINE_RADIUS_PX = -1.0

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Outlets:
    """Where to.

    Attributes:
        web_port: Serve a page there; 0 for none.
        save: A file, or None.
        window: Open a window.
    """

    web_port: int = 0
    save: Path | None = None
    window: bool = False

    @classmethod
    def of(cls, settings: ViewerSettings) -> "Outlets":
        """The outlets of a fleet's viewer."""
        return cls(web_port=settings.web_port, save=Path(settings.save) if settings.save else None)


class RerunSink:
    """Sends parts to rerun, an update at a time: while one has not been taken, others are refused.

    Args:
        outlets: Where to.
        title: Shown as the recording's name.
        is_live: Only the newest of everything is kept, for as long as it takes; otherwise all lies on the time line.

    Raises:
        ViewerError: Rerun cannot be started, or the file cannot be written.
    """

    def __init__(self, outlets: Outlets, *, title: str, is_live: bool) -> None:
        if outlets.save is not None:
            _require_writable(outlets.save)
        logging.getLogger("rerun").setLevel(logging.ERROR)
        shows = outlets.web_port > 0 or outlets.window
        self._process = RerunProcess(outlets.web_port) if shows else None
        self._is_live = is_live
        self._is_taken = True
        self._stream = rr.RecordingStream("vtslam")
        sinks: list[Any] = [] if outlets.save is None else [rr.FileSink(str(outlets.save))]
        if self._process is not None:
            sinks.append(rr.GrpcSink(self._process.url))
        self._stream.set_sinks(*sinks, default_blueprint=blueprint(is_live=is_live))
        self._stream.send_recording_name(title)
        for origin in (names.WORLD, names.STATES):  # axes of the first camera: x right, y down, z forward
            self._stream.log(origin, rr.ViewCoordinates.RDF, static=True)

    @property
    def is_open(self) -> bool:
        """Whether somebody could see what is sent."""
        return self._process is None or self._process.is_running

    def is_free(self) -> bool:
        """Whether the last update was taken."""
        self._is_taken = self._is_taken or self._flushed(0.0 if self._is_live else _CLOSE_S)
        return self._is_taken

    def send(self, frame_id: int, update: Iterable[parts.Part]) -> bool:
        """Show an update as of a frame; whether it was accepted."""
        if not self.is_free():
            return False
        self._stream.set_time(FRAME, sequence=frame_id)
        for part in update:
            self._stream.log(part.path, _WRITERS[type(part)](part), static=part.lasting and self._is_live)
        self._is_taken = self._flushed(_FLUSH_S if self._is_live else _CLOSE_S)
        return True

    def wait(self, timeout_s: float) -> bool:
        """Wait for the window or the page's server to end; whether it has."""
        return self._process is None or self._process.has_ended(timeout_s)

    def close(self) -> None:
        """Nothing more comes: what was sent is in the file; window or page stay."""
        if self.is_open:  # rerun would wait for a program that is gone
            self._flushed(_CLOSE_S)
            self._stream.disconnect()

    def end(self) -> None:
        """End window or page."""
        if self._process is not None:
            self._process.close()

    def _flushed(self, timeout_s: float) -> bool:
        try:
            self._stream.flush(timeout_sec=max(timeout_s, 0.01))
        except (RuntimeError, TimeoutError, ValueError):
            return False
        return True


def _require_writable(path: Path) -> None:
    if path.suffix != ".rrd":
        raise ViewerError(f"{path}: expected a name that ends in .rrd")
    try:
        path.open("wb").close()
    except OSError as error:
        raise ViewerError(f"{path}: cannot be written: {error.strerror}") from error


def _gaussians(part: parts.Gaussians) -> rr.GaussianSplats3D:
    scales = np.repeat(part.sigmas_m[:, None], 3, axis=1)
    return rr.GaussianSplats3D(part.centers_m, scales=scales, colors=part.colors)


def _points(part: parts.Points) -> rr.Points3D:
    return rr.Points3D(part.points_m, colors=part.colors, radii=_POINT_RADIUS_PX)


def _picture(part: parts.Picture) -> rr.EncodedImage:
    bgr = np.ascontiguousarray(part.rgb[..., ::-1])
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")


def _depth(part: parts.DepthPicture) -> rr.EncodedDepthImage:
    _, data = cv2.imencode(".png", part.depth, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    return rr.EncodedDepthImage(data.tobytes(), media_type="image/png", meter=1.0 / part.depth_scale_m)


def _frustum(part: parts.Frustum) -> list[Any]:
    camera, T = part.camera, part.T_world_camera
    pinhole = rr.Pinhole(
        focal_length=[camera.fx, camera.fy],
        principal_point=[camera.cx, camera.cy],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.3,
        color=(255, 150, 40),
    )
    pose = rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
    return [*pose.as_component_batches(), *pinhole.as_component_batches()]


def _line(part: parts.Line) -> rr.LineStrips3D:
    return rr.LineStrips3D([part.points_m], colors=[part.color], radii=_LINE_RADIUS_PX)


_WRITERS: dict[type[parts.Part], Callable[[Any], Any]] = {
    parts.Gaussians: _gaussians,
    parts.Points: _points,
    parts.Tint: lambda part: rr.Points3D.from_fields(colors=[part.color]),
    parts.Line: _line,
    parts.Frustum: _frustum,
    parts.Picture: _picture,
    parts.DepthPicture: _depth,
    parts.Figure: lambda part: rr.Scalars(part.value),
    parts.Word: lambda part: rr.TextLog(part.text, level="WARN"),
    parts.Gone: lambda part: rr.Clear(recursive=False),
}

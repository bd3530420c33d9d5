"""Recordings with a fault put in on purpose."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources.base import Source

FrameOf = Callable[[int], Frame]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BrokenSource:
    """Frames 0 to ``count - 1`` made by ``frame_of``; what else a source says is the inner one's."""

    inner: Source
    frame_of: FrameOf
    count: int
    truth: npt.NDArray[np.float64] | None

    @property
    def uri(self) -> str:
        return self.inner.uri

    @property
    def camera(self) -> Camera:
        return self.frame_of(0).camera

    @property
    def depth_scale_m(self) -> float:
        return self.frame_of(0).depth_scale_m

    @property
    def family(self) -> str:
        return self.inner.family

    def __len__(self) -> int:
        return self.count

    def frame(self, index: int) -> Frame:
        return replace(self.frame_of(index), frame_id=index)

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        return self.truth


def broken(source: Source, fault: str) -> BrokenSource:
    """The recording with one of `FAULTS`."""
    return FAULTS[fault](source)


def _changed(source: Source, change: Callable[[Frame], Frame]) -> BrokenSource:
    return _made(source, lambda index: change(source.frame(index)))


def _made(source: Source, frame_of: FrameOf) -> BrokenSource:
    return BrokenSource(inner=source, frame_of=frame_of, count=len(source), truth=source.ground_truth())


def _depth_scale(source: Source) -> BrokenSource:
    return _changed(source, lambda frame: replace(frame, depth_scale_m=0.2 * frame.depth_scale_m))


def _depth_scale_unseen(source: Source) -> BrokenSource:
    return replace(_depth_scale(source), truth=None)


def _focal_lengths(source: Source) -> BrokenSource:
    """Images scaled to three quarters of their height, as for another screen, and then fx for fy."""

    def change(frame: Frame) -> Frame:
        small = frame.resized(frame.camera.width, frame.camera.height * 3 // 4)
        return replace(small, camera=replace(small.camera, fx=small.camera.fy, fy=small.camera.fx))

    return _changed(source, change)


def _principal_point(source: Source) -> BrokenSource:
    def change(frame: Frame) -> Frame:
        return replace(frame, camera=replace(frame.camera, cx=frame.camera.cy, cy=frame.camera.cx))

    return _changed(source, change)


def shifted_color(source: Source, shift_px: int) -> BrokenSource:
    """Colour moved to the right (negative: left), its outermost column repeated."""

    def change(frame: Frame) -> Frame:
        columns = np.clip(np.arange(frame.camera.width) - shift_px, 0, frame.camera.width - 1)
        return replace(frame, rgb=np.ascontiguousarray(frame.rgb[:, columns]))

    return _changed(source, change)


def _registration(source: Source) -> BrokenSource:
    camera = source.frame(0).camera
    return shifted_color(source, round(camera.width * 12 / 640))


def late_depth(source: Source, lag: int) -> BrokenSource:
    """Depth that comes ``lag`` frames after its colour."""

    truth = source.ground_truth()
    return BrokenSource(
        inner=source,
        frame_of=lambda index: replace(source.frame(index + lag), depth=source.frame(index).depth),
        count=len(source) - lag,
        truth=None if truth is None else truth[lag:],
    )


def _frozen(source: Source) -> BrokenSource:
    """A fifth of the recording shows one frame."""
    first, end = int(0.4 * len(source)), int(0.6 * len(source))
    return _made(source, lambda index: source.frame(first if first <= index < end else index))


def _blank_color(source: Source) -> BrokenSource:
    def frame_of(index: int) -> Frame:
        frame = source.frame(index)
        return replace(frame, rgb=np.full_like(frame.rgb, 3)) if index == 2 else frame

    return _made(source, frame_of)


def _blank_depth(source: Source) -> BrokenSource:
    def frame_of(index: int) -> Frame:
        frame = source.frame(index)
        return replace(frame, depth=np.zeros_like(frame.depth)) if index >= len(source) // 2 else frame

    return _made(source, frame_of)


def _motion(source: Source) -> BrokenSource:
    """Every tenth frame only."""
    truth = source.ground_truth()
    return BrokenSource(
        inner=source,
        frame_of=lambda index: source.frame(10 * index),
        count=len(source) // 10,
        truth=None if truth is None else truth[: 10 * (len(source) // 10) : 10],
    )


FAULTS: dict[str, Callable[[Source], BrokenSource]] = {
    "depth scale": _depth_scale,
    "depth scale without true poses": _depth_scale_unseen,
    "focal lengths": _focal_lengths,
    "principal point": _principal_point,
    "registration": _registration,
    "time offset": lambda source: late_depth(source, 3),
    "frozen frames": _frozen,
    "blank frames": _blank_color,
    "blank frames of depth": _blank_depth,
    "motion": _motion,
}

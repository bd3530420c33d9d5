"""A stand-in for ``pyrealsense2`` with one camera: as much of it as the source uses."""

import sys
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest

NO_FRAME = "Frame didn't arrive within 5000"


@dataclass(slots=True)
class Image:
    """A frame of one stream."""

    data: npt.NDArray[np.generic]
    number: int
    time_ms: float

    def get_data(self) -> npt.NDArray[np.generic]:
        return self.data

    def get_frame_number(self) -> int:
        return self.number

    def get_timestamp(self) -> float:
        return self.time_ms


@dataclass(slots=True)
class Pair:
    """What the camera gives at once; either may be missing."""

    color: Image | None
    depth: Image | None
    aligned: bool = False

    def get_color_frame(self) -> Image | None:
        return self.color

    def get_depth_frame(self) -> Image | None:
        assert self.aligned, "depth was taken before it was aligned to colour"
        return self.depth


@dataclass(slots=True)
class Device:
    """The camera, which tests change: ``pairs`` are given one after another, then no more."""

    serial: str = "012345"
    width: int = 64
    height: int = 48
    fx: float = 60.0
    fps: int = 30
    depth_scale_m: float = 0.001
    attached: bool = True
    pairs: list[Pair] = field(default_factory=list)
    streaming: bool = False

    def add(self, number: int, *, depth_number: int | None = None) -> Pair:
        """One more pair, whose images tell their number."""
        rgb = np.full((self.height, self.width, 3), number % 256, np.uint8)
        depth = np.full((self.height, self.width), 1000 + number, np.uint16)
        time_ms = 1.7e12 + number * 33.25
        pair = Pair(
            Image(rgb, number, time_ms), Image(depth, number if depth_number is None else depth_number, time_ms)
        )
        self.pairs.append(pair)
        return pair


def attach(monkeypatch: pytest.MonkeyPatch) -> Device:
    """Make ``import pyrealsense2`` give the stand-in; its camera."""
    device = Device()
    module = ModuleType("pyrealsense2")
    module.__dict__.update(
        stream=SimpleNamespace(color="color", depth="depth"),
        format=SimpleNamespace(rgb8="rgb8", z16="z16"),
        config=lambda: _Config(device),
        pipeline=lambda: _Pipeline(device),
        pipeline_wrapper=lambda pipeline: pipeline,
        align=_Align,
    )
    monkeypatch.setitem(sys.modules, "pyrealsense2", module)
    return device


class _Config:
    def __init__(self, device: Device) -> None:
        self._device = device
        self._serial = device.serial
        self._streams: list[tuple[object, ...]] = []

    def enable_device(self, serial: str) -> None:
        self._serial = serial

    def enable_stream(self, *stream: object) -> None:
        self._streams.append(stream)

    def resolve(self, pipeline: object) -> SimpleNamespace:
        device = self._device
        if not device.attached or self._serial != device.serial:
            raise RuntimeError("No device connected")
        size = (device.width, device.height)
        if self._streams != [("depth", *size, "z16", device.fps), ("color", *size, "rgb8", device.fps)]:
            raise RuntimeError("Couldn't resolve requests")
        intrinsics = SimpleNamespace(width=size[0], height=size[1], fx=device.fx, fy=61.0, ppx=31.5, ppy=23.5)
        video = SimpleNamespace(get_intrinsics=lambda: intrinsics)
        sensor = SimpleNamespace(get_depth_scale=lambda: device.depth_scale_m)
        return SimpleNamespace(
            get_stream=lambda kind: SimpleNamespace(as_video_stream_profile=lambda: video),
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
        )


class _Pipeline:
    def __init__(self, device: Device) -> None:
        self._device = device

    def start(self, config: _Config) -> None:
        if self._device.streaming:
            raise RuntimeError("Device or resource busy")
        self._device.streaming = True

    def stop(self) -> None:
        self._device.streaming = False

    def wait_for_frames(self, timeout_ms: int) -> Pair:
        assert timeout_ms > 0
        if not self._device.pairs:
            raise RuntimeError(NO_FRAME)
        return self._device.pairs.pop(0)


class _Align:
    def __init__(self, target: str) -> None:
        assert target == "color"

    def process(self, pair: Pair) -> Pair:
        pair.aligned = True
        return pair

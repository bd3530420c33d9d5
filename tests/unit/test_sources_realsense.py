import sys
from collections.abc import Callable

import numpy as np
import pytest
from helpers.realsense_stand_in import NO_FRAME, Device, attach

from vtslam.services.cli.__main__ import main
from vtslam.services.run_plan import plan_run
from vtslam.services.sensor.sources.base import Source, SourceError
from vtslam.services.sensor.sources.realsense import ENDLESS, RealSenseSource
from vtslam.services.sensor.sources.registry import open_source

SIZE = (64, 48)


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    return attach(monkeypatch)


def opened(uri: str = "realsense:") -> RealSenseSource:
    source = open_source(uri, size=SIZE)
    assert isinstance(source, RealSenseSource)
    return source


def refusal(act: Callable[[], object]) -> str:
    with pytest.raises(SourceError) as caught:
        act()
    return str(caught.value)


def test_intrinsics_and_depth_scale_are_the_device_s(device: Device) -> None:
    source: Source = opened("realsense:012345")
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 60, 61, 32, 24)
    assert (source.depth_scale_m, source.family, len(source)) == (0.001, "tum", ENDLESS)
    assert source.ground_truth() is None
    assert not device.streaming


def test_frames_come_in_order_with_the_camera_s_times(device: Device) -> None:
    source = opened()
    for number in (7, 8):
        device.add(number)
    frames = [source.frame(0), source.frame(1)]
    assert [frame.frame_id for frame in frames] == [0, 1]
    assert [int(frame.rgb[0, 0, 0]) for frame in frames] == [7, 8]
    assert [int(frame.depth[0, 0]) for frame in frames] == [1007, 1008]
    assert frames[1].capture_time_ns - frames[0].capture_time_ns == pytest.approx(33.25e6, abs=1e3)
    assert source.frame(1) is frames[1]
    source.close()
    assert not device.streaming


def test_the_camera_s_memory_is_not_shared(device: Device) -> None:
    source, pair = opened(), device.add(1)
    frame = source.frame(0)
    assert pair.color is not None
    pair.color.data[:] = np.uint8(99)
    assert int(frame.rgb[0, 0, 0]) == 1


def test_dropped_frames_are_counted(device: Device) -> None:
    source = opened()
    device.add(10)
    device.add(11, depth_number=13)
    device.add(15, depth_number=14)
    device.add(16).depth = None
    device.add(17, depth_number=15)
    source.frame(3)
    assert source.counters == {"color_dropped": 4, "depth_dropped": 2, "incomplete": 1}


def test_a_range_leaves_the_first_frames_out(device: Device) -> None:
    source = open_source("realsense:", size=SIZE, frames=(2, 4))
    for number in range(4):
        device.add(number)
    assert len(source) == 2
    assert [int(source.frame(index).rgb[0, 0, 0]) for index in range(2)] == [2, 3]


def test_a_frame_that_is_gone(device: Device) -> None:
    source = opened()
    for number in range(2):
        device.add(number)
    source.frame(1)
    with pytest.raises(IndexError, match="frame 0 is gone"):
        source.frame(0)


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    text = refusal(lambda: open_source("realsense:"))
    assert text.startswith("realsense: expected the package pyrealsense2, found: ")
    assert text.endswith('; pip install "vtslam[realsense]"')


def unplugged(device: Device) -> None:
    device.attached = False


def without_focal_length(device: Device) -> None:
    device.fx = 0.0


def without_scale(device: Device) -> None:
    device.depth_scale_m = 0.0


def slow(device: Device) -> None:
    device.fps = 15


def large(device: Device) -> None:
    device.width = 1280


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            unplugged,
            "realsense:: expected a camera with colour and depth of 64x48 at 30 Hz, found: No device connected",
        ),
        (slow, "realsense:: expected a camera .* at 30 Hz, found: Couldn't resolve requests"),
        (large, "realsense:: expected a camera .* of 64x48 .*, found: Couldn't resolve requests"),
        (without_focal_length, "realsense:: expected intrinsics of the camera, found: not a camera: .*"),
        (without_scale, "realsense:: expected a depth scale between 0 and 1 m, found 0.0"),
    ],
)
def test_cameras_that_are_refused(device: Device, change: Callable[[Device], None], text: str) -> None:
    change(device)
    with pytest.raises(SourceError, match=text):
        opened()


@pytest.mark.parametrize(
    ("uri", "text"),
    [
        ("realsense:999", "realsense:999: expected a camera with .*, found: No device connected"),
        ("realsense:?fps=0", "realsense: option fps: expected a positive number, found '0'"),
        ("realsense:?laser=on", "realsense: expected options among fps, range, size; found 'laser'"),
    ],
)
def test_bad_uris(device: Device, uri: str, text: str) -> None:
    with pytest.raises(SourceError, match=text):
        opened(uri)


def test_a_camera_that_stops(device: Device) -> None:
    source = opened()
    device.add(0)
    source.frame(0)
    assert refusal(lambda: source.frame(1)) == f"realsense:: expected a frame from the camera, found: {NO_FRAME}"


def test_a_camera_that_is_busy(device: Device) -> None:
    source = opened()
    device.streaming = True
    assert "expected a frame from the camera, found: Device or resource busy" in refusal(lambda: source.frame(0))


def test_runs_need_a_recording(device: Device) -> None:
    text = refusal(lambda: plan_run("realsense:", assignments=['source.size="64x48"']))
    assert text.startswith("realsense:: expected a recording, found a camera; start a fleet with vtslam up")


def test_doctor_looks_at_a_camera(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(200):
        device.add(number)
    assert main(["doctor", "realsense:?size=64x48"]) == 1
    out = capsys.readouterr().out
    assert "FAIL  blank frames     nothing to see in the colour of frames 0, 1, 2, 3 and 140 more" in out
    assert not device.streaming


@pytest.mark.parametrize(
    ("color", "depth", "text"),
    [
        (np.zeros((48, 32, 3), np.uint8), None, r"expected images uint8 \(48, 64, 3\), found uint8 \(48, 32, 3\)"),
        (np.zeros((48, 64), np.uint8), None, r"found uint8 \(48, 64\)"),
        (None, np.zeros((48, 64), np.uint8), r"expected images uint16 \(48, 64\), found uint8 \(48, 64\)"),
        (None, np.zeros((24, 32), np.uint16), r"found uint16 \(24, 32\)"),
    ],
)
def test_images_of_another_kind(device: Device, color: np.ndarray | None, depth: np.ndarray | None, text: str) -> None:
    source, pair = opened(), device.add(0)
    assert pair.color is not None
    assert pair.depth is not None
    pair.color.data = pair.color.data if color is None else color
    pair.depth.data = pair.depth.data if depth is None else depth
    with pytest.raises(SourceError, match=text):
        source.frame(0)

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.dataset_recordings import TumRecording, write_tum
from helpers.recordings import cut_in_half, write_png

from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.sensor.sources.tum import nearest

NAME = "rgbd_dataset_freiburg1_desk"


@pytest.fixture
def recording(tmp_path: Path) -> TumRecording:
    return write_tum(tmp_path / NAME)


def test_reads_what_was_written(recording: TumRecording) -> None:
    source = open_source(recording.uri)
    assert (len(source), source.family, source.depth_scale_m) == (3, "tum", 1.0 / 5000.0)
    poses = source.ground_truth()
    assert poses is not None
    np.testing.assert_allclose(poses, recording.poses, atol=1e-12)
    for index in (2, 0, 1):
        frame = source.frame(index)
        np.testing.assert_array_equal(frame.rgb, recording.rgb[index])
        np.testing.assert_array_equal(frame.depth, recording.depth[index])
    assert source.frame(0).capture_time_ns == 1_305_031_452_790_000_000


@pytest.mark.parametrize(
    ("name", "option", "expected"),
    [
        (NAME, "", (517.3, 516.5, 319.1, 255.8)),
        ("rgbd_dataset_freiburg2_xyz", "", (520.9, 521.0, 325.6, 250.2)),
        ("rgbd_dataset_freiburg3_long_office_household", "", (535.4, 539.2, 320.6, 248.1)),
        ("mine", "?camera=ros", (525.0, 525.0, 320.0, 240.0)),
        ("mine", "?fx=500&fy=501&cx=320&cy=241", (500.0, 501.0, 320.5, 241.5)),
        (NAME, "?camera=fr3&fx=500", (500.0, 539.2, 320.6, 248.1)),
    ],
)
def test_intrinsics(tmp_path: Path, name: str, option: str, expected: tuple[float, ...]) -> None:
    camera = open_source(write_tum(tmp_path / name, num_frames=1).uri + option).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(expected)


def test_each_color_image_takes_the_nearest_depth_and_pose() -> None:
    times = np.array([0, 100, 200, 300], np.int64)
    others = np.array([-30, 90, 150, 210], np.int64)
    np.testing.assert_array_equal(nearest(times, others, 50), [0, 1, 3, -1])
    np.testing.assert_array_equal(nearest(np.array([120], np.int64), others, 50), [1])
    np.testing.assert_array_equal(nearest(times, others[:0], 50), [-1] * 4)


def test_color_without_depth_near_it_is_left_out(recording: TumRecording) -> None:
    recording.write_list("depth.txt", recording.lines("depth")[:1])
    assert len(open_source(f"{recording.uri}?max_dt=0.02")) == 1


def test_frames_that_come_too_fast_are_left_out(tmp_path: Path) -> None:
    recording = write_tum(tmp_path / NAME, num_frames=4, interval_s=0.02)
    source = open_source(recording.uri)
    assert [source.frame(index).capture_time_ns for index in range(len(source))] == [
        1_305_031_452_790_000_000,
        1_305_031_452_830_000_000,
    ]
    assert len(open_source(f"{recording.uri}?max_fps=60")) == 4


def test_truth_is_nan_where_no_pose_is_near(recording: TumRecording) -> None:
    recording.write_list("groundtruth.txt", recording.truth_lines()[:1])
    poses = open_source(f"{recording.uri}?max_dt=0.02").ground_truth()
    assert poses is not None
    np.testing.assert_array_equal(np.isfinite(poses).all(axis=(1, 2)), [True, False, False])


def test_without_groundtruth(recording: TumRecording) -> None:
    (recording.folder / "groundtruth.txt").unlink()
    assert open_source(recording.uri).ground_truth() is None


def test_resize(recording: TumRecording) -> None:
    whole, small = open_source(recording.uri), open_source(recording.uri, size=(320, 240))
    assert small.camera == whole.camera.resized(320, 240)
    np.testing.assert_array_equal(small.frame(1).depth, whole.frame(1).resized(320, 240).depth)


def drop(name: str) -> Callable[[TumRecording], Path]:
    def damage(recording: TumRecording) -> Path:
        (recording.folder / name).unlink()
        return recording.folder / name

    return damage


def rewrite(name: str, lines: list[str]) -> Callable[[TumRecording], Path]:
    return lambda recording: recording.write_list(name, lines)


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (drop("rgb.txt"), "{path}: expected a list of images with their times, found no such file"),
        (drop("depth.txt"), "{path}: expected a list of images with their times, found no such file"),
        (rewrite("rgb.txt", []), "{path}: expected a list of images with their times, found none"),
        (rewrite("rgb.txt", ["1.0"]), "{path}:2: expected a time and a file name, found 1 words"),
        (rewrite("rgb.txt", ["soon rgb/a.png"]), "{path}:2: expected a time in seconds, found 'soon'"),
        (rewrite("depth.txt", ["nan depth/a.png"]), "{path}:2: expected a time in seconds, found 'nan'"),
        (rewrite("rgb.txt", ["2 a", "1 b"]), "{path}:3: expected a time after that of the line before, found 1"),
        (
            rewrite("depth.txt", ["1 depth/a.png"]),
            "{path}: expected depth images within 0.08 s of those of rgb.txt, found none (option max_dt)",
        ),
        (rewrite("groundtruth.txt", ["1 2 3"]), "{path}:2: expected 8 columns .*, found 3"),
        (
            rewrite("groundtruth.txt", ["1305031452.79 0 0 0 0 0 0 0"]),
            "{path}:2: .*",
        ),
        (
            rewrite("groundtruth.txt", ["5 0 0 0 0 0 0 1"]),
            "{path}: expected poses within 0.08 s of the images, found none",
        ),
    ],
)
def test_damaged_lists_are_refused(recording: TumRecording, damage: Callable[[TumRecording], Path], text: str) -> None:
    path = damage(recording)
    with pytest.raises(SourceError) as caught:
        open_source(recording.uri)
    wanted = text.format(path=path)
    assert str(caught.value) == wanted or re.fullmatch(wanted, str(caught.value)), str(caught.value)


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("camera=fr9", "tum: option camera: expected one of fr1, fr2, fr3, ros; found 'fr9'"),
        ("max_dt=0", "tum: option max_dt: expected a positive number, found '0'"),
        ("max_fps=fast", "tum: option max_fps: expected a positive number, found 'fast'"),
        ("crop=8", "tum: expected options among .*; found 'crop'"),
    ],
)
def test_bad_options_are_refused(recording: TumRecording, option: str, text: str) -> None:
    with pytest.raises(SourceError, match=text):
        open_source(f"{recording.uri}?{option}")


def test_unknown_camera(tmp_path: Path) -> None:
    recording = write_tum(tmp_path / "desk", num_frames=1)
    with pytest.raises(SourceError, match=r"expected a name with freiburg1, .*camera=fr1\|fr2\|fr3\|ros"):
        open_source(recording.uri)


@pytest.mark.parametrize("kind", ["color_path", "depth_path"])
def test_missing_and_cut_images_are_named(recording: TumRecording, kind: str) -> None:
    source = open_source(recording.uri)
    path: Path = getattr(recording, kind)(1)
    cut_in_half(path)
    with pytest.raises(SourceError, match=f"{re.escape(str(path))}: expected a whole PNG file"):
        source.frame(1)
    path.unlink()
    with pytest.raises(SourceError, match=f"{re.escape(str(path))}: expected a .* image, found no such file"):
        source.frame(1)


def test_image_of_another_size(recording: TumRecording) -> None:
    write_png(recording.depth_path(0), recording.depth[0][:-2])
    with pytest.raises(SourceError, match="expected the size of its colour image 640x480, found 640x478"):
        open_source(recording.uri).frame(0)

"""``kitti:DIR``: images, calibration, both kinds of depth, and what it refuses."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.kitti_recording import (
    BASELINE_M,
    FOCAL_PX,
    HEIGHT,
    WALL_M,
    WIDTH,
    KittiRecording,
    matrix_line,
    pose_line,
    write_kitti,
)
from helpers.shared_data import shared_data

from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.kitti_depth import stereo_depth_m
from vtslam.services.sensor.sources.registry import open_source


@pytest.fixture
def recording(tmp_path: Path) -> KittiRecording:
    return write_kitti(tmp_path / "sequences" / "07")


def test_gray_images_are_shown_as_three_equal_channels(recording: KittiRecording) -> None:
    source = open_source(recording.uri)
    frame = source.frame(1)
    gray = cv2.imread(str(recording.image(0, 1)), cv2.IMREAD_UNCHANGED)
    for channel in range(3):
        np.testing.assert_array_equal(frame.rgb[..., channel], gray)
    assert (source.family, source.depth_scale_m, len(source)) == ("kitti", 1 / 256, 2)
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.cx, camera.cy) == (WIDTH, HEIGHT, FOCAL_PX, 80.0, 30.0)


def test_times_in_nanoseconds_and_ten_a_second_without_them(recording: KittiRecording) -> None:
    assert open_source(recording.uri).frame(1).capture_time_ns == 103_700_000
    (recording.folder / "times.txt").unlink()
    assert open_source(recording.uri).frame(1).capture_time_ns == 100_000_000


def test_stereo_depth_of_a_wall(recording: KittiRecording) -> None:
    depth_m = open_source(f"{recording.uri}?depth=stereo").frame(0).depth_m()
    inside = depth_m[4:-4, 24:-4]
    assert (inside > 0).mean() > 0.9
    assert np.quantile(np.abs(inside[inside > 0] - WALL_M), 0.95) < 0.1


def test_pixels_that_the_right_camera_does_not_see_have_no_depth() -> None:
    rng = np.random.default_rng(5)
    noise = rng.integers(0, 255, (2, 80, 240)).astype(np.uint8)
    far, near = (np.asarray(cv2.GaussianBlur(plane, (3, 3), 0), np.uint8) for plane in noise)
    left, right = far[:, :200].copy(), far[:, 4:204].copy()  # 4 px of disparity behind ...
    left[20:60, 100:160] = near[20:60, 100:160]
    right[20:60, 88:148] = near[20:60, 100:160]  # ... and 12 px in front
    depth_m = stereo_depth_m(left, right, focal_px=FOCAL_PX, baseline_m=BASELINE_M)
    hidden = depth_m[26:54, 93:98]  # beside the near square, covered by it in the right image
    assert (hidden > 0).mean() < 0.3
    assert np.median(depth_m[26:54, 110:150]) == pytest.approx(FOCAL_PX * BASELINE_M / 12, rel=0.03)


def test_laser_depth_of_a_wall(recording: KittiRecording) -> None:
    sparse = open_source(f"{recording.uri}?depth=lidar").frame(0).depth_m()
    dense = open_source(f"{recording.uri}?depth=lidar&densify=2").frame(0).depth_m()
    for depth_m in (sparse, dense):
        np.testing.assert_allclose(depth_m[depth_m > 0], WALL_M, atol=0.005)
    assert 0.02 < (sparse > 0).mean() < 0.15
    assert (dense[12:48, 45:115] > 0).all()
    # Points 5 m ahead, 2 m to the left and 1 m up: 40 px left of the middle, 20 px above it.
    assert sparse[9:11, 39:41].any()
    assert not sparse[:9].any()


def test_poses_are_those_of_the_left_colour_camera(tmp_path: Path) -> None:
    gray = open_source(write_kitti(tmp_path / "gray").uri).ground_truth()
    colour = open_source(write_kitti(tmp_path / "colour", color=True).uri).ground_truth()
    assert gray is not None
    assert colour is not None
    np.testing.assert_allclose(np.linalg.inv(gray) @ colour, np.tile(np.eye(4), (2, 1, 1)) + _shift(-0.06), atol=1e-6)


def _shift(x: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    out = np.zeros((4, 4))
    out[0, 3] = x
    return out


def test_poses_where_kitti_publishes_them(recording: KittiRecording) -> None:
    published = recording.folder.parent.parent / "poses" / "07.txt"
    published.parent.mkdir()
    shutil.move(recording.folder / "poses.txt", published)
    poses = open_source(recording.uri).ground_truth()
    assert poses is not None
    assert poses[1, 2, 3] == pytest.approx(1.0)
    published.unlink()
    assert open_source(recording.uri).ground_truth() is None


def test_reading_again_gives_the_same_bytes(recording: KittiRecording) -> None:
    one, two = open_source(recording.uri), open_source(recording.uri)
    np.testing.assert_array_equal(one.frame(1).depth, two.frame(1).depth)
    assert one.uri == f"kitti:{recording.folder}"
    assert open_source(f"{recording.uri}?range=1:2&size=80x30").frame(0).rgb.shape == (30, 80, 3)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-10])


DAMAGES: dict[str, tuple[Callable[[KittiRecording], object], str]] = {
    "no calibration": (lambda r: (r.folder / "calib.txt").unlink(), "calib.txt: expected a readable text file"),
    "calibration without a camera": (
        lambda r: (r.folder / "calib.txt").write_text(matrix_line("P0", [1.0] * 12)),
        "calib.txt: expected a line P1: with 12 numbers, found P0",
    ),
    "calibration of 11 numbers": (
        lambda r: (r.folder / "calib.txt").write_text(matrix_line("P0", [1.0] * 11)),
        "calib.txt:1: expected 12 numbers, found 11",
    ),
    "calibration without a name": (
        lambda r: (r.folder / "calib.txt").write_text("1 2 3\n"),
        "calib.txt:1: expected NAME: and 12 numbers",
    ),
    "cameras the wrong way round": (
        lambda r: (r.folder / "calib.txt").write_text(
            matrix_line("P0", [9, 0, 1, 0, 0, 9, 1, 0, 0, 0, 1, 0])
            + matrix_line("P1", [9, 0, 1, 9, 0, 9, 1, 0, 0, 0, 1, 0])
        ),
        "calib.txt: expected P1 to the right of P0",
    ),
    "too few times": (
        lambda r: (r.folder / "times.txt").write_text("0.0\n"),
        "times.txt: expected 2 times, one for each frame, found 1",
    ),
    "times that fall": (
        lambda r: (r.folder / "times.txt").write_text("0.1\n0.1\n"),
        "times.txt:2: expected rising times, found 0.1",
    ),
    "times that are words": (
        lambda r: (r.folder / "times.txt").write_text("0.1\nnoon\n"),
        "times.txt:2: expected a number, found 'noon'",
    ),
    "too many poses": (
        lambda r: (r.folder / "poses.txt").write_text(3 * pose_line(0, 0, 0, 0)),
        "poses.txt: expected 2 poses, one for each frame, found 3",
    ),
    "a pose that bends": (
        lambda r: (r.folder / "poses.txt").write_text(2 * "1 1 0 0 0 1 0 0 0 0 1 0\n"),
        "poses.txt:1: expected a rigid motion",
    ),
    "no left images": (lambda r: shutil.rmtree(r.folder / "image_0"), "image_0: expected a folder with 000000.png"),
    "no right images": (lambda r: shutil.rmtree(r.folder / "image_1"), "image_1: expected the right images"),
    "a gap": (lambda r: r.image(0, 0).unlink(), "000000.png: expected frames numbered from 0 without gaps"),
    "a right image missing": (lambda r: r.image(1, 1).unlink(), "image_1/000001.png: expected a colour image"),
    "a left image cut": (lambda r: _cut(r.image(0, 1)), "image_0/000001.png: expected a whole PNG file"),
    "an image of another size": (
        lambda r: cv2.imwrite(str(r.image(1, 1)), np.zeros((10, 20), np.uint8)),
        "image_1/000001.png: expected the size of the first image 160x60, found 20x10",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_refusals(recording: KittiRecording, damage: str) -> None:
    spoil, text = DAMAGES[damage]
    spoil(recording)
    with pytest.raises(SourceError) as caught:
        open_source(recording.uri).frame(1)
    assert text in str(caught.value)
    assert str(recording.folder) in str(caught.value)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ("depth=radar", "kitti: option depth: expected one of stereo, lidar; found 'radar'"),
        ("images=color", "image_2: expected a folder"),
        ("densify=-1", "kitti: option densify: expected pixels from 0 to 50; found '-1'"),
        ("densify=5", "kitti: option densify: expected beside depth=lidar, found depth=stereo"),
        ("scale=2", "kitti: expected options among"),
    ],
)
def test_refused_options(recording: KittiRecording, options: str, text: str) -> None:
    with pytest.raises(SourceError, match=text):
        open_source(f"{recording.uri}?{options}")


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda r: _cut(r.scan(0)), "expected a whole number of points of 16 bytes"),
        (lambda r: r.scan(0).unlink(), "expected a laser scan, found No such file"),
        (lambda r: r.scan(0).write_bytes(np.full(8, np.nan, "<f4").tobytes()), "expected finite coordinates"),
        (lambda r: shutil.rmtree(r.folder / "velodyne"), "velodyne: expected laser scans for depth=lidar"),
    ],
)
def test_damaged_scans(recording: KittiRecording, spoil: Callable[[KittiRecording], object], text: str) -> None:
    spoil(recording)
    with pytest.raises(SourceError, match=text):
        open_source(f"{recording.uri}?depth=lidar").frame(0)


def test_a_real_sequence() -> None:
    source = open_source(f"kitti:{shared_data('kitti06_stereo')}")
    poses = source.ground_truth()
    assert len(source) == 51
    assert poses is not None
    assert np.linalg.norm(poses[-1, :3, 3]) == pytest.approx(60.0, abs=1.0)
    depth_m = source.frame(0).depth_m()
    assert (depth_m > 0).mean() > 0.6
    # The road below the camera, which is 1.65 m above it.
    row = 340
    road = depth_m[row, 500:700]
    expected = source.camera.fy * 1.65 / (row + 0.5 - source.camera.cy)
    assert np.median(road[road > 0]) == pytest.approx(expected, rel=0.08)

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.mcap_bytes import CAMERA, STEP_NS, BagWriter, frames
from helpers.recordings import camera_path
from mcap.writer import CompressionType

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources.base import Source, SourceError
from vtslam.services.sensor.sources.registry import open_source

MS = 1_000_000


@pytest.fixture(scope="module")
def recorded() -> list[Frame]:
    return [replace(frame, depth_scale_m=0.001) for frame in frames(4)]


def opened(path: Path, **options: str) -> Source:
    return open_source(f"mcap:{path}", overrides=options)


def assert_plays(source: Source, recorded: list[Frame]) -> None:
    assert len(source) == len(recorded)
    for index, expected in enumerate(recorded):
        frame = source.frame(index)
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        np.testing.assert_array_equal(frame.depth, expected.depth)
        assert frame.camera == expected.camera
        assert (frame.capture_time_ns, frame.depth_scale_m) == (expected.capture_time_ns, expected.depth_scale_m)


@pytest.mark.parametrize(
    "bag",
    [
        BagWriter(),
        BagWriter(compression=CompressionType.ZSTD, chunk_size=20_000),
        BagWriter(compression=CompressionType.LZ4, chunk_size=20_000),
        BagWriter(use_chunking=False),
    ],
    ids=["plain", "zstd", "lz4", "no chunks"],
)
def test_raw_images_play_bit_by_bit(bag: BagWriter, recorded: list[Frame], tmp_path: Path) -> None:
    for frame in recorded:
        bag.add_frame(frame)
    assert_plays(opened(bag.write(tmp_path / "bag.mcap")), recorded)


def test_compressed_images_play_bit_by_bit(recorded: list[Frame], tmp_path: Path) -> None:
    bag = BagWriter()
    for frame in recorded:
        _, color = cv2.imencode(".png", frame.rgb[..., ::-1])
        _, depth = cv2.imencode(".png", frame.depth)
        bag.add_calibration("/camera/color/camera_info", CAMERA, frame.capture_time_ns)
        bag.add_compressed(
            "/camera/color/image_raw/compressed", color.tobytes(), "rgb8; png compressed bgr8", frame.capture_time_ns
        )
        bag.add_compressed(
            "/camera/depth/image_raw/compressedDepth",
            bytes(12) + depth.tobytes(),
            "16UC1; compressedDepth png",
            frame.capture_time_ns,
        )
    assert_plays(opened(bag.write(tmp_path / "bag.mcap")), recorded)


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("bgr8", lambda rgb: rgb[..., ::-1]),
        ("rgba8", lambda rgb: np.concatenate([rgb, rgb[..., :1]], axis=2)),
        ("bgra8", lambda rgb: np.concatenate([rgb[..., ::-1], rgb[..., :1]], axis=2)),
    ],
)
def test_encodings_of_colour(
    encoding: str, pixels: Callable[[np.ndarray], np.ndarray], recorded: list[Frame], tmp_path: Path
) -> None:
    bag, frame = BagWriter(), recorded[0]
    bag.add_calibration("/info", CAMERA, 0)
    bag.add_image("/image", pixels(frame.rgb), encoding, frame.capture_time_ns)
    bag.add_image("/depth", frame.depth, "16UC1", frame.capture_time_ns)
    assert_plays(opened(bag.write(tmp_path / "bag.mcap")), [frame])


def test_depth_in_metres_becomes_units(recorded: list[Frame], tmp_path: Path) -> None:
    bag, frame = BagWriter(), recorded[0]
    metres = frame.depth.astype(np.float32) * np.float32(0.001)
    metres[0, :6] = [np.nan, np.inf, -1.0, 0.0, 70.0, 0.0004]
    bag.add_calibration("/info", CAMERA, 0)
    bag.add_image("/image", frame.rgb, "rgb8", frame.capture_time_ns)
    bag.add_image("/depth", metres, "32FC1", frame.capture_time_ns)
    path = bag.write(tmp_path / "bag.mcap")
    found = opened(path).frame(0)
    np.testing.assert_array_equal(found.depth[0, :6], 0)
    np.testing.assert_array_equal(found.depth[1:], frame.depth[1:])
    coarse = opened(path, depth_scale="500").frame(0)
    assert coarse.depth_scale_m == 1.0 / 500.0
    assert coarse.depth[0, 4] == 35000
    np.testing.assert_allclose(coarse.depth_m()[1:], metres[1:], atol=0.00101)


def test_images_are_paired_by_their_stamps_within_the_tolerance(recorded: list[Frame], tmp_path: Path) -> None:
    bag = BagWriter()
    for index, frame in enumerate(recorded):
        bag.add_calibration("/info", CAMERA, frame.capture_time_ns)
        bag.add_image("/image", frame.rgb, "rgb8", frame.capture_time_ns, late_ns=200 * MS)
        if index != 2:  # one is missing, the others are early or late
            apart_ns = [-9 * MS, 14 * MS, 0, 17 * MS][index]
            bag.add_image("/depth", frame.depth, "16UC1", frame.capture_time_ns + apart_ns)
    path = bag.write(tmp_path / "bag.mcap")
    assert_plays(opened(path), [recorded[0], recorded[1]])
    assert_plays(opened(path, tolerance_ms="16.9"), [recorded[0], recorded[1]])
    times = [opened(path, tolerance_ms="17").frame(index).capture_time_ns for index in range(3)]
    # With 17 ms the last depth is as near to the third colour image as to its own, whose partner it stays.
    assert times == [recorded[index].capture_time_ns for index in (0, 1, 3)]
    with pytest.raises(SourceError, match=r"within 15 ms of each other .*found none"):
        opened(path, stamp="log")


def test_topics_are_found_by_name_or_named(recorded: list[Frame], tmp_path: Path) -> None:
    bag, frame = BagWriter(), recorded[0]
    time_ns, other = frame.capture_time_ns, np.zeros_like(frame.rgb)
    bag.add_calibration("/cam/depth/camera_info", replace(CAMERA, fx=1.0), time_ns)
    bag.add_calibration("/cam/color/camera_info", CAMERA, time_ns)
    bag.add_image("/cam/color/image_raw", frame.rgb, "rgb8", time_ns)
    bag.add_image("/cam/infra1/image_rect_raw", other[..., 0], "mono8", time_ns)
    bag.add_image("/cam/depth/image_rect_raw", frame.depth + 1, "16UC1", time_ns)
    bag.add_image("/cam/aligned_depth_to_color/image_raw", frame.depth, "16UC1", time_ns)
    path = bag.write(tmp_path / "bag.mcap")
    assert_plays(opened(path), [frame])
    chosen = opened(path, depth="/cam/depth/image_rect_raw", camera="/cam/depth/camera_info").frame(0)
    np.testing.assert_array_equal(chosen.depth, frame.depth + 1)
    assert chosen.camera.fx == 1.0
    with pytest.raises(SourceError, match=r"option color: expected a topic with images .*, found '/x'"):
        opened(path, color="/x")


def test_two_cameras_are_not_chosen_between(recorded: list[Frame], tmp_path: Path) -> None:
    bag, frame = BagWriter(), recorded[0]
    bag.add_frame(frame)
    bag.add_image("/other/image_raw", frame.rgb, "rgb8", frame.capture_time_ns)
    path = bag.write(tmp_path / "bag.mcap")
    with pytest.raises(
        SourceError, match=r"expected one topic of color images .*color=TOPIC.*, found /camera.*, /other"
    ):
        opened(path)
    assert_plays(opened(path, color="/other/image_raw"), [frame])


def test_distorted_images_are_refused_unless_accepted(recorded: list[Frame], tmp_path: Path) -> None:
    bag, frame = BagWriter(), recorded[0]
    bag.add_calibration("/camera/color/camera_info", CAMERA, 0, distortion=(0.1, -0.2, 0.0, 0.0, 0.0))
    bag.add_image("/camera/color/image_raw", frame.rgb, "rgb8", frame.capture_time_ns)
    bag.add_image("/camera/depth/image", frame.depth, "16UC1", frame.capture_time_ns)
    path = bag.write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match=r"without lens distortion, found coefficients \[0.1, -0.2"):
        opened(path)
    assert_plays(opened(path, distortion="ignore"), [frame])


RECTIFIED = replace(CAMERA, fx=38.0, cx=23.0)
DISTORTED = (0.1, -0.2, 0.0, 0.0, 0.0)


def colour_bag(name: str, frame: Frame, distortion: tuple[float, ...], rectified: Camera) -> BagWriter:
    bag, (_, packed) = BagWriter(), cv2.imencode(".png", frame.rgb[..., ::-1])
    bag.add_calibration("/camera/color/camera_info", CAMERA, 0, distortion=distortion, rectified=rectified)
    if name.endswith("compressed"):
        bag.add_compressed(name, packed.tobytes(), "rgb8; png compressed bgr8", frame.capture_time_ns)
    else:
        bag.add_image(name, frame.rgb, "rgb8", frame.capture_time_ns)
    bag.add_image("/camera/depth/image", frame.depth, "16UC1", frame.capture_time_ns)
    return bag


@pytest.mark.parametrize("options", [{}, {"distortion": "ignore"}, {"distortion": "refuse"}])
@pytest.mark.parametrize("distortion", [DISTORTED, (0.0,) * 5])
@pytest.mark.parametrize("last", ["image_rect", "image_rect_color", "rectified", "image_rect/compressed"])
def test_rectified_images_have_the_intrinsics_of_p(
    last: str, distortion: tuple[float, ...], options: dict[str, str], recorded: list[Frame], tmp_path: Path
) -> None:
    path = colour_bag(f"/camera/color/{last}", recorded[0], distortion, RECTIFIED).write(tmp_path / "bag.mcap")
    assert_plays(opened(path, **options), [replace(recorded[0], camera=RECTIFIED)])


def test_others_have_those_of_k(recorded: list[Frame], tmp_path: Path) -> None:
    path = colour_bag("/rect/direct_image", recorded[0], (0.0,) * 5, RECTIFIED).write(tmp_path / "bag.mcap")
    assert_plays(opened(path), [recorded[0]])


def test_rectified_images_without_p_are_refused_unless_k_is_accepted(recorded: list[Frame], tmp_path: Path) -> None:
    nothing = replace(CAMERA, cx=0.5, cy=0.5)
    for field in ("fx", "fy"):
        object.__setattr__(nothing, field, 0.0)
    bag = colour_bag("/camera/color/image_rect", recorded[0], DISTORTED, nothing)
    bag_path = bag.write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match=r"expected the matrix P of rectified images, found coefficients \[0.1"):
        opened(bag_path)
    assert_plays(opened(bag_path, distortion="ignore"), [recorded[0]])


def test_transforms_give_poses(recorded: list[Frame], tmp_path: Path) -> None:
    bag, poses = BagWriter(), camera_path(len(recorded) + 1)
    mounted = se3.exp(np.array([0.1, 0.0, 0.2, 0.3, -0.4, 0.1]))
    bag.add_transform("/tf_static", "base", "optical", mounted, 0)
    start_ns = recorded[0].capture_time_ns
    for index, T_world_base in enumerate(poses):  # between the frames, from half a step before the first
        bag.add_transform("/tf", "map", "base", T_world_base, start_ns + (2 * index - 1) * STEP_NS // 2)
    for frame in recorded:
        bag.add_frame(frame)
    path = bag.write(tmp_path / "bag.mcap")
    source = opened(path, poses="/tf", poses_sigma="0.1,2")
    for index in range(len(recorded)):
        prior = source.frame(index).pose_prior
        assert prior is not None
        middle = se3.exp(0.5 * se3.log(poses[index + 1] @ se3.inverse(poses[index]))) @ poses[index] @ mounted
        np.testing.assert_allclose(prior.T_world_camera, middle, atol=1e-6)
        np.testing.assert_allclose(prior.covariance[0, 0], 0.01)
    again = open_source(source.uri, frames=(1, 3)).frame(0).pose_prior
    assert again is not None
    based = opened(path, poses="/tf", world="base").frame(1).pose_prior
    assert based is not None
    np.testing.assert_allclose(based.T_world_camera, mounted, atol=1e-12)
    with pytest.raises(SourceError, match="expected transforms from 'optical' up to 'moon'"):
        opened(path, poses="/tf", world="moon")
    with pytest.raises(SourceError, match="expected a readable trajectory or a topic of transforms /tf, /tf_static"):
        opened(path, poses="/odom")


def test_a_bag_without_its_end_plays(recorded: list[Frame], tmp_path: Path) -> None:
    bag = BagWriter(chunk_size=14_000)
    for frame in recorded:
        bag.add_frame(frame)
    path = bag.write(tmp_path / "bag.mcap", finish=False)
    assert_plays(opened(path), recorded[:3])  # the last depth image was in the chunk in progress

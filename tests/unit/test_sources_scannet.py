import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.dataset_recordings import ScanNetRecording, SensRecording, sens_recording, write_scannet
from helpers.recordings import cut_in_half, write_png

from vtslam.services.sensor.sources.base import Source, SourceError
from vtslam.services.sensor.sources.registry import open_source


@pytest.fixture
def recording(tmp_path: Path) -> ScanNetRecording:
    return write_scannet(tmp_path / "scene0000_00")


def refusal(act: Callable[[], object]) -> str:
    with pytest.raises(SourceError) as caught:
        act()
    return str(caught.value)


def read_all(uri: str) -> Source:
    source = open_source(uri)
    for index in range(len(source)):
        source.frame(index)
    return source


def check_frames(source: Source, recording: ScanNetRecording | SensRecording) -> None:
    assert (len(source), source.family) == (3, "scannet")
    assert source.depth_scale_m == pytest.approx(0.001)
    camera = source.camera
    assert (camera.width, camera.height) == (32, 24)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((30.0, 31.0, 16.25, 12.25))
    poses = source.ground_truth()
    assert poses is not None
    np.testing.assert_allclose(poses, recording.poses, atol=1e-6)
    for index in (2, 0, 1):
        frame = source.frame(index)
        expected = cv2.resize(recording.rgb[index], (32, 24), interpolation=cv2.INTER_AREA)
        np.testing.assert_array_equal(frame.rgb, expected)
        np.testing.assert_array_equal(frame.depth, recording.depth[index])
    with pytest.raises(IndexError, match="frame 3 of 3"):
        source.frame(3)


def test_reads_an_exported_folder(recording: ScanNetRecording) -> None:
    check_frames(open_source(recording.uri), recording)


@pytest.mark.parametrize("compression", [0, 1])
def test_reads_a_sens_file(tmp_path: Path, compression: int) -> None:
    recording = sens_recording()
    recording.depth_compression = compression
    check_frames(open_source(recording.write(tmp_path / "scene.sens")), recording)


def test_sens_file_with_jpeg_colour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = sens_recording()
    recording.color_compression = 2
    jpeg = cv2.imencode(".jpg", recording.rgb[0][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    monkeypatch.setattr(SensRecording, "color_bytes", lambda self, index: jpeg)
    frame = open_source(recording.write(tmp_path / "scene.sens")).frame(1)
    expected = cv2.resize(recording.rgb[0], (32, 24), interpolation=cv2.INTER_AREA)
    assert np.abs(frame.rgb.astype(int) - expected).mean() < 3.0


def test_frames_exported_at_a_step_keep_their_times(tmp_path: Path) -> None:
    source = open_source(write_scannet(tmp_path / "scene", step=10).uri)
    assert [source.frame(index).capture_time_ns for index in range(3)] == [0, 333_333_333, 666_666_666]


def test_truth_is_nan_where_tracking_was_lost(recording: ScanNetRecording, tmp_path: Path) -> None:
    recording.pose_path(1).write_text("-inf -inf -inf -inf\n" * 4)
    sens = sens_recording()
    sens.poses[1] = -np.inf
    for uri in (recording.uri, sens.write(tmp_path / "scene.sens")):
        poses = open_source(uri).ground_truth()
        assert poses is not None
        np.testing.assert_array_equal(np.isfinite(poses).all(axis=(1, 2)), [True, False, True])


def test_no_truth_without_poses(recording: ScanNetRecording, tmp_path: Path) -> None:
    for index in range(3):
        recording.pose_path(index).unlink()
    sens = sens_recording()
    sens.poses[:] = -np.inf
    for uri in (recording.uri, sens.write(tmp_path / "scene.sens")):
        assert open_source(uri).ground_truth() is None


def test_intrinsics_of_the_paper_where_the_folder_has_none(recording: ScanNetRecording) -> None:
    recording.intrinsics_path.unlink()
    for index in range(3):
        write_png(recording.color_path(index), np.zeros((968, 1296, 3), np.uint8))
        write_png(recording.depth_path(index), np.zeros((480, 640), np.uint16))
    camera = open_source(recording.uri).camera
    assert camera.fx == pytest.approx(1169.621094 * 640 / 1296)
    assert camera.cy == pytest.approx(490.427032 * 480 / 968)


@pytest.mark.parametrize("kind", ["folder", "sens"])
def test_options_replace_intrinsics_and_scale(recording: ScanNetRecording, tmp_path: Path, kind: str) -> None:
    uri = recording.uri if kind == "folder" else sens_recording().write(tmp_path / "scene.sens")
    source = open_source(f"{uri}?fx=64&depth_scale=5000", size=(16, 12))
    assert source.camera.fx == pytest.approx(16.0)
    assert source.depth_scale_m == pytest.approx(1.0 / 5000.0)
    assert source.frame(0).rgb.shape == (12, 16, 3)
    assert open_source(source.uri).camera == source.camera


# --- damaged folders -------------------------------------------------------------------------------------------------


def remove_folder(name: str) -> Callable[[ScanNetRecording], object]:
    return lambda recording: (recording.folder / name).rename(recording.folder / f"not-{name}")


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (remove_folder("color"), "{folder}/color: expected a folder of numbered images, found none"),
        (remove_folder("depth"), "{folder}/depth: expected a folder of numbered images, found none"),
        (lambda r: r.color_path(1).unlink(), "{folder}/color: expected an image of frame 1 beside 1.png, found none"),
        (lambda r: r.depth_path(2).unlink(), "{folder}/depth: expected an image of frame 2 beside 2.png, found none"),
        (
            lambda r: [path(2).rename(path(5)) for path in (r.color_path, r.depth_path)],
            "{folder}/color: expected numbers 1 apart, found 5 after 1",
        ),
        (lambda r: cut_in_half(r.color_path(0)), "{folder}/color/0.png: expected a whole PNG file, .*"),
        (lambda r: cut_in_half(r.depth_path(1)), "{folder}/depth/1.png: expected a whole PNG file, .*"),
        (
            lambda r: write_png(r.color_path(1), r.rgb[1][:-2]),
            "{folder}/color/1.png: expected 64x48, found 64x46",
        ),
        (
            lambda r: write_png(r.depth_path(1), r.depth[1][:, :-1]),
            "{folder}/depth/1.png: expected 32x24, found 31x24",
        ),
        (
            lambda r: r.intrinsics_path.unlink(),
            "{folder}/intrinsic/intrinsic_color.txt: expected the intrinsics of colour images of 64x48, found no .*",
        ),
        (
            lambda r: r.intrinsics_path.write_text("1 2\n"),
            "{folder}/intrinsic/intrinsic_color.txt: expected 4 rows of 4 numbers, found 1 rows",
        ),
        (
            lambda r: r.intrinsics_path.write_text("0 0 32 0\n0 62 24 0\n0 0 1 0\n"),
            "{folder}/intrinsic/intrinsic_color.txt: fx: expected a positive number, found 0.0",
        ),
        (lambda r: r.pose_path(1).unlink(), "{folder}/pose/1.txt: expected the pose of frame 1, found no such file"),
        (
            lambda r: r.pose_path(1).write_text("1 0 0 0\n"),
            "{folder}/pose/1.txt: expected 4 rows of 4 numbers, found 1 rows",
        ),
        (
            lambda r: r.pose_path(1).write_text("2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n"),
            "{folder}/pose/1.txt: expected a rigid motion T_world_camera, found .*",
        ),
        (
            lambda r: r.pose_path(1).write_text("1 0 0 x\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
            "{folder}/pose/1.txt:1: expected a number, found 'x'",
        ),
    ],
)
def test_damaged_folders_are_refused(
    recording: ScanNetRecording, damage: Callable[[ScanNetRecording], object], text: str
) -> None:
    damage(recording)
    found = refusal(lambda: read_all(recording.uri))
    assert re.fullmatch(text.format(folder=re.escape(str(recording.folder))), found), found


def test_empty_folders(recording: ScanNetRecording) -> None:
    for index in range(3):
        recording.color_path(index).unlink()
        recording.depth_path(index).unlink()
    assert refusal(lambda: open_source(recording.uri)).endswith("expected color/0.jpg, depth/0.png, ..., found none")


# --- damaged .sens files ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"version": 3}, "expected a .sens file of version 4, found version 3"),
        ({"name": b"x" * 5000}, "expected a sensor name of at most 4096 bytes, found 5000"),
        ({"color_compression": 0}, r"expected colour compression 1 \(PNG\) or 2 \(JPEG\), found 0"),
        ({"depth_compression": 2}, r"expected depth compression 0 \(raw\) or 1 \(zlib\), found 2"),
        ({"sizes": (64, 48, 0, 24)}, r"expected image sizes from 1 to 32767, found \[64, 48, 0, 24\]"),
        ({"units_per_m": 0.0}, "expected positive depth units per metre, found 0.0"),
        ({"num_frames": 0}, "expected frames, found none"),
        ({"num_frames": 4}, "expected 96 bytes of frame 3 of 4, found the file cut after 0 of them"),
        ({"num_frames": 2**60}, "expected 96 bytes of frame 3 of .*, found the file cut after 0 of them"),
        ({"sizes": (32, 24, 32, 24)}, "frame 0: colour: expected an image of 32x24, found 64x48"),
        ({"sizes": (64, 48, 32, 48)}, "frame 0: depth: expected 3072 bytes for 32x48, found 1536"),
        ({"sizes": (64, 48, 32, 12)}, "frame 0: depth: expected 768 bytes for 32x12, found 769"),
    ],
)
def test_sens_files_that_say_something_else(tmp_path: Path, changes: dict[str, object], text: str) -> None:
    recording = sens_recording()
    for key, value in changes.items():
        setattr(recording, key, value)
    uri = recording.write(tmp_path / "scene.sens")
    found = refusal(lambda: read_all(uri))
    assert re.fullmatch(f"{re.escape(str(tmp_path / 'scene.sens'))}: {text}", found), found


def test_sens_file_cut_anywhere_is_refused_by_name(tmp_path: Path) -> None:
    recording = sens_recording()
    path = tmp_path / "scene.sens"
    uri = recording.write(path)
    whole = path.read_bytes()
    for length in [*range(0, 400, 7), *range(400, len(whole), 997), len(whole) - 1]:
        path.write_bytes(whole[:length])
        assert refusal(lambda: open_source(uri)).startswith(f"{path}: expected ")


@pytest.mark.parametrize(
    ("image", "text"),
    [
        ({"depth": b"nonsense"}, "frame 1: depth: expected zlib data, found .*"),
        ({"color": b"nonsense"}, "frame 1: colour: expected a PNG or JPEG file, found .*"),
        ({"depth": b""}, "frame 1: depth: expected 1536 bytes for 32x24, found 0"),
        ({"color": b""}, "frame 1: colour: expected a PNG or JPEG file, found an empty file"),
    ],
)
def test_damaged_images_of_a_sens_file(tmp_path: Path, image: dict[str, bytes], text: str) -> None:
    recording, path = sens_recording(), tmp_path / "scene.sens"
    frames = recording.frame(0) + recording.frame(1, **image) + recording.frame(2)
    path.write_bytes(recording.header() + frames)
    source = open_source(f"scannet:{path}")
    source.frame(0)
    source.frame(2)
    found = refusal(lambda: source.frame(1))
    assert re.fullmatch(f"{re.escape(str(path))}: {text}", found), found


def test_pose_of_a_sens_file_that_is_not_rigid(tmp_path: Path) -> None:
    recording = sens_recording()
    recording.poses[1] *= 2.0
    uri = recording.write(tmp_path / "scene.sens")
    assert "frame 1: expected a rigid motion T_world_camera" in refusal(lambda: open_source(uri))


def test_sens_file_that_vanishes_or_shrinks(tmp_path: Path) -> None:
    path = tmp_path / "scene.sens"
    source = open_source(sens_recording().write(path))
    path.write_bytes(path.read_bytes()[:-1])
    assert "of the depth of frame 2, found the file cut after" in refusal(lambda: source.frame(2))
    path.unlink()
    assert (
        refusal(lambda: source.frame(0))
        == f"{path}: frame 0: expected a readable file, found No such file or directory"
    )
    assert refusal(lambda: open_source(f"scannet:{path}")).startswith(f"{path}: expected a readable .sens file, found ")

"""What every reader refuses, and that the message names the file, what was expected and what was found."""

import copy
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.recordings import Recording, cut_in_half, images, pose_row, write_png, write_replica, write_seven_scenes

from vtslam.services.sensor.sources import image_files
from vtslam.services.sensor.sources.base import Source, SourceError
from vtslam.services.sensor.sources.registry import open_source

WRITERS: dict[str, Callable[[Path], Recording]] = {"replica": write_replica, "7scenes": write_seven_scenes}


@pytest.fixture(params=WRITERS)
def scheme(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Recording]:
    return {scheme: write(tmp_path_factory.mktemp(scheme) / "original") for scheme, write in WRITERS.items()}


@pytest.fixture
def recording(scheme: str, originals: dict[str, Recording], tmp_path: Path) -> Recording:
    """A copy that the test may damage."""
    copied = copy.copy(originals[scheme])
    copied.folder = shutil.copytree(copied.folder, tmp_path / "recording")
    return copied


def refusal(act: Callable[[], object]) -> str:
    with pytest.raises(SourceError) as caught:
        act()
    return str(caught.value)


def read_all(recording: Recording) -> None:
    source = open_source(recording.uri)
    for index in range(len(source)):
        source.frame(index)


def opened(recording: Recording) -> Callable[[], Source]:
    return lambda: open_source(recording.uri)


def test_reads_what_was_written(recording: Recording) -> None:
    source = open_source(recording.uri)
    poses = source.ground_truth()
    assert len(source) == 3
    assert poses is not None
    np.testing.assert_allclose(poses, recording.poses, atol=1e-12)
    for index in (2, 0, 1):
        frame = source.frame(index)
        assert frame.frame_id == index
        assert frame.capture_time_ns == index * 1_000_000_000 // 30
        assert frame.camera == source.camera
        np.testing.assert_array_equal(frame.rgb, recording.rgb[index])
        np.testing.assert_array_equal(frame.depth, recording.depth[index])
        assert frame.depth_m().max() == pytest.approx(recording.depth[index].max() / 1000.0)


def test_no_such_frame(recording: Recording) -> None:
    source = open_source(recording.uri)
    with pytest.raises(IndexError, match="frame 3 of 3"):
        source.frame(3)


def test_without_poses_there_is_no_ground_truth(recording: Recording) -> None:
    for index in range(3):
        recording.pose_path(index).unlink(missing_ok=True)
    assert open_source(recording.uri).ground_truth() is None


def test_missing_folder(scheme: str, tmp_path: Path) -> None:
    text = refusal(lambda: open_source(f"{scheme}:{tmp_path / 'none'}"))
    assert text == f"{tmp_path / 'none'}: expected a folder of a recording, found none"


def test_no_folder_named(scheme: str) -> None:
    assert refusal(lambda: open_source(f"{scheme}:")) == f"{scheme}:: expected a folder of a recording, found none"


def test_file_instead_of_folder(scheme: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    text = refusal(lambda: open_source(f"{scheme}:{tmp_path / 'file'}"))
    assert text == f"{tmp_path / 'file'}: expected a folder of a recording, found a file"


def test_empty_folder(scheme: str, tmp_path: Path) -> None:
    text = refusal(lambda: open_source(f"{scheme}:{tmp_path}"))
    assert re.match(rf"{re.escape(str(tmp_path))}: expected .*frame.*, found none$", text)


def test_folder_without_images(recording: Recording) -> None:
    for index in range(3):
        recording.color_path(index).unlink()
        recording.depth_path(index).unlink()
    text = refusal(opened(recording))
    assert text.startswith(f"{recording.color_path(0).parent}: expected colour images frame")
    assert text.endswith(", found none")


@pytest.mark.parametrize("index", [0, 1, 2])
def test_missing_depth_image(recording: Recording, index: int) -> None:
    recording.depth_path(index).unlink()
    color = recording.color_path(index).name
    expected = f"{recording.depth_path(index)}: expected a depth image beside {color}, found none"
    assert refusal(opened(recording)) == expected


def test_missing_color_image(recording: Recording) -> None:
    recording.color_path(1).unlink()
    text = refusal(opened(recording))
    assert text.startswith(str(recording.color_path(1).with_suffix("")))
    assert text.endswith(f": expected a colour image beside {recording.depth_path(1).name}, found none")


def test_gap_in_the_numbering(recording: Recording) -> None:
    recording.color_path(1).unlink()
    recording.depth_path(1).unlink()
    assert refusal(opened(recording)) == (
        f"{recording.color_path(1).parent}: expected frames numbered from 0 without gaps, found 2 up to number 2 "
        "and none of number 1"
    )


def test_two_files_of_one_number(recording: Recording) -> None:
    twin = recording.depth_path(1).with_name(recording.depth_path(1).name.replace("000001", "1"))
    twin.write_bytes(recording.depth_path(1).read_bytes())
    text = refusal(opened(recording))
    assert "expected one file per frame, found" in text
    assert str(twin.parent) in text


@pytest.mark.parametrize(("kind", "what"), [("depth_path", "depth image"), ("color_path", "colour image")])
def test_image_that_vanishes_after_opening(recording: Recording, kind: str, what: str) -> None:
    source = open_source(recording.uri)
    path: Path = getattr(recording, kind)(1)
    path.unlink()
    assert refusal(lambda: source.frame(1)) == f"{path}: expected a {what}, found no such file"


@pytest.mark.parametrize("kind", ["depth_path", "color_path"])
def test_png_cut_in_half(recording: Recording, kind: str) -> None:
    path: Path = getattr(recording, kind)(1)
    cut_in_half(path)
    text = refusal(lambda: read_all(recording))
    assert text.startswith(f"{path}: expected a whole PNG file, found it cut after {path.stat().st_size} bytes")


@pytest.mark.parametrize("kind", ["depth_path", "color_path"])
def test_png_without_its_end(recording: Recording, kind: str) -> None:
    path: Path = getattr(recording, kind)(1)
    path.write_bytes(path.read_bytes()[:-12])
    assert "expected a whole PNG file, found it cut after" in refusal(lambda: read_all(recording))


@pytest.mark.parametrize("kind", ["depth_path", "color_path"])
def test_png_with_a_changed_byte(recording: Recording, kind: str) -> None:
    path: Path = getattr(recording, kind)(1)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    text = refusal(lambda: read_all(recording))
    assert text == f"{path}: expected a sound PNG file, found a wrong checksum in chunk b'IDAT'"


@pytest.mark.parametrize("kind", ["depth_path", "color_path"])
@pytest.mark.parametrize(
    ("data", "found"), [(b"", "an empty file"), (b"not a picture", "a file that begins with 6e 6f 74")]
)
def test_image_of_another_kind(recording: Recording, kind: str, data: bytes, found: str) -> None:
    path: Path = getattr(recording, kind)(1)
    path.write_bytes(data)
    text = refusal(lambda: read_all(recording))
    assert re.match(rf"{re.escape(str(path))}: expected a .*PNG.* file, found {found}", text)


def test_8_bit_depth(recording: Recording) -> None:
    write_png(recording.depth_path(1), (recording.depth[1] // 256).astype(np.uint8))
    expected = f"{recording.depth_path(1)}: expected 16-bit gray depth, found 8-bit gray"
    assert refusal(lambda: read_all(recording)) == expected


def test_depth_that_is_a_color_image(recording: Recording) -> None:
    write_png(recording.depth_path(1), recording.rgb[1].astype(np.uint16))
    expected = f"{recording.depth_path(1)}: expected 16-bit gray depth, found 16-bit PNG colour type 2"
    assert refusal(lambda: read_all(recording)) == expected


def test_16_bit_color(recording: Recording) -> None:
    write_png(recording.color_path(1), recording.rgb[1].astype(np.uint16))
    expected = f"{recording.color_path(1)}: expected an 8-bit colour image, found 16 bits per channel"
    assert refusal(lambda: read_all(recording)) == expected


def test_color_and_depth_of_differing_sizes(recording: Recording) -> None:
    height, width = recording.depth[1].shape
    write_png(recording.depth_path(1), recording.depth[1][:-2])
    assert refusal(lambda: read_all(recording)) == (
        f"{recording.depth_path(1)}: expected the size of its colour image {width}x{height}, found {width}x{height - 2}"
    )


def test_images_of_another_size_than_the_intrinsics(recording: Recording) -> None:
    height, width = recording.depth[1].shape
    write_png(recording.depth_path(1), recording.depth[1][:-2])
    write_png(recording.color_path(1), recording.rgb[1][:-2])
    assert refusal(lambda: read_all(recording)) == (
        f"{recording.color_path(1)}: expected the size of the intrinsics {width}x{height}, found {width}x{height - 2}"
    )


@pytest.mark.parametrize("count", [2, 4])
def test_trajectory_of_the_wrong_length(recording: Recording, count: int) -> None:
    recording.write_poses([pose_row(np.eye(4))] * count)
    text = refusal(opened(recording))
    assert text.startswith(str(recording.folder))
    assert f"expected 3 poses, one for each frame, found {count}" in text


@pytest.mark.parametrize("value", ["nan", "inf"])
def test_pose_that_is_not_finite(recording: Recording, value: str) -> None:
    rows = [pose_row(T) for T in recording.poses]
    rows[1] = rows[1].replace(rows[1].split()[3], value, 1)
    recording.write_poses(rows)
    text = refusal(opened(recording))
    assert text.startswith(f"{recording.pose_place(1)}: expected a finite pose, found [")
    assert value in text


def test_pose_that_is_not_rigid(recording: Recording) -> None:
    rows = [pose_row(T) for T in recording.poses]
    rows[2] = pose_row(np.diag([1.1, 1.1, 1.1, 1.0]))
    recording.write_poses(rows)
    text = refusal(opened(recording))
    assert text.startswith(f"{recording.pose_place(2)}: expected a rigid motion T_world_camera, found [1.1, ")


def test_pose_with_an_unreadable_number(recording: Recording) -> None:
    rows = [pose_row(T) for T in recording.poses]
    rows[1] = rows[1].replace(rows[1].split()[0], "1,0", 1)
    recording.write_poses(rows)
    text = refusal(opened(recording))
    assert text.startswith(str(recording.pose_path(1)))
    assert text.endswith(": expected a number, found '1,0'")


def test_pose_with_too_few_numbers(recording: Recording) -> None:
    rows = [pose_row(T) for T in recording.poses]
    rows[1] = " ".join(rows[1].split()[:-1])
    recording.write_poses(rows)
    text = refusal(opened(recording))
    assert text.startswith(str(recording.pose_path(1)))
    assert re.search(r"expected (16|4) numbers, found (15|3)$", text)


def test_unknown_option(scheme: str, recording: Recording) -> None:
    text = refusal(lambda: open_source(f"{recording.uri}?colour=red"))
    assert re.match(rf"{scheme}: expected options among cx, .*, size; found 'colour'$", text)


@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "wide"])
def test_intrinsics_option_that_is_not_positive(scheme: str, recording: Recording, value: str) -> None:
    text = refusal(lambda: open_source(recording.uri, overrides={"fx": value}))
    assert text == f"{scheme}: option fx: expected a positive number, found {value!r}"


def test_options_replace_intrinsics_and_scale(recording: Recording) -> None:
    source = open_source(f"{recording.uri}?fx=50&fy=51&cx=20&cy=15&depth_scale=5000")
    camera = source.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 51.0, 20.5, 15.5)
    assert source.depth_scale_m == pytest.approx(1.0 / 5000.0)
    assert open_source(source.uri).camera == camera


def test_same_bytes_from_another_working_directory(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(recording.folder.parent)
    scheme = recording.uri.partition(":")[0]
    source = open_source(f"{scheme}:{recording.folder.name}", size=(24, 18), frames=(1, 3))
    monkeypatch.chdir(tmp_path.parent)
    again = open_source(source.uri)
    assert (again.uri, again.camera, len(again)) == (source.uri, source.camera, 2)
    for index in range(2):
        np.testing.assert_array_equal(again.frame(index).rgb, source.frame(index).rgb)
        np.testing.assert_array_equal(again.frame(index).depth, source.frame(index).depth)


def _claiming(jpeg: bytes, width: int, height: int) -> bytes:
    """The JPEG file with another size in its frame header."""
    at = max(jpeg.find(b"\xff\xc0"), jpeg.find(b"\xff\xc2"))
    return jpeg[: at + 5] + struct.pack(">HH", height, width) + jpeg[at + 9 :]


@pytest.mark.parametrize("progressive", [0, 1])
@pytest.mark.parametrize(
    "before", [b"", b"\xff\xff", b"\xff\xe1\x00\x08\xff\xc0\x00\x11\x08\x00", b"\xff\xfe\x00\x04hm"]
)
def test_images_of_another_size_are_not_unpacked(
    before: bytes, progressive: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rgb = images(1, width=48, height=36)[0][0]
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive, cv2.IMWRITE_JPEG_QUALITY, 98]
    plain = cv2.imencode(".jpg", rgb[..., ::-1], flags)[1].tobytes()
    jpeg = plain[:2] + before + plain[2:]
    assert image_files.decoded_color(jpeg, "x", (48, 36)).shape == (36, 48, 3)
    monkeypatch.setattr(image_files, "_decode", lambda *args: pytest.fail("it was unpacked"))
    large = plain[:2] + before + _claiming(plain, 9000, 9001)[2:]
    told = refusal(lambda: image_files.decoded_color(large, "x", (48, 36)))
    assert told == "x: expected an image of 48x36, found 9000x9001"


@pytest.mark.parametrize("rest", [b"", b"\xff\xe0\x00\x02", b"\xff\xe0\xff\xff", b"\xff\xda\x00\x02", b"\xff\xc0\x00"])
def test_jpeg_files_without_a_frame_header_are_refused(rest: bytes) -> None:
    data = b"\xff\xd8" + rest + b"\xff\xd9"
    told = refusal(lambda: image_files.decoded_color(data, "x", (48, 36)))
    assert told == "x: expected a JPEG file with a frame header, found none before its data"

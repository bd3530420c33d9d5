from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import ReplicaRecording, write_replica

from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.registry import open_source


@pytest.fixture
def recording(tmp_path: Path) -> ReplicaRecording:
    return write_replica(tmp_path / "room", num_frames=5)


def test_unknown_scheme_lists_the_known_ones() -> None:
    known = "among replica:DIR, 7scenes:DIR, tum:DIR, .*sim:room.*, mcap:FILE; found 'tape:x'"
    with pytest.raises(SourceError, match=known):
        open_source("tape:x")


@pytest.mark.parametrize("text", ["no-scheme", ":path"])
def test_text_without_scheme(text: str) -> None:
    with pytest.raises(SourceError, match=f"got '{text}'"):
        open_source(text)


def test_options_must_read_key_value() -> None:
    with pytest.raises(SourceError, match=r"key=value&key=value; got 'fast'"):
        open_source("replica:x?fast")


def test_uri_text_reads_back() -> None:
    uri = SourceUri(scheme="sim", path="room", options={"size": "4x3", "note": "a b&c=d?", "range": "0:2"})
    assert SourceUri.parse(str(uri)) == uri


def test_resize_is_that_of_the_frame(recording: ReplicaRecording) -> None:
    whole, small = open_source(recording.uri), open_source(recording.uri, size=(16, 12))
    frame, expected = small.frame(2), whole.frame(2).resized(16, 12)
    np.testing.assert_array_equal(frame.rgb, expected.rgb)
    np.testing.assert_array_equal(frame.depth, expected.depth)
    assert small.camera == frame.camera == whole.camera.resized(16, 12)
    assert (small.family, small.depth_scale_m, len(small)) == (whole.family, whole.depth_scale_m, 5)
    np.testing.assert_array_equal(_poses(small.ground_truth()), _poses(whole.ground_truth()))


def test_resize_to_the_same_size_changes_nothing(recording: ReplicaRecording) -> None:
    assert open_source(recording.uri, size=(48, 36)).uri == open_source(recording.uri).uri


def test_range_counts_from_zero_and_cuts_ground_truth(recording: ReplicaRecording) -> None:
    whole, part = open_source(recording.uri), open_source(recording.uri, frames=(2, 4))
    assert len(part) == 2
    for index in range(2):
        frame, expected = part.frame(index), whole.frame(index + 2)
        assert frame.frame_id == index
        assert frame.capture_time_ns == expected.capture_time_ns
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
    np.testing.assert_array_equal(_poses(part.ground_truth()), _poses(whole.ground_truth())[2:4])
    assert (part.camera, part.family, part.depth_scale_m) == (whole.camera, whole.family, whole.depth_scale_m)


@pytest.mark.parametrize("index", [-1, 2])
def test_range_ends_where_it_ends(recording: ReplicaRecording, index: int) -> None:
    with pytest.raises(IndexError, match=f"frame {index} of 2"):
        open_source(recording.uri, frames=(2, 4)).frame(index)


@pytest.mark.parametrize("frames", [(0, 6), (3, 3), (4, 2), (-1, 2)])
def test_range_outside_the_source(recording: ReplicaRecording, frames: tuple[int, int]) -> None:
    with pytest.raises(SourceError, match=f"0 <= A < B <= 5, found {frames[0]}:{frames[1]}"):
        open_source(recording.uri, frames=frames)


def test_size_must_be_positive(recording: ReplicaRecording) -> None:
    with pytest.raises(SourceError, match="expected a positive width and height, found 0x12"):
        open_source(recording.uri, size=(0, 12))


def test_size_and_range_as_options(recording: ReplicaRecording) -> None:
    source = open_source(f"{recording.uri}?range=1:&size=24x18")
    assert (len(source), source.camera.width, source.camera.height) == (4, 24, 18)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("size=24", "option size: expected WxH, as in 320x240; found '24'"),
        ("size=ax3", "found 'ax3'"),
        ("range=5", "option range: expected A:B, as in 0:120; found '5'"),
        ("range=a:3", "found 'a:3'"),
    ],
)
def test_unreadable_size_and_range(recording: ReplicaRecording, option: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        open_source(f"{recording.uri}?{option}")


def test_opening_again_with_the_same_arguments(recording: ReplicaRecording) -> None:
    source = open_source(recording.uri, size=(24, 18), frames=(2, 5))
    again = open_source(source.uri, size=(24, 18), frames=(2, 5))
    assert again.uri == source.uri
    np.testing.assert_array_equal(again.frame(0).rgb, source.frame(0).rgb)


def test_overrides_replace_options(recording: ReplicaRecording) -> None:
    source = open_source(f"{recording.uri}?fx=50&fy=60", overrides={"fx": "70"})
    assert (source.camera.fx, source.camera.fy) == (70.0, 60.0)


def _poses(poses: object) -> np.ndarray:
    assert isinstance(poses, np.ndarray)
    return poses

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.dataset_recordings import ScanNetPpRecording, write_scannetpp
from helpers.recordings import cut_in_half, write_png

from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.registry import open_source


@pytest.fixture
def recording(tmp_path: Path) -> ScanNetPpRecording:
    return write_scannetpp(tmp_path / "b20a261fdf")


def test_reads_the_training_images_in_their_order(recording: ScanNetPpRecording) -> None:
    source = open_source(recording.uri, size=(64, 48))
    assert (len(source), source.family, source.depth_scale_m) == (3, "scannetpp", 0.001)
    camera = source.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 61.0, 32.0, 24.0)
    poses = source.ground_truth()
    assert poses is not None
    np.testing.assert_allclose(poses, recording.poses[:3], atol=1e-12)
    for index in (2, 0, 1):
        frame = source.frame(index)
        np.testing.assert_array_equal(frame.rgb, recording.rgb[index])
        np.testing.assert_array_equal(frame.depth, recording.depth[index])


def test_half_size_unless_another_is_asked_for(recording: ScanNetPpRecording) -> None:
    half = open_source(recording.uri)
    assert (half.camera.width, half.camera.height, half.camera.fx, half.camera.cx) == (32, 24, 30.0, 16.0)
    again = open_source(half.uri)
    assert (again.uri, again.camera) == (half.uri, half.camera)
    whole = open_source(recording.uri, size=(64, 48))
    np.testing.assert_array_equal(half.frame(1).rgb, whole.frame(1).resized(32, 24).rgb)


def test_held_out_split_begins_with_the_first_training_image(recording: ScanNetPpRecording) -> None:
    source = open_source(f"{recording.uri}?split=test", size=(64, 48))
    poses = source.ground_truth()
    assert poses is not None
    np.testing.assert_allclose(poses, recording.poses[[0, 3, 4]], atol=1e-12)
    for index, written in enumerate((0, 3, 4)):
        np.testing.assert_array_equal(source.frame(index).rgb, recording.rgb[written])


def test_the_folder_of_the_dslr_images_itself(recording: ScanNetPpRecording) -> None:
    assert len(open_source(f"scannetpp:{recording.folder / 'dslr'}")) == 3


def test_depth_scale_and_range(recording: ScanNetPpRecording) -> None:
    source = open_source(f"{recording.uri}?depth_scale=2000&range=1:3")
    assert (len(source), source.depth_scale_m) == (2, 1.0 / 2000.0)


Damage = Callable[[ScanNetPpRecording], object]


def transforms(**changes: object) -> Damage:
    """Other transforms; a value of None leaves the key out."""

    def damage(recording: ScanNetPpRecording) -> None:
        content = {**recording.transforms(), **changes}
        kept = {key: value for key, value in content.items() if value is not None}
        recording.write_json(kept, {"train": recording.names[:3], "test": recording.names[3:]})

    return damage


def lists(content: object) -> Damage:
    return lambda recording: recording.write_json(recording.transforms(), content)


def matrix(value: object) -> Damage:
    return transforms(frames=[{"file_path": f"DSC0{n}.JPG", "transform_matrix": value} for n in (1752, 1750, 1751)])


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (
            lambda r: r.transforms_path.unlink(),
            "{transforms}: expected a JSON file of a DSLR recording, found no such file",
        ),
        (lambda r: r.lists_path.unlink(), "{lists}: expected a JSON file of a DSLR recording, found no such file"),
        (lambda r: r.transforms_path.write_text("{"), "{transforms}:1: expected JSON, found .*"),
        (lambda r: r.transforms_path.write_text("[]"), "{transforms}: expected a JSON object, found list"),
        (transforms(fl_x=None), "{transforms}: fl_x: expected a positive number, found None"),
        (transforms(cy="24"), "{transforms}: cy: expected a positive number, found '24'"),
        (transforms(w=64.5), "{transforms}: w: expected a whole number, found 64.5"),
        (transforms(frames=None), "{transforms}: frames: expected a list of frames, found None"),
        (transforms(frames=[]), "{transforms}: frames: DSC01752.JPG: expected a frame with this file_path, found none"),
        (matrix("x"), "{transforms}: frames: DSC01752.JPG: expected a transform_matrix of 4 rows .*, found 'x'"),
        (matrix([[1, 2], [3]]), "{transforms}: frames: DSC01752.JPG: expected a transform_matrix .*"),
        (
            matrix((2.0 * np.eye(4)).tolist()),
            "{transforms}: frames: DSC01752.JPG: expected a rigid motion T_world_camera, found .*",
        ),
        (matrix((np.nan * np.eye(4)).tolist()), "{transforms}: frames: DSC01752.JPG: expected a finite pose, found .*"),
        (lists({}), "{lists}: train: expected a list of image names, found None"),
        (lists({"train": []}), r"{lists}: train: expected a list of image names, found \[\]"),
        (lists({"train": [1]}), r"{lists}: train: expected a list of image names, found \[1\]"),
        (lists({"train": ["../x.JPG"]}), "{lists}: train: expected names without folders, found '../x.JPG'"),
        (lambda r: r.color_path(1).unlink(), "{color}: expected a colour image, found no such file"),
        (lambda r: r.depth_path(1).unlink(), "{depth}: expected a depth image, found no such file"),
        (lambda r: cut_in_half(r.color_path(1)), "{color}: expected a whole PNG file, found it cut after .*"),
        (lambda r: cut_in_half(r.depth_path(1)), "{depth}: expected a whole PNG file, found it cut after .*"),
        (
            lambda r: write_png(r.depth_path(1), r.depth[1][:-1]),
            "{depth}: expected the size of its colour image 64x48, found 64x47",
        ),
    ],
)
def test_damaged_scenes_are_refused(recording: ScanNetPpRecording, damage: Damage, text: str) -> None:
    damage(recording)
    with pytest.raises(SourceError) as caught:
        open_source(recording.uri).frame(1)
    paths = {
        "transforms": recording.transforms_path,
        "lists": recording.lists_path,
        "color": recording.color_path(1),
        "depth": recording.depth_path(1),
    }
    wanted = text.format(**{key: re.escape(str(path)) for key, path in paths.items()})
    assert re.fullmatch(wanted, str(caught.value)), str(caught.value)


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("split=validation", "scannetpp: option split: expected one of train, test; found 'validation'"),
        ("depth_scale=-1", "scannetpp: option depth_scale: expected a positive number, found '-1'"),
        ("fx=3", "scannetpp: expected options among .*; found 'fx'"),
    ],
)
def test_bad_options_are_refused(recording: ScanNetPpRecording, option: str, text: str) -> None:
    with pytest.raises(SourceError, match=text):
        open_source(f"{recording.uri}?{option}")

from pathlib import Path

import numpy as np
import pytest
from helpers.recordings import SevenScenesRecording, write_png, write_seven_scenes

from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.registry import open_source


@pytest.fixture
def scene(tmp_path: Path) -> SevenScenesRecording:
    return write_seven_scenes(tmp_path / "office" / "seq-03", num_frames=1)


def test_camera_family_and_scale(scene: SevenScenesRecording) -> None:
    source = open_source(scene.uri)
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (640, 480, 585.0, 585.0)
    assert (camera.cx, camera.cy) == (320.5, 240.5)
    assert (source.family, source.depth_scale_m) == ("tum", 0.001)


def test_65535_means_no_depth(scene: SevenScenesRecording) -> None:
    depth = scene.depth[0].copy()
    depth[:10] = 65535
    depth[10] = 65534
    write_png(scene.depth_path(0), depth)
    read = open_source(scene.uri).frame(0).depth
    assert not read[:10].any()
    np.testing.assert_array_equal(read[10:], depth[10:])


def test_folder_of_one_sequence(scene: SevenScenesRecording) -> None:
    assert len(open_source(f"7scenes:{scene.folder.parent}")) == 1


def test_folder_of_several_sequences(scene: SevenScenesRecording) -> None:
    write_seven_scenes(scene.folder.with_name("seq-11"), num_frames=2)
    office = scene.folder.parent
    with pytest.raises(SourceError) as caught:
        open_source(f"7scenes:{office}")
    assert str(caught.value) == f"{office}: expected one sequence, found seq-03, seq-11; choose with ?seq=03"
    source = open_source(f"7scenes:{office}?seq=11")
    assert len(source) == 2
    assert len(open_source(source.uri)) == 2


def test_no_such_sequence(scene: SevenScenesRecording) -> None:
    office = scene.folder.parent
    with pytest.raises(SourceError) as caught:
        open_source(f"7scenes:{office}?seq=7")
    assert str(caught.value) == f"{office}/seq-7: expected a sequence folder, found seq-03"


def test_pose_of_three_rows(scene: SevenScenesRecording) -> None:
    path = scene.pose_path(0)
    path.write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n")
    with pytest.raises(SourceError) as caught:
        open_source(scene.uri)
    assert str(caught.value) == f"{path}: expected 4 rows of 4 numbers, found 3 rows"


def test_pose_of_a_frame_that_is_not_there(scene: SevenScenesRecording) -> None:
    scene.pose_path(0).rename(scene.pose_path(4))
    with pytest.raises(SourceError, match=r"expected 1 poses, .* found 1 pose files \(first difference at frame 0\)"):
        open_source(scene.uri)

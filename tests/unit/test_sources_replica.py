import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.recordings import ReplicaRecording, cut_in_half, write_png, write_replica
from helpers.shared_data import shared_data

from vtslam.common.geometry import se3
from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.registry import open_source

CAMERA = {"w": 48, "h": 36, "fx": 40.0, "fy": 42.0, "cx": 23.5, "cy": 17.5, "scale": 1000.0}


@pytest.fixture
def recording(tmp_path: Path) -> ReplicaRecording:
    return write_replica(tmp_path / "scenes" / "room")


def write_params(recording: ReplicaRecording, content: object) -> Path:
    path = recording.folder / "cam_params.json"
    path.write_text(json.dumps(content))
    return path


def test_principal_point_moves_by_half_a_pixel(recording: ReplicaRecording) -> None:
    camera = open_source(recording.uri).camera
    assert (camera.cx, camera.cy, camera.fx, camera.fy) == (24.0, 18.0, 40.0, 42.0)


def test_parameters_beside_the_scene(recording: ReplicaRecording) -> None:
    path = recording.folder / "cam_params.json"
    path.rename(recording.folder.parent / path.name)
    assert open_source(recording.uri).camera.fx == 40.0


def test_defaults_of_replica(recording: ReplicaRecording) -> None:
    (recording.folder / "cam_params.json").unlink()
    for index in range(3):
        write_png(recording.color_path(index), np.zeros((680, 1200, 3), np.uint8))
        write_png(recording.depth_path(index), np.full((680, 1200), 13107, np.uint16))
    source = open_source(recording.uri)
    camera = source.camera
    assert (camera.width, camera.height, camera.fx, camera.cx, camera.cy) == (1200, 680, 600.0, 600.0, 340.0)
    assert source.family == "replica"
    assert source.frame(0).depth_m()[0, 0] == pytest.approx(2.0)


def test_another_camera_is_of_the_hand_held_family(recording: ReplicaRecording) -> None:
    assert open_source(recording.uri).family == "tum"


def test_depth_65535_is_a_depth(recording: ReplicaRecording) -> None:
    write_png(recording.depth_path(0), np.full((36, 48), 65535, np.uint16))
    assert int(open_source(recording.uri).frame(0).depth.min()) == 65535


def test_jpeg(recording: ReplicaRecording) -> None:
    _replace_by_jpeg(recording)
    frame = open_source(recording.uri).frame(1)
    assert np.abs(frame.rgb.astype(int) - recording.rgb[1]).mean() < 6.0


def test_jpeg_cut_in_half(recording: ReplicaRecording) -> None:
    path = _replace_by_jpeg(recording)[1]
    cut_in_half(path)
    source = open_source(recording.uri)
    with pytest.raises(SourceError) as caught:
        source.frame(1)
    assert str(caught.value) == (
        f"{path}: expected a whole JPEG file, found it cut after {path.stat().st_size} bytes (no end mark)"
    )


def test_jpeg_of_noise_between_its_marks(recording: ReplicaRecording) -> None:
    path = _replace_by_jpeg(recording)[1]
    path.write_bytes(b"\xff\xd8\xff\xe0" + bytes(200) + b"\xff\xd9")
    source = open_source(recording.uri)
    with pytest.raises(SourceError, match=r"frame000001\.jpg: expected a decodable image, found damaged data"):
        source.frame(1)


def test_results_folder_missing(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"expected a folder 'results' with frame000000\.jpg, \.\.\., found none"):
        open_source(f"replica:{tmp_path}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": None}, "camera.fx: expected a positive number, found None"),
        ({"fy": "600"}, "camera.fy: expected a positive number, found '600'"),
        ({"cx": True}, "camera.cx: expected a positive number, found True"),
        ({"scale": 0}, "camera.scale: expected a positive number, found 0"),
        ({"h": float("inf")}, "camera.h: expected a positive number, found inf"),
        ({"w": 48.5}, "camera.w: expected a whole number, found 48.5"),
    ],
)
def test_camera_parameters(recording: ReplicaRecording, change: dict[str, object], message: str) -> None:
    path = write_params(recording, {"camera": {**CAMERA, **change}})
    with pytest.raises(SourceError) as caught:
        open_source(recording.uri)
    assert str(caught.value) == f"{path}: {message}"


@pytest.mark.parametrize("content", [[], {}, {"camera": 3}])
def test_camera_parameters_without_camera(recording: ReplicaRecording, content: object) -> None:
    write_params(recording, content)
    with pytest.raises(SourceError, match=r"cam_params\.json: expected an object 'camera' with w, h, fx"):
        open_source(recording.uri)


def test_camera_parameters_that_are_no_json(recording: ReplicaRecording) -> None:
    (recording.folder / "cam_params.json").write_text('{"camera":\n {"w": 4')
    with pytest.raises(SourceError, match=r"cam_params\.json:2: expected JSON, found "):
        open_source(recording.uri)


def test_redkitchen() -> None:
    source = open_source(f"replica:{shared_data('redkitchen')}", size=(320, 240), frames=(70, 190))
    poses = source.ground_truth()
    assert poses is not None
    assert (len(source), poses.shape, source.family) == (120, (120, 4, 4), "tum")
    assert all(se3.is_rigid(T, tolerance=1e-12) for T in poses)
    assert source.camera.as_dict() == {
        "width": 320, "height": 240, "fx": 292.5, "fy": 292.5, "cx": 160.25, "cy": 120.25
    }  # fmt: skip
    depth_m = source.frame(119).depth_m()
    assert 0.4 < depth_m[depth_m > 0].min() < depth_m.max() < 6.0


def _replace_by_jpeg(recording: ReplicaRecording) -> list[Path]:
    paths = []
    for index in range(3):
        recording.color_path(index).unlink()
        paths.append(recording.color_path(index).with_suffix(".jpg"))
        assert cv2.imwrite(str(paths[-1]), recording.rgb[index][..., ::-1])
    return paths

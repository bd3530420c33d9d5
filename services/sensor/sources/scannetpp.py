"""``scannetpp:DIR``: DSLR images of a ScanNet++ scene; format-tested on files written by the tests.

Below ``DIR/dslr`` (or DIR itself): ``nerfstudio/transforms_undistorted.json`` (intrinsics ``fl_x fl_y cx cy w h``, and
poses of the images in ``frames`` and ``test_frames``), ``train_test_lists.json`` (the order of the images, and which
are held out), ``undistorted_images/*.JPG`` and ``undistorted_depths/*.png`` (16 bit, mm; rendered from the scene's mesh
by the data set's toolbox). The images are stills without times: 30 frames a second are assumed. Pixel
centres are at half-integers.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources import recording_files as files
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.image_files import FilePairSource, FramePaths

_UNITS_PER_M = 1000.0
_OPTIONS = ("depth_scale", "split")
_SPLITS = ("train", "test")
_FRAME_KEYS = {"train": "frames", "test": "test_frames"}
# OpenGL's camera axes (x right, y up, z backward) to ours, and the world turned likewise, as the paper's authors do it.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def open_scannetpp(uri: SourceUri) -> FilePairSource:
    """Open a scene; options ``split=train|test`` (default train) and ``depth_scale`` (units per m).

    The held-out split begins with the first training image, which defines the world frame of both.

    Raises:
        SourceError: Something is missing, damaged or inconsistent; image contents are checked when read.
    """
    files.check_options(uri, _OPTIONS)
    split = uri.options.get("split", "train")
    if split not in _SPLITS:
        raise SourceError(f"scannetpp: option split: expected one of {', '.join(_SPLITS)}; found {split!r}")
    folder = files.folder_of(uri)
    scene = folder / "dslr" if (folder / "dslr").is_dir() else folder
    transforms_path = scene / "nerfstudio" / "transforms_undistorted.json"
    transforms = _read_object(transforms_path)
    wanted = _wanted(scene / "train_test_lists.json", split)
    poses = {each: _poses(transforms_path, transforms, _FRAME_KEYS[each]) for each, _ in wanted}
    return FilePairSource(
        uri=str(replace(uri, path=str(folder))),
        family="scannetpp",
        camera=_camera(transforms_path, transforms),
        depth_scale_m=1.0 / files.positive_option(uri, "depth_scale", _UNITS_PER_M),
        files=[_paths(scene, name) for _, name in wanted],
        poses=np.stack([_pose_of(transforms_path, poses[each], _FRAME_KEYS[each], name) for each, name in wanted]),
    )


def _read_object(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise SourceError(f"{path}: expected a JSON file of a DSLR recording, found no such file")
    try:
        content = json.loads("\n".join(files.read_lines(path)))
    except json.JSONDecodeError as error:
        raise SourceError(f"{path}:{error.lineno}: expected JSON, found {error.msg}") from error
    if not isinstance(content, dict):
        raise SourceError(f"{path}: expected a JSON object, found {type(content).__name__}")
    return content


def _wanted(path: Path, split: str) -> list[tuple[str, str]]:
    """The split and name of each image, in order."""
    lists = _read_object(path)
    train = [("train", name) for name in _names(path, lists, "train")]
    return train if split == "train" else [train[0], *(("test", name) for name in _names(path, lists, "test"))]


def _names(path: Path, lists: dict[str, Any], split: str) -> list[str]:
    names = lists.get(split)
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise SourceError(f"{path}: {split}: expected a list of image names, found {_short(names)}")
    for name in names:
        if Path(name).name != name:
            raise SourceError(f"{path}: {split}: expected names without folders, found {name!r}")
    return names


def _camera(path: Path, transforms: dict[str, Any]) -> Camera:
    values = {key: transforms.get(key) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    for key, value in values.items():
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 < value < float("inf"):
            raise SourceError(f"{path}: {key}: expected a positive number, found {_short(value)}")
        if key in ("w", "h") and value != int(value):
            raise SourceError(f"{path}: {key}: expected a whole number, found {value!r}")
    width, height, fx, fy, cx, cy = (float(value) for value in values.values() if value is not None)
    return Camera(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)


def _poses(path: Path, transforms: dict[str, Any], key: str) -> dict[str, object]:
    frames = transforms.get(key)
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise SourceError(f"{path}: {key}: expected a list of frames, found {_short(frames)}")
    return {str(frame.get("file_path")): frame.get("transform_matrix") for frame in frames}


def _pose_of(path: Path, poses: dict[str, object], key: str, name: str) -> npt.NDArray[np.float64]:
    where = f"{path}: {key}: {name}"
    if name not in poses:
        raise SourceError(f"{where}: expected a frame with this file_path, found none")
    try:
        values = np.array(poses[name], np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (4, 4):
        raise SourceError(f"{where}: expected a transform_matrix of 4 rows of 4 numbers, found {_short(poses[name])}")
    return _FLIP @ files.checked_pose(values.ravel().tolist(), where=where) @ _FLIP


def _paths(scene: Path, name: str) -> FramePaths:
    color = scene / "undistorted_images" / name
    depth = (scene / "undistorted_depths" / name).with_suffix(".png")
    for path, kind in ((color, "colour image"), (depth, "depth image")):
        if not path.is_file():
            raise SourceError(f"{path}: expected a {kind}, found no such file")
    return FramePaths(color=color, depth=depth)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."

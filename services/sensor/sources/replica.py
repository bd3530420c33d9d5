"""``replica:DIR``: recordings in the layout of the Replica sequences rendered for NICE-SLAM.

``DIR/results/frame%06d.jpg`` (or .png), ``DIR/results/depth%06d.png`` (16 bit), ``DIR/traj.txt`` (a row-major
``T_world_camera`` of 16 numbers per line; optional) and ``cam_params.json`` in DIR or beside it; without that file,
the intrinsics of the Replica sequences.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources import recording_files as files
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.image_files import FilePairSource

_REPLICA = {"w": 1200.0, "h": 680.0, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}


def open_replica(uri: SourceUri) -> FilePairSource:
    """Open a recording; options ``fx fy cx cy`` (pixel centres at whole numbers) and ``depth_scale`` (units per m).

    Its family is ``replica`` at Replica's own image size; recordings of another camera in this layout are taken to be
    hand-held sensor data, family ``tum``.

    Raises:
        SourceError: Something is missing, damaged or inconsistent; image contents are checked when read.
    """
    files.check_options(uri, (*files.INTRINSICS_OPTIONS, "depth_scale"))
    folder = files.folder_of(uri)
    results = folder / "results"
    if not results.is_dir():
        raise SourceError(f"{folder}: expected a folder 'results' with frame000000.jpg, ..., found none")
    pairs = files.numbered_pairs(results, color="frame*.*", depth="depth*.png")
    params = _camera_params(folder)
    width, height = int(params["w"]), int(params["h"])
    return FilePairSource(
        uri=str(replace(uri, path=str(folder))),
        family="replica" if (width, height) == (_REPLICA["w"], _REPLICA["h"]) else "tum",
        camera=files.integer_centred_camera(uri, width=width, height=height, intrinsics=params),
        depth_scale_m=1.0 / files.positive_option(uri, "depth_scale", params["scale"]),
        files=pairs,
        poses=_trajectory(folder / "traj.txt", len(pairs)),
    )


def _camera_params(folder: Path) -> dict[str, float]:
    for path in (folder / "cam_params.json", folder.parent / "cam_params.json"):
        if path.is_file():
            return _read_camera_params(path)
    return dict(_REPLICA)


def _read_camera_params(path: Path) -> dict[str, float]:
    try:
        content = json.loads("\n".join(files.read_lines(path)))
    except json.JSONDecodeError as error:
        raise SourceError(f"{path}:{error.lineno}: expected JSON, found {error.msg}") from error
    camera = content.get("camera") if isinstance(content, dict) else None
    if not isinstance(camera, dict):
        raise SourceError(f"{path}: expected an object 'camera' with {', '.join(_REPLICA)}, found none")
    params = {key: _positive(camera.get(key), f"{path}: camera.{key}") for key in _REPLICA}
    for key in ("w", "h"):
        if not params[key].is_integer():
            raise SourceError(f"{path}: camera.{key}: expected a whole number, found {params[key]!r}")
    return params


def _positive(value: object, where: str) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 < value < float("inf"):
        raise SourceError(f"{where}: expected a positive number, found {value!r}")
    return float(value)


def _trajectory(path: Path, num_frames: int) -> npt.NDArray[np.float64] | None:
    if not path.exists():
        return None
    lines = files.read_lines(path)
    if len(lines) != num_frames:
        raise SourceError(f"{path}: expected {num_frames} poses, one for each frame, found {len(lines)}")
    poses = np.empty((num_frames, 4, 4))
    for row, line in enumerate(lines):
        where = f"{path}:{row + 1}"
        poses[row] = files.checked_pose(files.parse_numbers(line, 16, where=where), where=where)
    return poses

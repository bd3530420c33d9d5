"""``tum:DIR``: sequences of the TUM RGB-D benchmark; format-tested on files written by the tests.

``DIR/rgb.txt`` and ``DIR/depth.txt`` list ``timestamp file`` (s; 8-bit colour, 16-bit depth of 5000 units per metre,
0 meaning none), ``DIR/groundtruth.txt`` (optional) lists ``timestamp tx ty tz qx qy qz qw``, ``T_world_camera``. Colour
and depth were not taken at once: each colour image takes the depth and the true pose nearest in time. Images are used
as they are, without undistortion.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.trajectory_io import TrajectoryError, parse_time_ns, read_trajectory
from vtslam.services.sensor.sources import recording_files as files
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.image_files import FilePairSource, FramePaths

_WIDTH, _HEIGHT = 640, 480
_UNITS_PER_M = 5000.0
_MAX_DT_S = 0.08
_MAX_FPS = 32.0

# With pixel centres at whole numbers. The first three are those of the benchmark's cameras, by the sequence's name.
_CAMERAS: dict[str, Mapping[str, float]] = {
    "fr1": {"fx": 517.3, "fy": 516.5, "cx": 318.6, "cy": 255.3},
    "fr2": {"fx": 520.9, "fy": 521.0, "cx": 325.1, "cy": 249.7},
    "fr3": {"fx": 535.4, "fy": 539.2, "cx": 320.1, "cy": 247.6},
    "ros": {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5},
}
_OPTIONS = (*files.INTRINSICS_OPTIONS, "camera", "depth_scale", "max_dt", "max_fps")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Listing:
    """Files of one kind with their times, int64 [N] ns, strictly increasing."""

    path: Path
    times_ns: npt.NDArray[np.int64]
    files: list[Path]


def open_tum(uri: SourceUri) -> FilePairSource:
    """Open a sequence.

    Options: ``camera=fr1|fr2|fr3|ros`` or ``fx fy cx cy`` (without them, the camera that DIR's name tells, as in
    ``rgbd_dataset_freiburg1_desk``), ``depth_scale`` (units per m), ``max_dt`` (s; images and poses further apart do
    not belong together; 0.08) and ``max_fps`` (frames that come faster are left out; 32).

    Frames whose time no true pose is near have a truth of NaN.

    Raises:
        SourceError: Something is missing, damaged or inconsistent; image contents are checked when read.
    """
    files.check_options(uri, _OPTIONS)
    folder = files.folder_of(uri)
    intrinsics = _intrinsics(uri, folder)
    max_dt_ns = round(1e9 * files.positive_option(uri, "max_dt", _MAX_DT_S))
    color, depth = _read_listing(folder / "rgb.txt"), _read_listing(folder / "depth.txt")
    near = nearest(color.times_ns, depth.times_ns, max_dt_ns)
    paired = [row for row in range(len(color.files)) if near[row] >= 0]
    if not paired:
        raise SourceError(
            f"{depth.path}: expected depth images within {1e-9 * max_dt_ns:g} s of those of {color.path.name}, found "
            "none (option max_dt)"
        )
    kept = _spaced(paired, color.times_ns, files.positive_option(uri, "max_fps", _MAX_FPS))
    times_ns = color.times_ns[kept]
    return FilePairSource(
        uri=str(replace(uri, path=str(folder))),
        family="tum",
        camera=files.integer_centred_camera(uri, width=_WIDTH, height=_HEIGHT, intrinsics=intrinsics),
        depth_scale_m=1.0 / files.positive_option(uri, "depth_scale", _UNITS_PER_M),
        files=[FramePaths(color=color.files[row], depth=depth.files[near[row]]) for row in kept],
        poses=_truth(folder / "groundtruth.txt", times_ns, max_dt_ns),
        capture_times_ns=times_ns.tolist(),
    )


def nearest(times_ns: npt.NDArray[np.int64], others_ns: npt.NDArray[np.int64], max_dt_ns: int) -> npt.NDArray[np.intp]:
    """The index [N] of the nearest of ``others_ns`` [M] (sorted) for each of ``times_ns`` [N]; -1 if it is too far.

    Of two equally near ones it is the earlier.
    """
    if not len(others_ns):
        return np.full(len(times_ns), -1, np.intp)
    after = np.searchsorted(others_ns, times_ns).clip(0, len(others_ns) - 1)
    before = (after - 1).clip(0)
    earlier = np.abs(others_ns[before] - times_ns) <= np.abs(others_ns[after] - times_ns)
    best = np.where(earlier, before, after)
    return np.where(np.abs(others_ns[best] - times_ns) <= max_dt_ns, best, -1)


def _intrinsics(uri: SourceUri, folder: Path) -> Mapping[str, float]:
    name = uri.options.get("camera")
    if name is not None:
        if name not in _CAMERAS:
            raise SourceError(f"tum: option camera: expected one of {', '.join(_CAMERAS)}; found {name!r}")
        return _CAMERAS[name]
    match = re.search(r"freiburg([123])", folder.name)
    if match is not None:
        return _CAMERAS[f"fr{match.group(1)}"]
    if all(key in uri.options for key in files.INTRINSICS_OPTIONS):
        return _CAMERAS["ros"]  # replaced by the options
    raise SourceError(
        f"{folder}: expected a name with freiburg1, freiburg2 or freiburg3, or intrinsics by option: "
        f"camera={'|'.join(_CAMERAS)}, or all of fx, fy, cx, cy; found neither"
    )


def _read_listing(path: Path) -> _Listing:
    """Lines ``timestamp file``, blank lines and those that begin with ``#`` left out."""
    if not path.is_file():
        raise SourceError(f"{path}: expected a list of images with their times, found no such file")
    times_ns: list[int] = []
    images: list[Path] = []
    for number, line in enumerate(files.read_lines(path), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}:{number}"
        if len(words) != 2:
            raise SourceError(f"{where}: expected a time and a file name, found {len(words)} words")
        time_ns = _time_ns(words[0], where)
        if times_ns and time_ns <= times_ns[-1]:
            raise SourceError(f"{where}: expected a time after that of the line before, found {words[0]}")
        times_ns.append(time_ns)
        images.append(path.parent / words[1])
    if not images:
        raise SourceError(f"{path}: expected a list of images with their times, found none")
    return _Listing(path=path, times_ns=np.array(times_ns, np.int64), files=images)


def _time_ns(text: str, where: str) -> int:
    try:
        return parse_time_ns(text, where)
    except TrajectoryError as error:
        raise SourceError(str(error)) from error


def _spaced(rows: list[int], times_ns: npt.NDArray[np.int64], max_fps: float) -> list[int]:
    """Those of ``rows`` that come more than 1/max_fps after the last one taken."""
    kept = rows[:1]
    for row in rows[1:]:
        if times_ns[row] - times_ns[kept[-1]] > 1e9 / max_fps:
            kept.append(row)
    return kept


def _truth(path: Path, times_ns: npt.NDArray[np.int64], max_dt_ns: int) -> npt.NDArray[np.float64] | None:
    if not path.exists():
        return None
    try:
        trajectory = read_trajectory(path)
    except TrajectoryError as error:
        raise SourceError(str(error)) from error
    near = nearest(times_ns, trajectory.capture_times_ns, max_dt_ns)
    if (near < 0).all():
        raise SourceError(f"{path}: expected poses within {1e-9 * max_dt_ns:g} s of the images, found none")
    poses = np.full((len(times_ns), 4, 4), np.nan)
    poses[near >= 0] = trajectory.poses[near[near >= 0]]
    return poses

"""``scannet:DIR`` and ``scannet:FILE.sens``: ScanNet recordings; format-tested on files written by the tests.

A folder is as ScanNet's own exporter writes it: ``color/0.jpg``, ``depth/0.png`` (16 bit), ``pose/0.txt`` (4x4
``T_world_camera``, infinite where tracking was lost; optional), ``intrinsic/intrinsic_color.txt`` (4x4; without it,
the figures that the paper's authors use for all scenes). Numbers grow by a constant step. A ``.sens`` file is read
frame by frame. Colour is larger than depth: it is scaled to depth's size, and both share colour's intrinsics.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources import recording_files as files
from vtslam.services.sensor.sources import sens_file
from vtslam.services.sensor.sources.base import Source, SourceError, SourceUri
from vtslam.services.sensor.sources.image_files import (
    FilePairSource,
    FramePaths,
    assumed_time_ns,
    read_color,
    read_depth,
    scaled_color,
)

_FAMILY = "scannet"
_UNITS_PER_M = 1000.0
# For colour images of 1296x968, pixel centres at whole numbers.
_INTRINSICS = {"fx": 1169.621094, "fy": 1167.105103, "cx": 646.295044, "cy": 489.927032}
_OPTIONS = (*files.INTRINSICS_OPTIONS, "depth_scale")


def open_scannet(uri: SourceUri) -> Source:
    """Open an exported folder or a ``.sens`` file; options ``fx fy cx cy`` (colour) and ``depth_scale`` (units per m).

    Frames where tracking was lost have a truth of NaN.

    Raises:
        SourceError: Something is missing, damaged or inconsistent; image contents are checked when read.
    """
    files.check_options(uri, _OPTIONS)
    path = Path(os.path.abspath(os.path.expanduser(uri.path)))
    return _open_sens(uri, path) if uri.path and path.suffix == ".sens" else _open_folder(uri, files.folder_of(uri))


# --- exported folders ------------------------------------------------------------------------------------------------


def _open_folder(uri: SourceUri, folder: Path) -> FilePairSource:
    for name in ("color", "depth"):
        if not (folder / name).is_dir():
            raise SourceError(f"{folder / name}: expected a folder of numbered images, found none")
    color = files.numbered_files(folder / "color", r"(\d+)\.(?:jpg|png)")
    depth = files.numbered_files(folder / "depth", r"(\d+)\.png")
    numbers = _numbers(folder, color, depth)
    first = color[numbers[0]], depth[numbers[0]]
    color_size, depth_size = (_size(image) for image in (read_color(first[0]), read_depth(first[1])))
    intrinsics = _color_intrinsics(folder / "intrinsic" / "intrinsic_color.txt", color_size, uri)
    return FilePairSource(
        uri=str(replace(uri, path=str(folder))),
        family=_FAMILY,
        camera=_camera(uri, intrinsics, color_size, depth_size),
        depth_scale_m=1.0 / files.positive_option(uri, "depth_scale", _UNITS_PER_M),
        files=[FramePaths(color=color[number], depth=depth[number]) for number in numbers],
        poses=_poses(folder / "pose", numbers),
        capture_times_ns=[assumed_time_ns(number) for number in numbers],
        color_size=color_size,
    )


def _size(image: npt.NDArray[np.generic]) -> tuple[int, int]:
    return image.shape[1], image.shape[0]


def _numbers(folder: Path, color: Mapping[int, Path], depth: Mapping[int, Path]) -> list[int]:
    """The frames' numbers, which grow by a constant step; every colour image has depth and the other way round."""
    numbers = sorted(color.keys() | depth.keys())
    if not numbers:
        raise SourceError(f"{folder}: expected color/0.jpg, depth/0.png, ..., found none")
    for number in numbers:
        for kind, found, other in (("color", color, depth), ("depth", depth, color)):
            if number not in found:
                raise SourceError(
                    f"{folder / kind}: expected an image of frame {number} beside {other[number].name}, found none"
                )
    steps = np.diff(numbers)
    if len(steps) and (steps != steps[0]).any():
        place = int(np.flatnonzero(steps != steps[0])[0])
        raise SourceError(
            f"{folder / 'color'}: expected numbers {steps[0]} apart, found {numbers[place + 1]} after {numbers[place]}"
        )
    return numbers


def _color_intrinsics(path: Path, color_size: tuple[int, int], uri: SourceUri) -> Mapping[str, float]:
    if path.is_file():
        rows = files.read_lines(path)
        if len(rows) < 3:
            raise SourceError(f"{path}: expected 4 rows of 4 numbers, found {len(rows)} rows")
        values = [files.parse_numbers(row, 4, where=f"{path}:{line + 1}") for line, row in enumerate(rows[:3])]
        return _positive({"fx": values[0][0], "fy": values[1][1], "cx": values[0][2], "cy": values[1][2]}, str(path))
    if color_size != (1296, 968) and not all(key in uri.options for key in files.INTRINSICS_OPTIONS):
        raise SourceError(
            f"{path}: expected the intrinsics of colour images of {color_size[0]}x{color_size[1]}, found no such file "
            "(options fx, fy, cx, cy replace it)"
        )
    return _INTRINSICS


def _positive(intrinsics: Mapping[str, float], where: str) -> Mapping[str, float]:
    for key, value in intrinsics.items():
        if not 0.0 < value < float("inf"):
            raise SourceError(f"{where}: {key}: expected a positive number, found {value!r}")
    return intrinsics


def _camera(
    uri: SourceUri, intrinsics: Mapping[str, float], color_size: tuple[int, int], depth_size: tuple[int, int]
) -> Camera:
    """Colour's camera, scaled to the size of depth."""
    width, height = color_size
    return files.integer_centred_camera(uri, width=width, height=height, intrinsics=intrinsics).resized(*depth_size)


def _poses(folder: Path, numbers: Sequence[int]) -> npt.NDArray[np.float64] | None:
    paths = files.numbered_files(folder, r"(\d+)\.txt") if folder.is_dir() else {}
    if not paths:
        return None
    poses = np.full((len(numbers), 4, 4), np.nan)
    for row, number in enumerate(numbers):
        if number not in paths:
            raise SourceError(f"{folder / f'{number}.txt'}: expected the pose of frame {number}, found no such file")
        poses[row] = _pose(_read_matrix(paths[number]), str(paths[number]))
    return poses if np.isfinite(poses).any() else None


def _read_matrix(path: Path) -> list[float]:
    rows = files.read_lines(path)
    if len(rows) != 4:
        raise SourceError(f"{path}: expected 4 rows of 4 numbers, found {len(rows)} rows")
    return [value for line, row in enumerate(rows) for value in files.parse_numbers(row, 4, where=f"{path}:{line + 1}")]


def _pose(values: Sequence[float], where: str) -> npt.NDArray[np.float64]:
    """The rigid motion of 16 numbers; NaN where one is not finite."""
    return files.checked_pose(list(values), where=where) if np.isfinite(values).all() else np.full((4, 4), np.nan)


# --- .sens files -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _SensSource:
    """A ``.sens`` file (the `Source` protocol); only one frame of it is in memory."""

    uri: str
    path: Path
    header: sens_file.SensHeader
    index: sens_file.SensIndex
    camera: Camera
    depth_scale_m: float
    poses: npt.NDArray[np.float64] | None

    @property
    def family(self) -> str:
        return _FAMILY

    def __len__(self) -> int:
        return self.header.num_frames

    def frame(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.uri}: frame {index} of {len(self)}")
        rgb, depth = sens_file.read_images(self.path, self.header, self.index, index)
        return Frame(
            frame_id=index,
            capture_time_ns=assumed_time_ns(index),
            rgb=scaled_color(rgb, self.camera),
            depth=depth,
            depth_scale_m=self.depth_scale_m,
            camera=self.camera,
        )

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        return None if self.poses is None else self.poses.copy()


def _open_sens(uri: SourceUri, path: Path) -> _SensSource:
    try:
        with path.open("rb") as file:
            header = sens_file.read_header(path, file)
            index = sens_file.read_index(path, file, header)
    except OSError as error:
        raise SourceError(f"{path}: expected a readable .sens file, found {error.strerror}") from error
    intrinsics = _positive(dict(zip(files.INTRINSICS_OPTIONS, header.color_intrinsics, strict=True)), str(path))
    return _SensSource(
        uri=str(replace(uri, path=str(path))),
        path=path,
        header=header,
        index=index,
        camera=_camera(uri, intrinsics, header.color_size, header.depth_size),
        depth_scale_m=1.0 / files.positive_option(uri, "depth_scale", header.units_per_m),
        poses=_sens_poses(path, index.poses),
    )


def _sens_poses(path: Path, written: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | None:
    known = np.isfinite(written).all(axis=(1, 2))
    poses = np.full_like(written, np.nan)
    for number in np.flatnonzero(known):
        if not se3.is_rigid(written[number]):
            raise SourceError(f"{path}: frame {number}: expected a rigid motion T_world_camera, found another matrix")
        poses[number] = se3.orthonormalized(written[number])
    return poses if known.any() else None

"""``7scenes:DIR``: the layout of Microsoft's 7-Scenes; format-tested on files written by the tests.

``frame-%06d.color.png``, ``frame-%06d.depth.png`` (16 bit, mm; 0 and 65535 mean no depth) and ``frame-%06d.pose.txt``
(4x4 ``T_world_camera``; all frames have one, or none has) in DIR or in its sequence folders ``seq-01``, ``seq-02``.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources import recording_files as files
from vtslam.services.sensor.sources.base import SourceError, SourceUri
from vtslam.services.sensor.sources.image_files import FilePairSource

_WIDTH, _HEIGHT = 640, 480
_INTRINSICS = {"fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0}
_UNITS_PER_M = 1000.0
_NO_DEPTH = 65535


def open_seven_scenes(uri: SourceUri) -> FilePairSource:
    """Open a sequence; options ``seq`` (where DIR holds several), ``fx fy cx cy`` and ``depth_scale`` (units per m).

    Raises:
        SourceError: Something is missing, damaged or inconsistent; image contents are checked when read.
    """
    files.check_options(uri, (*files.INTRINSICS_OPTIONS, "depth_scale", "seq"))
    folder = files.folder_of(uri)
    sequence = _sequence_folder(folder, uri.options.get("seq"))
    pairs = files.numbered_pairs(sequence, color="frame-*.color.png", depth="frame-*.depth.png")
    return FilePairSource(
        uri=str(replace(uri, path=str(folder))),
        family="tum",
        camera=files.integer_centred_camera(uri, width=_WIDTH, height=_HEIGHT, intrinsics=_INTRINSICS),
        depth_scale_m=1.0 / files.positive_option(uri, "depth_scale", _UNITS_PER_M),
        files=pairs,
        poses=_poses(sequence, len(pairs)),
        no_depth=_NO_DEPTH,
    )


def _sequence_folder(folder: Path, wanted: str | None) -> Path:
    """DIR itself, its only sequence, or the one asked for: sequences of a scene are separate recordings."""
    sequences = {
        match.group(1): path
        for path in sorted(folder.iterdir())
        if path.is_dir() and (match := re.fullmatch(r"seq-(\d+)", path.name))
    }
    if wanted is not None:
        if wanted not in sequences:
            raise SourceError(f"{folder / f'seq-{wanted}'}: expected a sequence folder, found {_names(sequences)}")
        return sequences[wanted]
    if not sequences:
        return folder
    if len(sequences) > 1:
        raise SourceError(
            f"{folder}: expected one sequence, found {_names(sequences)}; choose with ?seq={min(sequences)}"
        )
    return next(iter(sequences.values()))


def _names(sequences: dict[str, Path]) -> str:
    return ", ".join(path.name for path in sequences.values()) or "none"


def _poses(folder: Path, num_frames: int) -> npt.NDArray[np.float64] | None:
    paths = files.numbered_files(folder, r"frame-(\d+)\.pose\.txt")
    if not paths:
        return None
    if sorted(paths) != list(range(num_frames)):
        missing = next((number for number in range(num_frames) if number not in paths), num_frames)
        raise SourceError(
            f"{folder}: expected {num_frames} poses, one for each frame, found {len(paths)} pose files "
            f"(first difference at frame {missing})"
        )
    return np.stack([_read_pose(paths[number]) for number in range(num_frames)])


def _read_pose(path: Path) -> npt.NDArray[np.float64]:
    lines = files.read_lines(path)
    if len(lines) != 4:
        raise SourceError(f"{path}: expected 4 rows of 4 numbers, found {len(lines)} rows")
    values = [
        value for row, line in enumerate(lines) for value in files.parse_numbers(line, 4, where=f"{path}:{row + 1}")
    ]
    return files.checked_pose(values, where=str(path))

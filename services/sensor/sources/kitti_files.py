"""Text files of KITTI odometry: poses, calibration, time stamps."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources import recording_files as files
from vtslam.services.sensor.sources.base import SourceError


def read_poses(path: Path) -> npt.NDArray[np.float64]:
    """Poses of a file of 3x4 rows, float64 [F,4,4].

    Raises:
        SourceError: The file is missing or empty, a line is not 12 numbers, or not a rigid motion.
    """
    lines = files.read_lines(path)
    if not lines:
        raise SourceError(f"{path}: expected a pose in each line, found an empty file")
    out = np.empty((len(lines), 4, 4))
    for row, line in enumerate(lines):
        where = f"{path}:{row + 1}"
        values = files.parse_numbers(line, 12, where=where)
        out[row] = files.checked_pose([*values, 0.0, 0.0, 0.0, 1.0], where=where)
    return out


def read_times_ns(path: Path, num_frames: int) -> npt.NDArray[np.int64]:
    """Capture times in whole nanoseconds, int64 [F], of a file with seconds in each line.

    Raises:
        SourceError: The file is missing, has another number of lines, or its times are not finite and rising.
    """
    lines = files.read_lines(path)
    if len(lines) != num_frames:
        raise SourceError(f"{path}: expected {num_frames} times, one for each frame, found {len(lines)}")
    times_s = np.array([files.parse_numbers(line, 1, where=f"{path}:{k + 1}")[0] for k, line in enumerate(lines)])
    if not np.isfinite(times_s).all() or times_s.min(initial=0.0) < 0.0 or times_s.max(initial=0.0) > 1e9:
        raise SourceError(f"{path}: expected seconds between 0 and 1e9, found others")
    out = np.rint(times_s * 1e9).astype(np.int64)
    back = np.flatnonzero(np.diff(out) <= 0)
    if back.size:
        raise SourceError(f"{path}:{back[0] + 2}: expected rising times, found {lines[back[0] + 1].strip()}")
    return out


def read_calibration(path: Path) -> dict[str, npt.NDArray[np.float64]]:
    """Matrices float64 [3,4] by name: ``P0`` to ``P3`` (projections) and ``Tr`` (velodyne to camera 0), those given.

    Raises:
        SourceError: The file is missing, or a line is not ``NAME: 12 numbers``.
    """
    out: dict[str, npt.NDArray[np.float64]] = {}
    for row, line in enumerate(files.read_lines(path)):
        where = f"{path}:{row + 1}"
        name, colon, rest = line.partition(":")
        if not colon:
            raise SourceError(f"{where}: expected NAME: and 12 numbers, found {line[:40]!r}")
        matrix = np.array(files.parse_numbers(rest, 12, where=where)).reshape(3, 4)
        if not np.isfinite(matrix).all():
            raise SourceError(f"{where}: expected finite numbers, found {rest.strip()}")
        out[name.strip()] = matrix
    return out

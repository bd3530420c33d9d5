"""Trajectories as text in the TUM format: ``timestamp tx ty tz qx qy qz qw``, one pose ``T_world_camera`` a line.

Time stamps are seconds with 9 decimals, made from integer nanoseconds without rounding. Numbers are the shortest text
that reads back to the same float64, so equal poses give equal bytes.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3

_NS_DIGITS = 9
_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


class TrajectoryError(ValueError):
    """A trajectory is not what it should be; the text names the file and line, what was expected and found."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Poses in order of time.

    Attributes:
        capture_times_ns: int64 [F], strictly increasing.
        poses: ``T_world_camera`` float64 [F,4,4].
    """

    capture_times_ns: npt.NDArray[np.int64]
    poses: npt.NDArray[np.float64]


def trajectory_text(capture_times_ns: Sequence[int], poses: npt.NDArray[np.float64]) -> str:
    """The text of a trajectory: times (integer ns, not negative, strictly increasing) and ``T_world_camera`` [F,4,4].

    Raises:
        TrajectoryError: Lengths differ, times do not increase, or a pose is not a rigid motion.
    """
    if poses.shape != (len(capture_times_ns), 4, 4):
        raise TrajectoryError(f"expected poses ({len(capture_times_ns)}, 4, 4), one for each time, found {poses.shape}")
    lines, before = [], -1
    for row, (time_ns, T) in enumerate(zip(capture_times_ns, poses, strict=True)):
        if time_ns <= before:
            raise TrajectoryError(f"pose {row}: expected a time after {before} ns, found {time_ns} ns")
        if not se3.is_rigid(T):
            raise TrajectoryError(f"pose {row}: expected a rigid motion T_world_camera, found {T.tolist()}")
        before = time_ns
        lines.append(_line(int(time_ns), T))
    return "".join(lines)


def write_trajectory(path: Path, capture_times_ns: Sequence[int], poses: npt.NDArray[np.float64]) -> None:
    """Replace ``path`` by a trajectory (see `trajectory_text`), as a whole and durably.

    Raises:
        TrajectoryError: As `trajectory_text`, before anything is written.
        OSError: The operating system refused; ``path`` is as it was.
    """
    content = trajectory_text(capture_times_ns, poses).encode("ascii")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory; blank lines and lines that begin with ``#`` are skipped, quaternions are normalised.

    Raises:
        TrajectoryError: The file is missing, or a line is not a pose after the one before.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise TrajectoryError(f"{path}: expected a readable trajectory, found {error.strerror}") from error
    times_ns: list[int] = []
    poses: list[npt.NDArray[np.float64]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}:{number}"
        if len(words) != len(_COLUMNS):
            raise TrajectoryError(f"{where}: expected {len(_COLUMNS)} columns {' '.join(_COLUMNS)}, found {len(words)}")
        time_ns = parse_time_ns(words[0], where)
        if times_ns and time_ns <= times_ns[-1]:
            raise TrajectoryError(f"{where}: expected a time after {_seconds(times_ns[-1])}, found {words[0]}")
        times_ns.append(time_ns)
        poses.append(_pose(words[1:], where))
    return Trajectory(
        capture_times_ns=np.array(times_ns, np.int64), poses=np.array(poses, np.float64).reshape(-1, 4, 4)
    )


def _line(time_ns: int, T: npt.NDArray[np.float64]) -> str:
    values = [*T[:3, 3], *se3.quaternion_xyzw(T)]
    # Adding 0 turns a negative zero into zero: equal poses, equal bytes.
    return " ".join([_seconds(time_ns), *(repr(float(value) + 0.0) for value in values)]) + "\n"


def _seconds(time_ns: int) -> str:
    return f"{time_ns // 10**_NS_DIGITS}.{time_ns % 10**_NS_DIGITS:0{_NS_DIGITS}d}"


def parse_time_ns(text: str, where: str) -> int:
    """Seconds as decimal text, in integer nanoseconds; raises TrajectoryError, whose text begins with ``where``."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise TrajectoryError(f"{where}: expected a time in seconds, found {text!r}") from None
    if not (seconds.is_finite() and 0 <= seconds < Decimal(2**63) / 10**_NS_DIGITS):
        raise TrajectoryError(f"{where}: expected a time in seconds, found {text!r}")
    return int(seconds.scaleb(_NS_DIGITS).to_integral_value())


def _pose(words: list[str], where: str) -> npt.NDArray[np.float64]:
    values = []
    for word in words:
        try:
            values.append(float(word))
        except ValueError:
            raise TrajectoryError(f"{where}: expected a number, found {word!r}") from None
    if not np.isfinite(values).all():
        raise TrajectoryError(f"{where}: expected finite numbers, found {' '.join(words)}")
    try:
        return se3.from_quaternion_xyzw(values[:3], values[3:])
    except ValueError as error:
        raise TrajectoryError(f"{where}: {error}") from error

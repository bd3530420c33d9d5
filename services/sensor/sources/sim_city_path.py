"""Where the car of ``sim:city`` drives: laps around a block, or a recorded trajectory laid on flat ground.

World axes are x right, y down, z forward as seen from the first camera of a recording; the ground is y = 0. A heading
is the angle in radians from z towards x.
"""

import zlib
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.kitti_files import read_poses

Points = npt.NDArray[np.float64]

CAMERA_HEIGHT_M = 1.65
CRUISE_M, TURNING_M = 0.85, 0.42  # metres between frames, as KITTI's car in town
MAX_FRAMES = 1_000_000

_STEP_M = 0.05  # of the numeric integration
_TURN_RADIUS_M, _EASE_M = 9.0, 6.0  # turns tighten and widen over so many metres
_CORNER_M = 0.5 * np.pi * _TURN_RADIUS_M + _EASE_M
MIN_LAP_M = 4.0 * (_CORNER_M + 10.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Path:
    """Places of the camera on the ground.

    Attributes:
        places_m: float64 [F,2], x and z.
        headings: float64 [F], radians, without jumps.
    """

    places_m: Points
    headings: npt.NDArray[np.float64]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.headings)

    def driven_m(self) -> npt.NDArray[np.float64]:
        """Length of the path up to each frame, float64 [F]."""
        steps = np.linalg.norm(np.diff(self.places_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def poses(self, seed: int) -> npt.NDArray[np.float64]:
        """``T_world_camera`` float64 [F,4,4] of a camera ``CAMERA_HEIGHT_M`` high on soft springs."""
        heave_m, pitch, roll = _springs(len(self), seed)
        out = np.zeros((len(self), 4, 4))
        (sh, sp, sr), (ch, cp, cr) = (f([self.headings, pitch, roll]) for f in (np.sin, np.cos))
        out[:, 0, :3] = np.stack([ch * cr + sh * sp * sr, sh * sp * cr - ch * sr, sh * cp], axis=1)
        out[:, 1, :3] = np.stack([cp * sr, cp * cr, -sp], axis=1)
        out[:, 2, :3] = np.stack([ch * sp * sr - sh * cr, sh * sr + ch * sp * cr, ch * cp], axis=1)
        out[:, 0, 3], out[:, 2, 3] = self.places_m.T
        out[:, 1, 3] = heave_m - CAMERA_HEIGHT_M
        out[:, 3, 3] = 1.0
        return out


def _springs(frames: int, seed: int) -> tuple[npt.NDArray[np.float64], ...]:
    """Heave (m, about 1 cm), pitch and roll (radians, about 0.2 degrees): smooth, other ones each lap."""
    rng = np.random.Generator(np.random.Philox(key=[seed, zlib.crc32(b"springs")]))
    index = np.arange(frames)[:, None]
    out = []
    for strength in (0.008, 0.0025, 0.003):
        periods, phases = rng.uniform(9.0, 60.0, 5), rng.uniform(0.0, 2.0 * np.pi, 5)
        waves = np.sin(2.0 * np.pi * index / periods + phases) * (periods / 40.0)
        out.append(strength * waves.sum(axis=1) / np.sqrt(5.0))
    return tuple(out)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Lap:
    """One lap in steps of ``_STEP_M``: places [K,2], headings [K] (rising by 2 pi), metres between frames there."""

    places_m: Points
    headings: npt.NDArray[np.float64]
    speed_m: npt.NDArray[np.float64]


def _lap(length_m: float) -> _Lap:
    side_m = 0.25 * length_m
    steps = round(side_m / _STEP_M)
    s = (np.arange(steps) + 0.5) * (side_m / steps)
    into_corner = s - 0.5 * (side_m - _CORNER_M)
    bend = np.clip(np.minimum(into_corner, _CORNER_M - into_corner) / _EASE_M, 0.0, 1.0)
    turned = np.cumsum(bend) - 0.5 * bend
    turned *= 0.5 * np.pi / bend.sum()
    headings = np.concatenate([turned + 0.5 * np.pi * k for k in range(4)])
    steps_m = (side_m / steps) * np.stack([np.sin(headings), np.cos(headings)], axis=1)
    places = np.cumsum(steps_m, axis=0) - steps_m
    return _Lap(places_m=places, headings=headings, speed_m=np.tile(CRUISE_M - (CRUISE_M - TURNING_M) * bend, 4))


def lap_path(*, lap_m: float, laps: int) -> Path:
    """``laps`` closed laps of ``lap_m`` metres around a square block, to the right, slower in the corners."""
    lap = _lap(lap_m)
    count, step_m = len(lap.headings), lap_m / len(lap.headings)
    # Frames are where the time since the start is a whole number.
    times = np.concatenate([[0.0], np.cumsum(np.tile(step_m / lap.speed_m, laps))])
    at = np.interp(np.arange(int(times[-1]) + 1), times, np.arange(len(times)))
    turn, within = np.divmod(at, count)
    base = np.floor(within).astype(np.intp)
    share = (within - base)[:, None]
    following = (base + 1) % count
    places = (1.0 - share) * lap.places_m[base] + share * lap.places_m[following]
    return Path(places_m=places, headings=lap.headings[base] + 2.0 * np.pi * turn)


def block_streets(*, lap_m: float, reach_m: float = 90.0) -> list[Points]:
    """Middle lines [K,2] of the streets around the block, and of those that go on beyond its corners."""
    lap = _lap(lap_m)
    ring = np.concatenate([lap.places_m[::20], lap.places_m[:1]])
    straight_m = 0.25 * lap_m - _CORNER_M
    out = [ring]
    for side in range(4):
        heading = 0.5 * np.pi * side
        way = np.array([np.sin(heading), np.cos(heading)])
        middle = lap.places_m[side * (len(lap.headings) // 4)]
        away = np.arange(0.5 * straight_m, 0.5 * straight_m + _CORNER_M + reach_m)[:, None]
        out += [middle + away * way, middle - away * way]
    return out


def recorded_path(path: FilePath) -> Path:
    """The trajectory of a KITTI pose file on flat ground: x, z and heading; height, pitch and roll are left out.

    Raises:
        SourceError: The file is missing or malformed, has less than two poses, or stands still all along.
    """
    poses = read_poses(path)
    if len(poses) < 2:
        raise SourceError(f"{path}: expected at least 2 poses, found {len(poses)}")
    headings = np.unwrap(np.arctan2(poses[:, 0, 2], poses[:, 2, 2]))
    out = Path(places_m=poses[:, [0, 2], 3].copy(), headings=headings)
    if out.driven_m()[-1] < 1.0:
        raise SourceError(f"{path}: expected a path of at least 1 m, found {out.driven_m()[-1]:.2f} m")
    return out

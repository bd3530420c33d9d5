"""The path of the hand-held camera through a simulated room: smooth, within limits, closed."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MEAN_STEP_M = 0.0175
MEAN_TURN_RAD = float(np.radians(1.45))
MAX_STEP_M = 0.029
MAX_TURN_RAD = float(np.radians(2.9))

_ROUND_FRAMES = 255  # one turn around the room, at 1.4 degrees a frame
_GLANCE_FRAMES = 190  # below this a full turn would be too fast: the camera looks to one side and back
_RADII_M = (1.15, 0.75)  # of the widest round
_PITCH_RAD = float(np.radians(13.0))  # downwards
_FIRST_AZIMUTH_RAD = float(np.radians(-62.0))

_TREMOR_PERIODS = (13.0, 9.0, 6.3)  # frames
_TREMOR_M = 0.0011
_TREMOR_RAD = float(np.radians(0.09))
# Left for the tremor below the limits: three waves on three axes in step, at their steepest.
_TREMOR_STEP_M = 0.0045
_TREMOR_TURN_RAD = float(np.radians(0.4))


def poses(frames: int, *, centre_m: tuple[float, float, float], seed: int) -> Array:
    """Poses ``T_world_camera`` [frames,4,4] of a closed path around ``centre_m`` (world z up).

    The step from the last frame to the first is like any other. Steps and turns have means near ``MEAN_STEP_M`` and
    ``MEAN_TURN_RAD`` and never pass ``MAX_STEP_M`` and ``MAX_TURN_RAD``. The camera stays within ``_RADII_M`` of the
    centre in the plane and looks across the room.
    """
    rng = np.random.Generator(np.random.Philox(key=[seed, 0x70617468]))
    azimuth = _FIRST_AZIMUTH_RAD + (float(rng.uniform(0.0, 2.0 * np.pi)) if seed else 0.0)
    phase = 2.0 * np.pi * np.arange(frames) / frames
    offset, angles = _glance(phase, azimuth) if frames < _GLANCE_FRAMES else _rounds(phase, azimuth)
    waves = _tremor(phase, rng)
    offset += _TREMOR_M * waves[:, :3]
    angles += _TREMOR_RAD * waves[:, 3:]
    out = np.zeros((frames, 4, 4))
    out[:, :3, :3] = _rotations(angles)
    out[:, :3, 3] = np.array(centre_m) + offset
    out[:, 3, 3] = 1.0
    return out


def _glance(phase: Array, azimuth: float) -> tuple[Array, Array]:
    """A short path: a small loop in place while looking to one side and back. Offsets [F,3] and angles [F,3]."""
    aside = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    loop = np.outer(-np.cos(phase), aside) + np.outer(0.55 * np.sin(phase), ahead)
    loop += np.outer(0.2 * np.sin(phase + 0.8), up)
    loop *= _scale(loop, MEAN_STEP_M, MAX_STEP_M - _TREMOR_STEP_M)
    swing = np.stack([np.cos(phase), 0.3 * np.sin(phase) + 0.08 * np.sin(2.0 * phase), 0.1 * np.sin(phase)], axis=1)
    swing *= _scale(swing, MEAN_TURN_RAD, MAX_TURN_RAD - _TREMOR_TURN_RAD)
    # The larger the loop, the nearer to the middle of the room its centre must lie.
    away = 0.8 * (1.0 - len(phase) / _GLANCE_FRAMES)
    loop += away * np.array([_RADII_M[0] * np.cos(azimuth), _RADII_M[1] * np.sin(azimuth), 0.0])
    return loop, swing + np.array([azimuth + np.pi, _PITCH_RAD, 0.0])


def _rounds(phase: Array, azimuth: float) -> tuple[Array, Array]:
    """A long path: rounds about the middle of the room, looking across it. Offsets [F,3] and angles [F,3]."""
    rounds = max(1, round(len(phase) / _ROUND_FRAMES))
    turn = azimuth + rounds * phase
    width = 1.0 - 0.1 * np.cos(phase) if rounds > 1 else np.ones(len(phase))
    loop = np.stack([_RADII_M[0] * width * np.cos(turn), _RADII_M[1] * width * np.sin(turn), np.zeros(len(phase))], 1)
    loop *= min(_scale(loop, MEAN_STEP_M, MAX_STEP_M - _TREMOR_STEP_M), 1.0 / float(width.max()))
    loop[:, 2] = 0.06 * np.sin(2.0 * turn + 1.0) + 0.04 * np.sin(phase)
    yaw = turn + np.pi + 0.11 * np.sin(2.0 * turn)
    pitch = _PITCH_RAD + 0.06 * np.sin(3.0 * turn) + 0.04 * np.sin(phase)
    return loop, np.stack([yaw, pitch, 0.03 * np.sin(turn + 2.0)], axis=1)


def _tremor(phase: Array, rng: np.random.Generator) -> Array:
    """Small fast waves [F,6], each axis and period with its own phase; whole periods, so that the path stays closed."""
    frames = len(phase)
    out = np.zeros((frames, 6))
    for period in _TREMOR_PERIODS:
        cycles = max(1, round(frames / period))
        out += np.sin(cycles * phase[:, None] + rng.uniform(0.0, 2.0 * np.pi, 6))
    return out * min(1.0, frames / _TREMOR_PERIODS[0])


def _scale(curve: Array, mean: float, limit: float) -> float:
    """The factor that gives the closed curve [F,3] the mean step wanted, or less if a step would pass the limit."""
    steps = np.linalg.norm(curve - np.roll(curve, 1, axis=0), axis=1)
    return float(min(mean / steps.mean(), limit / steps.max()))


def _rotations(angles: Array) -> Array:
    """World-from-camera rotations [F,3,3] of (yaw, pitch down, roll) [F,3] in radians."""
    (sy, sp, sr), (cy, cp, cr) = np.sin(angles).T, np.cos(angles).T
    zero = np.zeros_like(sy)
    ahead = np.stack([cy * cp, sy * cp, -sp], axis=1)
    level_right = np.stack([sy, -cy, zero], axis=1)
    level_down = np.cross(ahead, level_right)
    right = cr[:, None] * level_right + sr[:, None] * level_down
    return np.stack([right, np.cross(ahead, right), ahead], axis=2)

"""First guesses of poses that are off by a known amount, when a pose counts as found, and maps to find it in."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vtslam.common.config import ConfigError
from vtslam.common.geometry import se3
from vtslam.common.section import Section
from vtslam.services.engines import thread_count
from vtslam.services.run_plan import RunPlan
from vtslam.services.section_map import ReadsSections
from vtslam.services.sensor.sources.base import Source
from vtslam.services.system import System

ERRORS_M_DEG = ((0.01, 0.5), (0.02, 1.0), (0.05, 2.5), (0.10, 5.0))
_FOUND_M, _FOUND_DEG = 0.02, 1.0  # a recording's truth is itself good to a centimetre
_SEED = 7


class _NoArchive(ReadsSections):
    """The section under test is never sealed."""

    def write(self, section: Section) -> None:
        raise AssertionError("the section is still open")

    def read(self, section_id: int) -> Section:
        raise AssertionError("the section is still open")


def system_of_one_section(plan: RunPlan) -> System:
    """A system that keeps all of the plan's frames in one open section."""
    settings = replace(plan.settings, section=replace(plan.settings.section, length=len(plan.source) + 1))
    return System(settings, plan.engine, _NoArchive(), threads=thread_count(settings.splat))


def true_poses(source: Source, *, bench: str) -> npt.NDArray[np.float64]:
    """``T_world_camera`` float64 [F,4,4] of a recording.

    Raises:
        ConfigError: The recording has no true poses; the text names the ``bench``.
    """
    truth = source.ground_truth()
    if truth is None or not np.isfinite(truth).all():
        raise ConfigError(f"bench {bench}: {source.uri} has no true poses to start from")
    return truth


def error_name(error_m: float, error_deg: float) -> str:
    """The size of an error, for people."""
    return f"{error_m * 100:g} cm, {error_deg:g} deg"


def disturbed_poses(
    poses: npt.NDArray[np.float64], error_m: float, error_deg: float, trials: int
) -> Iterator[npt.NDArray[np.float64]]:
    """Poses in turn, each disturbed by a translation and a rotation of these lengths in random directions."""
    generator = np.random.Generator(np.random.Philox(key=_SEED))
    for trial in range(trials):
        directions = generator.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        twist = np.concatenate([error_m * directions[0], np.radians(error_deg) * directions[1]])
        yield poses[trial % len(poses)] @ se3.exp(twist)


def pose_error(T_found: npt.NDArray[np.float64], T_true: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    error = se3.log(se3.inverse(T_true) @ T_found)
    return float(np.linalg.norm(error[:3])), float(np.degrees(np.linalg.norm(error[3:])))


def is_found(T_found: npt.NDArray[np.float64], T_true: npt.NDArray[np.float64]) -> bool:
    """Whether a pose lies within 2 cm and 1 degree of the truth."""
    metres, degrees = pose_error(T_found, T_true)
    return metres <= _FOUND_M and degrees <= _FOUND_DEG

"""How far off a first guess may be: tracking from random errors of the pose, by both optimisers.

A section is mapped at the recording's true poses; frames that follow it are then tracked against it, from their true
pose disturbed. A pose is found again if it ends within 2 cm and 1 degree of the truth (a recording's truth is itself
good to a centimetre).
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vtslam.common.config import ConfigError
from vtslam.common.geometry import se3
from vtslam.common.section import Section
from vtslam.services.engines import thread_count
from vtslam.services.run_plan import RunPlan
from vtslam.services.section_map import ReadsSections, SectionMap
from vtslam.services.system import System
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.state import TrackerState

ERRORS_M_DEG = ((0.01, 0.5), (0.02, 1.0), (0.05, 2.5), (0.10, 5.0))
_FOUND_M, _FOUND_DEG = 0.02, 1.0
_TRACKED_FRAMES = 3
_SEED = 7


class _NoArchive(ReadsSections):
    """The section under test is never sealed."""

    def write(self, section: Section) -> None:
        raise AssertionError("the section is still open")

    def read(self, section_id: int) -> Section:
        raise AssertionError("the section is still open")


def bench_basin(plan: RunPlan, *, trials: int, on_step: Callable[[], None]) -> dict[str, object]:
    """Share of poses found again by size of the error, for Gauss-Newton and the paper's Adam on one map.

    Args:
        plan: All its frames but the last three are mapped, as one section.
        trials: Random errors per size, the same for both.
        on_step: Called after each error tried.

    Raises:
        ConfigError: The recording has no true poses, or fewer than six frames.
    """
    source, truth = plan.source, plan.source.ground_truth()
    if truth is None or not np.isfinite(truth).all():
        raise ConfigError(f"bench basin: {source.uri} has no true poses to start from")
    mapped = len(source) - _TRACKED_FRAMES
    if mapped < _TRACKED_FRAMES:
        raise ConfigError(f"bench basin: expected at least {2 * _TRACKED_FRAMES} frames, found {len(source)}")
    sections = _mapped(plan, truth, mapped)
    found: dict[str, object] = {}
    for name in ("gauss_newton", "adam"):
        tracker = Tracker(
            settings=replace(plan.settings.tracker, optimizer=name),
            engine=plan.engine,
            threads=thread_count(plan.settings.splat),
        )
        renders: list[int] = []
        shares = {}
        for error_m, error_deg in ERRORS_M_DEG:
            hits = 0
            for trial, T_guess in enumerate(_guesses(truth[mapped:], error_m, error_deg, trials)):
                index = mapped + trial % _TRACKED_FRAMES
                result = tracker.track(
                    source.frame(index), sections, TrackerState(), section_id=0, is_head=False, guess=T_guess
                )
                hits += _agrees(result.T_world_camera, truth[index])
                renders.append(result.quality.renders)
                on_step()
            shares[f"{error_m * 100:g} cm, {error_deg:g} deg"] = round(hits / trials, 3)
        found[name] = {"found": shares, "renders_per_frame": round(float(np.mean(renders)), 1)}
    return {"trials": trials, **found}


def _mapped(plan: RunPlan, truth: npt.NDArray[np.float64], count: int) -> SectionMap:
    """The first ``count`` frames as one open section, mapped at their true poses."""
    settings = replace(plan.settings, section=replace(plan.settings.section, length=count + 1))
    system = System(settings, plan.engine, _NoArchive(), threads=thread_count(settings.splat))
    for index in range(count):
        system.process(plan.source.frame(index), known_T_world_camera=truth[index])
    return system.map


def _guesses(
    poses: npt.NDArray[np.float64], error_m: float, error_deg: float, trials: int
) -> Iterator[npt.NDArray[np.float64]]:
    """Poses in turn, each disturbed by a translation and a rotation of these lengths in random directions."""
    generator = np.random.Generator(np.random.Philox(key=_SEED))
    for trial in range(trials):
        directions = generator.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        twist = np.concatenate([error_m * directions[0], np.radians(error_deg) * directions[1]])
        yield poses[trial % len(poses)] @ se3.exp(twist)


def _agrees(T_found: npt.NDArray[np.float64], T_true: npt.NDArray[np.float64]) -> bool:
    error = se3.log(se3.inverse(T_true) @ T_found)
    return bool(np.linalg.norm(error[:3]) <= _FOUND_M and np.degrees(np.linalg.norm(error[3:])) <= _FOUND_DEG)

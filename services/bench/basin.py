"""How far off a first guess may be: tracking from random errors of the pose, by both optimisers.

A section is mapped at the recording's true poses; frames that follow it are then tracked against it, from their true
pose disturbed. A pose is found again if it ends within 2 cm and 1 degree of the truth.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vtslam.common.config import ConfigError
from vtslam.services.bench.first_guesses import (
    ERRORS_M_DEG,
    disturbed_poses,
    error_name,
    is_found,
    system_of_one_section,
    true_poses,
)
from vtslam.services.engines import thread_count
from vtslam.services.run_plan import RunPlan
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.state import TrackerState

_TRACKED_FRAMES = 3


def bench_basin(plan: RunPlan, *, trials: int, on_step: Callable[[], None]) -> dict[str, object]:
    """Share of poses found again by size of the error, for Gauss-Newton and the paper's Adam on one map.

    Args:
        plan: All its frames but the last three are mapped, as one section.
        trials: Random errors per size, the same for both.
        on_step: Called after each error tried.

    Raises:
        ConfigError: The recording has no true poses, or fewer than six frames.
    """
    source, truth = plan.source, true_poses(plan.source, bench="basin")
    mapped = len(source) - _TRACKED_FRAMES
    if mapped < _TRACKED_FRAMES:
        raise ConfigError(f"bench basin: expected at least {2 * _TRACKED_FRAMES} frames, found {len(source)}")
    system = system_of_one_section(plan)
    for index in range(mapped):
        system.process(source.frame(index), known_T_world_camera=truth[index])
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
            for trial, T_guess in enumerate(disturbed_poses(truth[mapped:], error_m, error_deg, trials)):
                index = mapped + trial % _TRACKED_FRAMES
                result = tracker.track(
                    source.frame(index), system.map, TrackerState(), section_id=0, is_head=False, guess=T_guess
                )
                hits += is_found(result.T_world_camera, truth[index])
                renders.append(result.quality.renders)
                on_step()
            shares[error_name(error_m, error_deg)] = round(hits / trials, 3)
        found[name] = {"found": shares, "renders_per_frame": round(float(np.mean(renders)), 1)}
    return {"trials": trials, **found}

"""Ways to estimate one pose against a rendered map, compared on the same maps, frames and first guesses.

Frames are mapped one after another at the recording's true poses. Each of the second half, before it is mapped, is
found by every variant in the map of those before it: from the constant-velocity guess, and from its true pose disturbed
as in ``bench basin``.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from vtslam.common.config import ConfigError
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.section import Section
from vtslam.services.bench.comparison import median_ms
from vtslam.services.bench.first_guesses import (
    ERRORS_M_DEG,
    disturbed_poses,
    error_name,
    is_found,
    pose_error,
    system_of_one_section,
    true_poses,
)
from vtslam.services.bench.pose_variants.table import Variant, pose_variants
from vtslam.services.bench.pose_variants.task import PoseTask
from vtslam.services.engines import thread_count
from vtslam.services.run_plan import RunPlan
from vtslam.services.tracker.masks import mean_depth_m, near_and_valid
from vtslam.services.tracker.state import TrackerState

LEAST_FRAMES = 6
_MOTION_FRAMES = 2  # that a constant velocity is taken from

Poses = npt.NDArray[np.float64]


def bench_variants(
    plan: RunPlan, *, trials: int, only: Sequence[str] = (), on_step: Callable[[], None]
) -> dict[str, object]:
    """Errors, success, renders and time of every variant.

    Args:
        plan: Its first half is mapped first; each later frame is found, then mapped.
        trials: Random errors per size, spread over those frames, the same for all; 0 for none.
        only: Names of the variants to measure; all if empty.
        on_step: Called after each frame.

    Raises:
        ConfigError: The recording has no true poses, fewer than six frames, or there is no such variant.
    """
    source, truth = plan.source, true_poses(plan.source, bench="variants")
    if len(source) < LEAST_FRAMES:
        raise ConfigError(f"bench variants: expected at least {LEAST_FRAMES} frames, found {len(source)}")
    threads = thread_count(plan.settings.splat)
    tallies = [_Tally(v) for v in _chosen(pose_variants(plan.engine, plan.settings.tracker, threads=threads), only)]
    first, system = len(source) // 2, system_of_one_section(plan)
    guesses = _random_guesses(truth[first:], trials)
    for index in range(len(source)):
        frame, state = source.frame(index), system.state
        if index >= first:
            task = _task(frame, system.map.section(0), state, far_factor=plan.settings.tracker.far_factor)
            moving = TrackerState(committed_poses=tuple(truth[index - _MOTION_FRAMES : index]))
            for tally in tallies:
                tally.find(task, moving.constant_velocity_guess(), truth[index])
                tally.try_errors(task, guesses[index - first], truth[index])
        system.process(frame, known_T_world_camera=truth[index])
        on_step()
    return {
        "tracked": len(source) - first,
        "trials": trials,
        "gaussians": system.map.section(0).gaussians.count,
        **{tally.variant.name: tally.figures() for tally in tallies},
    }


def _chosen(variants: list[Variant], only: Sequence[str]) -> list[Variant]:
    names = [variant.name for variant in variants]
    if unknown := sorted(set(only) - set(names)):
        raise ConfigError(f"bench variants: expected --only of {','.join(names)}, found {','.join(unknown)}")
    return [variant for variant in variants if not only or variant.name in only]


def _random_guesses(poses: Poses, trials: int) -> list[list[tuple[str, Poses]]]:
    """For each pose the first guesses near it, with the size of their errors."""
    guesses: list[list[tuple[str, Poses]]] = [[] for _ in poses]
    for error_m, error_deg in ERRORS_M_DEG:
        for trial, T_guess in enumerate(disturbed_poses(poses, error_m, error_deg, trials)):
            guesses[trial % len(poses)].append((error_name(error_m, error_deg), T_guess))
    return guesses


def _task(frame: Frame, section: Section, state: TrackerState, *, far_factor: float) -> PoseTask:
    """What the tracker would look at: usable pixels, colours in the map's gauge."""
    depths = state.with_mean_depth(mean_depth_m(frame))
    usable = near_and_valid(frame, far_factor=far_factor, largest_mean_depths_m=depths)
    assert state.previous_frame is not None
    return PoseTask(
        frame=frame,
        rgb=state.exposure.removed(frame.rgb),
        mask=usable.astype(np.uint8),
        section=section,
        previous=state.previous_frame,
        T_section_previous=section.T_section_camera(state.committed_poses[-1]),
    )


@dataclass
class _Tally:
    """What one variant found so far."""

    variant: Variant
    errors_mm: list[float] = field(default_factory=list)
    errors_deg: list[float] = field(default_factory=list)
    hits: dict[str, list[bool]] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)
    renders: list[int] = field(default_factory=list)
    full_size_renders: list[float] = field(default_factory=list)

    def find(self, task: PoseTask, T_world_guess: Poses, T_world_true: Poses) -> None:
        """Find a frame from the tracker's own guess."""
        T_guess = se3.inverse(task.section.T_section_camera(T_world_guess))
        self.variant.prepare(task.section)
        start_s = time.perf_counter()
        found = self.variant.solver.solve(task, T_guess)
        self.seconds.append(time.perf_counter() - start_s)
        self.renders.append(found.renders)
        self.full_size_renders.append(found.full_size_renders)
        metres, degrees = pose_error(_world_pose(task, found.T_camera_section), T_world_true)
        self.errors_mm.append(1e3 * metres)
        self.errors_deg.append(degrees)

    def try_errors(self, task: PoseTask, guesses: list[tuple[str, Poses]], T_world_true: Poses) -> None:
        """Find a frame from guesses that are off by these sizes of error."""
        if not self.variant.uses_guess:
            return
        for size, T_world_guess in guesses:
            found = self.variant.solver.solve(task, se3.inverse(task.section.T_section_camera(T_world_guess)))
            hit = is_found(_world_pose(task, found.T_camera_section), T_world_true)
            self.hits.setdefault(size, []).append(hit)

    def figures(self) -> dict[str, object]:
        """The variant's row; errors, renders and time are those from the constant-velocity guess."""
        every = [hit for hits in self.hits.values() for hit in hits]
        return {
            "translation_median_mm": round(float(np.median(self.errors_mm)), 3),
            "translation_p95_mm": round(float(np.percentile(self.errors_mm, 95)), 3),
            "rotation_median_deg": round(float(np.median(self.errors_deg)), 4),
            "rotation_p95_deg": round(float(np.percentile(self.errors_deg, 95)), 4),
            "found_share": round(float(np.mean(every)), 3) if every else None,
            "found": {size: round(float(np.mean(hits)), 3) for size, hits in self.hits.items()},
            "renders": round(float(np.mean(self.renders)), 2),
            "full_size_renders": round(float(np.mean(self.full_size_renders)), 2),
            "ms_per_frame": median_ms(self.seconds),
            "arithmetic": "numpy" if self.variant.in_numpy else "product",
        }


def _world_pose(task: PoseTask, T_camera_section: Poses) -> Poses:
    return np.asarray(task.section.T_world_section @ se3.inverse(T_camera_section))

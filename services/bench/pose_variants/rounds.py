"""The loops that the experiments share: render, align, render again; and damped Gauss-Newton within one level."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.optim.alignment import LinearSystem, Observed, Reference, observed_frame, reference_view
from vtslam.common.settings import GaussNewtonSettings
from vtslam.common.splat.engine import Engine
from vtslam.services.bench.pose_variants.task import FoundPose, Matrix4, PoseTask
from vtslam.services.tracker.optimisers import is_small_step, pyramid_levels

_MIN_MEASUREMENTS = 30
_DAMPING = 1e-6  # of H's diagonal


class AlignsLevel(Protocol):
    """Moves the frame's camera on one pyramid level until it agrees with the rendered view."""

    def __call__(self, reference: Reference, observed: Observed, level: int, T: Matrix4) -> Matrix4:
        """A better ``T_observed_reference`` than ``T``, both float64 [4,4]."""
        ...


def render_and_align(
    task: PoseTask,
    T_guess: Matrix4,
    engine: Engine,
    settings: GaussNewtonSettings,
    aligner_of: Callable[[Matrix4], AlignsLevel],
) -> FoundPose:
    """The tracker's rounds with another alignment: the first coarse to fine, down to half size, the others full size.

    Args:
        task: The frame and the map.
        T_guess: ``T_camera_section`` float64 [4,4].
        engine: Renders the map.
        settings: Renders at most, levels, and when a step is small.
        aligner_of: The alignment to a view rendered from a pose ``T_camera_section``.
    """
    camera = task.frame.camera
    levels = pyramid_levels(settings.levels, camera)
    observed = observed_frame(task.rgb, task.masked_depth_m(), camera, levels)
    T, spent = T_guess, 0
    while spent < settings.renders:
        rendering = engine.render(task.section.splats, camera, T)
        spent += 1
        first = spent == 1 and settings.renders > 1
        coarsest, finest = (levels - 1, min(1, levels - 1)) if first else (0, 0)
        reference = reference_view(
            rendering,
            camera,
            T,
            surface=task.section.surface,
            levels=coarsest + 1,
            silhouette_threshold=settings.silhouette_threshold,
        )
        align_level, moved = aligner_of(T), np.eye(4)
        for level in range(coarsest, finest - 1, -1):
            moved = align_level(reference, observed, level, moved)
        T = se3.orthonormalized(moved @ T)
        if finest == 0 and is_small_step(se3.log(moved), settings):
            break
    return FoundPose(T_camera_section=T, renders=spent, full_size_renders=float(spent))


def solved_level(
    linearised: Callable[[Matrix4], LinearSystem],
    stepped: Callable[[Matrix4, npt.NDArray[np.float64]], Matrix4],
    T: Matrix4,
    settings: GaussNewtonSettings,
) -> Matrix4:
    """Damped Gauss-Newton as the tracker does it: a step that raises the mean cost is halved once, then ends it.

    Args:
        linearised: H, g and cost at a pose.
        stepped: A pose [4,4] moved by a step [6].
        T: Where to start.
        settings: Iterations, and when a step has converged.
    """
    system = linearised(T)
    for _ in range(settings.iterations):
        if system.measured < _MIN_MEASUREMENTS:
            break
        step = damped_step(system)
        trial = linearised(stepped(T, step))
        if not _is_better(trial, system):
            step = 0.5 * step
            trial = linearised(stepped(T, step))
            if not _is_better(trial, system):
                break
        T, system = stepped(T, step), trial
        if np.linalg.norm(step[:3]) < settings.converged_m and np.linalg.norm(step[3:]) < settings.converged_rad:
            break
    return T


def damped_step(system: LinearSystem) -> npt.NDArray[np.float64]:
    """The step [6] to the minimum of a quadratic cost."""
    damped = system.H + _DAMPING * np.diag(np.diag(system.H)) + 1e-9 * np.eye(6)
    return np.asarray(-np.linalg.solve(damped, system.g), np.float64)


def left_step(T: Matrix4, step: npt.NDArray[np.float64]) -> Matrix4:
    """A pose moved by a left twist."""
    return se3.exp(step) @ T


def _is_better(trial: LinearSystem, system: LinearSystem) -> bool:
    return trial.mean_cost <= system.mean_cost and trial.measured >= _MIN_MEASUREMENTS

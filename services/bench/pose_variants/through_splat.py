"""Gauss-Newton through the splat: every step is a rendering and the derivatives of what it shows.

The gradient is exact, from the engine's backward pass on the robust loss. The engines have no normal equations, so H is
made from the derivatives of the rendered images; where the search ends is decided by the gradient, H only says how fast
it gets there. Depth is the rendered one, as in Eq. 1, or the distance from the measured surface, as in the tracker.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.optim.alignment import (
    LinearSystem,
    Observed,
    ObservedLevel,
    Reference,
    linearised,
    observed_frame,
    reference_view,
)
from vtslam.common.settings import GaussNewtonSettings
from vtslam.common.splat.engine import Engine, FloatArray, Rendering, Splats
from vtslam.services.bench.pose_variants import robust
from vtslam.services.bench.pose_variants.gaussian_pyramid import GaussianPyramids, silhouette_threshold
from vtslam.services.bench.pose_variants.rounds import left_step, solved_level
from vtslam.services.bench.pose_variants.task import FoundPose, Matrix4, PoseTask
from vtslam.services.tracker.optimisers import pyramid_levels

_MAX_RELATIVE_DEPTH_STEP = 0.05  # steeper depth is an edge, not a surface: H leaves it out

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ThroughSplat:
    """Gauss-Newton through the splat (protocol ``SolvesPose``).

    Attributes:
        engine: Renders, and takes derivatives back to the pose.
        settings: Noise model.
        pyramids: Merged Gaussians for the coarse levels.
        levels: Pyramid levels at most.
        steps: Steps per level at most.
        to_surface: Compare depth with the measured surface instead of the rendered depth.
    """

    engine: Engine
    settings: GaussNewtonSettings
    pyramids: GaussianPyramids
    levels: int
    steps: int
    to_surface: bool = False

    def solve(self, task: PoseTask, T_guess: Matrix4) -> FoundPose:
        """See ``SolvesPose``."""
        levels = pyramid_levels(self.levels, task.frame.camera)
        observed = observed_frame(task.rgb, task.masked_depth_m(), task.frame.camera, levels)
        settings = replace(self.settings, iterations=self.steps)
        T, spent, full_size = T_guess, 0, 0.0
        for level in range(levels - 1, -1, -1):

            def rendered_system(T: Matrix4, level: int = level) -> LinearSystem:
                nonlocal spent, full_size
                spent, full_size = spent + 1, full_size + 4.0**-level
                splats = self.pyramids.splats(task.section, level)
                surface = task.section.surface if self.to_surface else None
                return splat_system(self.engine, splats, observed, T, level, settings, surface=surface)

            T = solved_level(rendered_system, left_step, T, settings)
        return FoundPose(T_camera_section=T, renders=spent, full_size_renders=full_size)


def splat_system(
    engine: Engine,
    splats: Splats,
    observed: Observed,
    T: Matrix4,
    level: int,
    settings: GaussNewtonSettings,
    *,
    surface: npt.NDArray[np.float32] | None = None,
) -> LinearSystem:
    """One rendering and its derivatives: H, g and cost of a left twist on ``T_camera_section``.

    Args:
        engine: Renders ``splats``.
        splats: The map, in the section's coordinates.
        observed: The frame.
        T: ``T_camera_section`` float64 [4,4].
        level: Pyramid level of the frame to compare with.
        settings: Noise model and weights.
        surface: float32 [M,6], the map's measured points and normals, to take depth from; None for the rendered depth.
    """
    target = observed.levels[level]
    rendering = engine.render(splats, target.camera, T)
    view = _View.of(rendering, silhouette_threshold(settings, level))
    own = settings if surface is None else replace(settings, depth_weight=0.0)
    used, color, depth = _residuals(view, target, level, own)
    d_rgb, d_depth, d_alpha = _loss_derivatives(view, color, depth)
    gradients = engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth, d_alpha=d_alpha)
    H, g, cost = _information(view, target.camera, used, color, depth), gradients.pose, color.cost + depth.cost
    measured = int(used.sum() * 4.0**level)
    if surface is not None:
        planes = _plane_system(rendering, observed, T, level, settings, surface)
        H, g, cost = H + planes.H, g + planes.g, cost + planes.mean_cost * planes.measured
        measured += planes.measured
    return LinearSystem(H=H, g=g, mean_cost=cost / max(measured, 1), measured=measured)


def _plane_system(
    rendering: Rendering,
    observed: Observed,
    T: Matrix4,
    level: int,
    settings: GaussNewtonSettings,
    surface: npt.NDArray[np.float32],
) -> LinearSystem:
    """The tracker's point-to-plane term at a rendered pose."""
    view = reference_view(
        rendering,
        observed.levels[level].camera,
        T,
        surface=surface,
        levels=1,
        silhouette_threshold=silhouette_threshold(settings, level),
    )
    reference = Reference(levels=view.levels * (level + 1), points=view.points)  # only the last one is looked at
    points = np.ascontiguousarray(view.points[:: 4**level])
    without_color = replace(settings, color_weight=0.0)
    return linearised(reference, points, observed, level, np.eye(4), without_color, None, 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _View:
    """A rendering divided by its silhouette, where that is high enough."""

    rgb: Array
    depth_m: Array
    inverse_alpha: Array

    @classmethod
    def of(cls, rendering: Rendering, threshold: float) -> "_View":
        alpha = rendering.alpha.astype(np.float64)
        inverse = np.where(alpha > threshold, 1.0 / np.maximum(alpha, 1e-3), 0.0)
        return cls(
            rgb=rendering.rgb.astype(np.float64) * inverse[..., None],
            depth_m=rendering.depth_m.astype(np.float64) * inverse,
            inverse_alpha=inverse,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Residuals:
    """Residuals [H,W,C] with their robust weights, and their cost in squared sigmas."""

    values: Array
    weights: Array
    cost: float


def _residuals(
    view: _View, target: ObservedLevel, level: int, settings: GaussNewtonSettings
) -> tuple[npt.NDArray[np.bool_], _Residuals, _Residuals]:
    """Pixels used [H,W], colour and depth; where depths are too far apart something is in between: left out of both."""
    s, share = settings, 4.0**level
    observed_m = target.packed[..., 9].astype(np.float64)
    sigma_m = robust.depth_sigmas_m(observed_m, s)
    offset = view.depth_m - observed_m
    used = (view.inverse_alpha > 0) & (observed_m > 0)
    used &= np.abs(offset) <= s.depth_gate_sigmas * 3.0**level * sigma_m
    difference = view.rgb - target.packed[..., :3]

    def robust_part(values: Array, sigma: Array, weight: float) -> _Residuals:
        sigmas, scale = values / sigma, np.where(used, weight * share, 0.0)[..., None]
        return _Residuals(
            values=values,
            weights=scale * robust.huber_weights(sigmas) / sigma**2,
            cost=float((scale * robust.huber_costs(sigmas)).sum()),
        )

    color = robust_part(difference, np.full_like(difference, s.color_sigma), s.color_weight)
    return used, color, robust_part(offset[..., None], sigma_m[..., None], s.depth_weight)


def _loss_derivatives(view: _View, color: _Residuals, depth: _Residuals) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The loss by colour, depth and alpha as they were rendered, not yet divided by alpha."""
    d_rgb = color.weights * color.values * view.inverse_alpha[..., None]
    d_depth = (depth.weights * depth.values)[..., 0] * view.inverse_alpha
    d_alpha = -((d_rgb * view.rgb).sum(-1) + d_depth * view.depth_m)
    return d_rgb.astype(np.float32), d_depth.astype(np.float32), d_alpha.astype(np.float32)


def _information(
    view: _View, camera: Camera, used: npt.NDArray[np.bool_], color: _Residuals, depth: _Residuals
) -> Array:
    """H [6,6] from the derivatives of the rendered images; pixels without neighbours are stood in for by the others."""
    covered = cv2.erode((view.depth_m > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    images = np.concatenate([view.rgb, view.depth_m[..., None]], axis=2)
    du, dv = robust.image_derivatives(images)
    smooth = np.maximum(np.abs(du[..., 3]), np.abs(dv[..., 3])) < _MAX_RELATIVE_DEPTH_STEP * view.depth_m
    rows = np.nonzero(used & covered & smooth)
    points = (camera.pixel_rays().astype(np.float64) * view.depth_m[..., None])[rows]
    weights = np.concatenate([color.weights, depth.weights], axis=2)[rows]
    H: Array = np.zeros((6, 6))
    for channel in range(4):
        by_point = -robust.image_gradients_by_point(du[rows][:, channel], dv[rows][:, channel], points, camera)
        if channel == 3:  # a pixel's depth grows as its point moves away, beside what the image's shift brings there
            by_point[:, 2] += 1.0
        J = robust.twist_rows(points, by_point)
        H += (J * weights[:, channel, None]).T @ J
    return H * (float(used.sum()) / max(len(rows[0]), 1))

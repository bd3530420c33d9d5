"""Distribution-to-distribution alignment (generalised ICP) in place of point-to-plane, beside the tracker's colours.

Both sides of a pair carry the covariance of the depths around their pixel: how the surface spreads there, and the
sensor's noise along the ray. A pair's distance is weighed by the sum of both.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.optim.alignment import LinearSystem, Observed, Reference, linearised
from vtslam.common.section import Section
from vtslam.common.settings import GaussNewtonSettings
from vtslam.common.splat.engine import Engine
from vtslam.services.bench.pose_variants import robust
from vtslam.services.bench.pose_variants.rounds import AlignsLevel, left_step, render_and_align, solved_level
from vtslam.services.bench.pose_variants.task import FoundPose, Matrix4, PoseTask

_WINDOW_PX = range(-4, 5, 2)  # 9x9 pixels, as the normals' plane fits, every other one
_MIN_NEIGHBOURS = 8
_MAX_RELATIVE_DEPTH_STEP = 0.05  # neighbours further apart than this share no surface
_VISIBLE_TOLERANCE = 0.03  # relative; a point this near to the rendered depth is what the view shows
_STRIDE_PX = 2  # of the map's points
_NEAREST_M = 0.01

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Distributions:
    """Points [K,3] (m) with covariances [K,3,3] (m^2), float64."""

    means_m: Array
    covariances_m2: Array

    def moved(self, T: Matrix4) -> "Distributions":
        """Both in another frame."""
        R = T[:3, :3]
        return Distributions(means_m=robust.moved(T, self.means_m), covariances_m2=R @ self.covariances_m2 @ R.T)

    def kept(self, which: npt.NDArray[np.bool_] | slice) -> "Distributions":
        """Some of them."""
        return Distributions(means_m=self.means_m[which], covariances_m2=self.covariances_m2[which])


class GeneralisedIcp:
    """The tracker's rounds with GICP for depth (protocol ``SolvesPose``)."""

    def __init__(self, engine: Engine, settings: GaussNewtonSettings, *, threads: int) -> None:
        self._engine, self._settings, self._threads = engine, settings, threads
        self._map: tuple[Section, Distributions] | None = None

    def solve(self, task: PoseTask, T_guess: Matrix4) -> FoundPose:
        """See ``SolvesPose``."""
        camera = task.frame.camera
        measured = depth_distributions(task.masked_depth_m(), camera, self._settings)
        surface = self.surface(task.section)

        def aligner(T_camera_section: Matrix4) -> AlignsLevel:
            in_view = surface.moved(T_camera_section)

            def align_level(reference: Reference, observed: Observed, level: int, T: Matrix4) -> Matrix4:
                finest = reference.levels[0]
                shown = in_view.kept(shown_by_view(in_view.means_m, finest.depth_m, finest.camera))
                pairs = shown.kept(slice(None, None, 4**level))

                def both(T: Matrix4) -> LinearSystem:
                    color = self._colors(reference, observed, level, T)
                    depth = gicp_system(pairs, measured, camera, T, level, self._settings)
                    total = color.measured + depth.measured
                    cost = color.mean_cost * color.measured + depth.mean_cost * depth.measured
                    return LinearSystem(
                        H=color.H + depth.H, g=color.g + depth.g, mean_cost=cost / max(total, 1), measured=total
                    )

                return solved_level(both, left_step, T, self._settings)

            return align_level

        return render_and_align(task, T_guess, self._engine, self._settings, aligner)

    def _colors(self, reference: Reference, observed: Observed, level: int, T: Matrix4) -> LinearSystem:
        without_depth = replace(self._settings, depth_weight=0.0)
        return linearised(reference, reference.points[:0], observed, level, T, without_depth, None, self._threads)

    def surface(self, section: Section) -> Distributions:
        """What the section's views with depth measured, in its coordinates; computed once per section."""
        if self._map is None or self._map[0] is not section:
            self._map = section, measured_distributions(section, self._settings)
        return self._map[1]


def measured_distributions(section: Section, settings: GaussNewtonSettings) -> Distributions:
    """Points of every other row and column of the views that keep their depth, in the section's coordinates."""
    parts = []
    for frame in section.frames:
        if frame.view_depth is None:
            continue
        depth_m = frame.view_depth.astype(np.float32) * np.float32(section.depth_scale_m)
        grid = depth_distributions(depth_m, section.camera, settings)
        part = (slice(None, None, _STRIDE_PX), slice(None, None, _STRIDE_PX))
        points, covariances = grid.means_m[part].reshape(-1, 3), grid.covariances_m2[part].reshape(-1, 3, 3)
        known = points[:, 2] > 0
        view = Distributions(means_m=points[known], covariances_m2=covariances[known])
        parts.append(view.moved(frame.T_section_frame))
    return Distributions(
        means_m=np.concatenate([p.means_m for p in parts]),
        covariances_m2=np.concatenate([p.covariances_m2 for p in parts]),
    )


def depth_distributions(
    depth_m: npt.NDArray[np.float32], camera: Camera, settings: GaussNewtonSettings
) -> Distributions:
    """Points [H,W,3] and covariances [H,W,3,3] of a depth image [H,W] (m), camera frame.

    A covariance is that of the points in 9x9 pixels on the same surface, and the sensor's noise along the ray. Points
    are zero where depth is missing or has too few neighbours.
    """
    points = camera.back_projected(depth_m).astype(np.float64)
    reach = max(_WINDOW_PX)
    padded = np.pad(points, ((reach, reach), (reach, reach), (0, 0)))
    height, width = depth_m.shape
    count, total, outer = np.zeros((height, width)), np.zeros((height, width, 3)), np.zeros((height, width, 3, 3))
    for dv in _WINDOW_PX:
        for du in _WINDOW_PX:
            offset = padded[reach + dv : reach + dv + height, reach + du : reach + du + width] - points
            neighbour_m = offset[..., 2] + depth_m
            on_surface = (neighbour_m > 0) & (np.abs(offset[..., 2]) < _MAX_RELATIVE_DEPTH_STEP * depth_m)
            offset = np.where(on_surface[..., None], offset, 0.0)
            count += on_surface
            total += offset
            outer += offset[..., :, None] * offset[..., None, :]
    known = (depth_m > 0) & (count >= _MIN_NEIGHBOURS)
    number = np.maximum(count, 1.0)[..., None]
    mean = total / number
    spread = outer / number[..., None] - mean[..., :, None] * mean[..., None, :]
    rays = camera.pixel_rays().astype(np.float64)
    noise = robust.depth_sigmas_m(depth_m.astype(np.float64), settings)[..., None] * rays
    return Distributions(
        means_m=np.where(known[..., None], points, 0.0),
        covariances_m2=spread + noise[..., :, None] * noise[..., None, :],
    )


def shown_by_view(points_m: Array, rendered_m: npt.NDArray[np.float32], camera: Camera) -> npt.NDArray[np.bool_]:
    """Which points [K,3] (camera frame) a rendered depth image [H,W] shows: inside, and as deep as it was rendered."""
    z = np.maximum(points_m[:, 2], _NEAREST_M)
    uv = np.stack([camera.fx * points_m[:, 0] / z + camera.cx, camera.fy * points_m[:, 1] / z + camera.cy], -1)
    shown = (points_m[:, 2] > _NEAREST_M) & robust.inside(uv, camera, border_px=0.0)
    pixels = np.where(shown[:, None], uv, 0.0).astype(np.int64)
    rendered = rendered_m[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    return shown & (rendered > 0) & (np.abs(rendered - z) <= _VISIBLE_TOLERANCE * rendered)


def gicp_system(
    surface: Distributions,
    measured: Distributions,
    camera: Camera,
    T: Matrix4,
    level: int,
    settings: GaussNewtonSettings,
) -> LinearSystem:
    """Normal equations of a left twist on ``T``, which takes the surface's frame to the camera's.

    Args:
        surface: K distributions of the map.
        measured: Those of the frame's pixels, [H,W,...]; a pair is a point and the pixel that it falls into.
        camera: The frame's.
        T: float64 [4,4].
        level: Pyramid level of the colours beside it.
        settings: Noise model and weights.
    """
    share = 4.0**level
    here = surface.moved(T)
    p = here.means_m
    z = np.maximum(p[:, 2], _NEAREST_M)
    uv = np.stack([camera.fx * p[:, 0] / z + camera.cx, camera.fy * p[:, 1] / z + camera.cy], -1)
    kept = np.flatnonzero((p[:, 2] > _NEAREST_M) & robust.inside(uv, camera, border_px=0.0))
    pixels = uv[kept].astype(np.int64)
    q, C_q = measured.means_m[pixels[:, 1], pixels[:, 0]], measured.covariances_m2[pixels[:, 1], pixels[:, 0]]
    known = q[:, 2] > 0
    kept, q, C_q = kept[known], q[known], C_q[known]
    offset = q - p[kept]
    information = np.linalg.inv(C_q + here.covariances_m2[kept])
    sigmas = np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", offset, information, offset), 0.0))
    near = sigmas <= settings.depth_gate_sigmas * 3.0**level
    kept, offset, information, sigmas = kept[near], offset[near], information[near], sigmas[near]
    weights = settings.depth_weight * share * robust.huber_weights(sigmas)
    J = np.zeros((kept.size, 3, 6))
    J[:, :, :3] = -np.eye(3)
    J[:, :, 3:] = np.cross(np.eye(3), p[kept][:, None, :])  # row i of hat(p): the unit vector i crossed with p
    weighted = np.einsum("k,kij,kjl->kil", weights, information, J)
    number = kept.size * share
    costs = settings.depth_weight * share * robust.huber_costs(sigmas)
    return LinearSystem(
        H=np.einsum("kil,kim->lm", weighted, J),
        g=np.einsum("kil,ki->l", weighted, offset),
        mean_cost=float(costs.sum()) / max(number, 1.0),
        measured=int(number),
    )

"""Inverse-compositional alignment: the rendered view is moved, so its derivatives are taken once per level.

Same measurements, noise model and robust weights as the tracker's; only the side that is linearised differs. A pixel of
the view looks up the frame's colour, a measured point the frame's depth; the twist that would move the *view* onto
them is found with derivatives that never change, and its inverse is composed with the estimate.
"""

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.optim.alignment import LinearSystem, Observed, ObservedLevel, Reference, ReferenceLevel
from vtslam.common.settings import GaussNewtonSettings
from vtslam.common.splat.engine import Engine
from vtslam.services.bench.pose_variants import robust
from vtslam.services.bench.pose_variants.rounds import AlignsLevel, render_and_align, solved_level
from vtslam.services.bench.pose_variants.task import FoundPose, Matrix4, PoseTask

_BORDER_PX = 1.5
_LEAST_SLANT = 0.2
_NEAREST_M = 0.01

Array = npt.NDArray[np.float64]


class InverseCompositional:
    """The tracker's rounds with inverse-compositional alignment (protocol ``SolvesPose``)."""

    def __init__(self, engine: Engine, settings: GaussNewtonSettings) -> None:
        self._engine, self._settings = engine, settings

    def solve(self, task: PoseTask, T_guess: Matrix4) -> FoundPose:
        """See ``SolvesPose``."""
        return render_and_align(task, T_guess, self._engine, self._settings, self._aligner)

    def _aligner(self, T_camera_section: Matrix4) -> AlignsLevel:
        def align_level(reference: Reference, observed: Observed, level: int, T: Matrix4) -> Matrix4:
            colors = FixedColors(reference.levels[level], self._settings)
            planes = FixedPlanes(reference.points[:: 4**level], self._settings)

            def linearised(T: Matrix4) -> LinearSystem:
                color = colors.system(observed.levels[level], T, level)
                depth = planes.system(observed, T, level)
                measured = color.measured + depth.measured
                cost = color.mean_cost * color.measured + depth.mean_cost * depth.measured
                return LinearSystem(
                    H=color.H + depth.H, g=color.g + depth.g, mean_cost=cost / max(measured, 1), measured=measured
                )

            def stepped(T: Matrix4, step: Array) -> Matrix4:
                return T @ se3.exp(-step)

            return solved_level(linearised, stepped, T, self._settings)

        return align_level


class FixedColors:
    """Colours of a rendered view with their derivatives by a twist of the view's own points."""

    def __init__(self, view: ReferenceLevel, settings: GaussNewtonSettings) -> None:
        self._settings = settings
        # A derivative needs its neighbours: pixels next to the mask's border have none.
        inner = cv2.erode(view.mask, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        rows, columns = np.nonzero((inner > 0) & (view.depth_m > 0))
        self._points = view.camera.back_projected(view.depth_m)[rows, columns].astype(np.float64)
        self._rgb = view.rgb[rows, columns].astype(np.float64)
        du, dv = (by[rows, columns] for by in robust.image_derivatives(view.rgb))
        self._J = np.stack(
            [
                robust.twist_rows(
                    self._points, robust.image_gradients_by_point(du[:, c], dv[:, c], self._points, view.camera)
                )
                for c in range(3)
            ],
            axis=1,
        )

    def system(self, frame: ObservedLevel, T: Matrix4, level: int) -> LinearSystem:
        """Normal equations of a twist of the view's points, the frame's camera being at ``T``."""
        s, share = self._settings, 4.0**level
        p = robust.moved(T, self._points)
        z = np.maximum(p[:, 2], _NEAREST_M)
        uv = np.stack([frame.camera.fx * p[:, 0] / z, frame.camera.fy * p[:, 1] / z], -1)
        uv += (frame.camera.cx, frame.camera.cy)
        used = (p[:, 2] > _NEAREST_M) & robust.inside(uv, frame.camera, border_px=_BORDER_PX)
        kept = np.flatnonzero(used)
        nearest = uv[kept].astype(np.int64)
        depth = frame.packed[nearest[:, 1], nearest[:, 0], 9].astype(np.float64)
        gate = s.depth_gate_sigmas * 3.0**level * robust.depth_sigmas_m(depth, s)
        agrees = (depth > 0) & (np.abs(depth - p[kept, 2]) <= gate)
        kept = kept[agrees]
        seen = robust.sampled(frame.packed[..., :3], uv[kept])
        sigmas = (self._rgb[kept] - seen) / s.color_sigma
        weights = s.color_weight * share / s.color_sigma**2 * robust.huber_weights(sigmas)
        costs = s.color_weight * share * robust.huber_costs(sigmas)
        return _system(
            self._J[kept].reshape(-1, 6), (sigmas * s.color_sigma).ravel(), weights.ravel(), costs, kept.size * share
        )


class FixedPlanes:
    """Measured points of a view with the derivatives of their distances by a twist of the points."""

    def __init__(self, points: npt.NDArray[np.float32], settings: GaussNewtonSettings) -> None:
        self._settings = settings
        self._points, self._normals = points[:, :3].astype(np.float64), points[:, 3:].astype(np.float64)
        # The twist takes a view's point to where the frame's camera sees it now; its inverse is the frame's motion.
        self._J = robust.twist_rows(self._points, self._normals)

    def system(self, observed: Observed, T: Matrix4, level: int) -> LinearSystem:
        """Normal equations of a twist of the view's points, the frame's camera being at ``T``."""
        s, share, camera = self._settings, 4.0**level, observed.camera
        p = robust.moved(T, self._points)
        z = np.maximum(p[:, 2], _NEAREST_M)
        uv = np.stack([camera.fx * p[:, 0] / z + camera.cx, camera.fy * p[:, 1] / z + camera.cy], -1)
        kept = np.flatnonzero((p[:, 2] > _NEAREST_M) & robust.inside(uv, camera, border_px=0.0))
        nearest = uv[kept].astype(np.int64)
        depth = observed.depth_m[nearest[:, 1], nearest[:, 0]].astype(np.float64)
        kept, nearest, depth = kept[depth > 0], nearest[depth > 0], depth[depth > 0]
        rays = np.stack(
            [
                (nearest[:, 0] + 0.5 - camera.cx) / camera.fx,
                (nearest[:, 1] + 0.5 - camera.cy) / camera.fy,
                np.ones(kept.size),
            ],
            -1,
        )
        q = robust.moved(se3.inverse(T), rays * depth[:, None])
        distances = np.einsum("ki,ki->k", self._normals[kept], q - self._points[kept])
        turned = self._normals[kept] @ T[:3, :3].T
        slant = np.abs(np.einsum("ki,ki->k", turned, rays)) / np.linalg.norm(rays, axis=1)
        sigma = robust.depth_sigmas_m(depth, s) * np.maximum(slant, _LEAST_SLANT)
        sigmas = distances / sigma
        near = np.abs(sigmas) <= s.depth_gate_sigmas * 3.0**level
        weights = s.depth_weight * share * robust.huber_weights(sigmas) / sigma**2
        costs = s.depth_weight * share * robust.huber_costs(sigmas[near])
        return _system(self._J[kept[near]], distances[near], weights[near], costs, int(near.sum()) * share)


def _system(J: Array, residuals: Array, weights: Array, costs: Array, measured: float) -> LinearSystem:
    weighted = J * weights[:, None]
    return LinearSystem(
        H=weighted.T @ J,
        g=weighted.T @ residuals,
        mean_cost=float(costs.sum()) / max(measured, 1.0),
        measured=int(measured),
    )

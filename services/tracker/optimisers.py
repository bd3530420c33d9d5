"""The two pose optimisers of Eq. 1 behind one call: ``adam`` (the paper's) and ``gauss_newton`` (few renders)."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.optim.alignment import PosePrior, align, observed_frame, reference_view
from vtslam.common.optim.pose_adam import PoseAdam
from vtslam.common.optim.tracking_loss import Target, TrackingLoss, tracking_loss
from vtslam.common.section import Section
from vtslam.common.settings import AdamSettings, GaussNewtonSettings, TrackerSettings
from vtslam.common.splat.engine import Engine, Rendering
from vtslam.services.tracker.state import UNKNOWN_VARIANCE

_ADAPTIVE_SILHOUETTES = (0.990, 0.993, 0.995, 0.997, 0.999)
_SMALL_STEP = 20.0  # in steps that end a level
_COARSEST_SIDE_PX = 15  # smaller images say nothing about a pose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseEstimate:
    """A pose and what was seen on the way.

    Attributes:
        T_camera_section: float64 [4,4].
        covariance: float64 [6,6], left twist on it.
        first_loss: Eq. 1 at the guess.
        loss: Eq. 1 at the last render (at the best pose for Adam).
        renders: Renders spent.
    """

    T_camera_section: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64]
    first_loss: TrackingLoss
    loss: TrackingLoss
    renders: int


class PoseOptimiser(Protocol):
    """Finds the pose from which ``section`` looks like the frame."""

    def pretrack(self, section: Section, mask: npt.NDArray[np.uint8], T_guess: npt.NDArray[np.float64]) -> PoseEstimate:
        """A short run, to compare sections."""
        ...

    def solve(self, section: Section, mask: npt.NDArray[np.uint8], T_guess: npt.NDArray[np.float64]) -> PoseEstimate:
        """The full run. ``mask`` uint8 [H,W] is the fixed part of W in Eq. 1."""
        ...


def make_optimiser(
    frame: Frame,
    rgb: npt.NDArray[np.float32],
    engine: Engine,
    settings: TrackerSettings,
    *,
    in_first_section: bool,
    prior: PosePrior | None,
    threads: int,
) -> PoseOptimiser:
    """The optimiser the settings ask for, ready for one frame, whose colour in the map's gauge is ``rgb`` [H,W,3]."""
    if settings.optimizer == "adam":
        return _Adam(frame, rgb, engine, settings.adam, in_first_section=in_first_section, prior=prior)
    return _GaussNewton(frame, rgb, engine, settings, prior=prior, threads=threads)


class _Adam:
    """First-order descent with the minimum of the loss kept (the pose kept is the one evaluated)."""

    def __init__(
        self,
        frame: Frame,
        rgb: npt.NDArray[np.float32],
        engine: Engine,
        settings: AdamSettings,
        *,
        in_first_section: bool,
        prior: PosePrior | None,
    ) -> None:
        self._camera, self._engine, self._settings, self._prior = frame.camera, engine, settings, prior
        self._rgb, self._depth_m = rgb, frame.depth_m()
        self._iterations = settings.first_section_iterations if in_first_section else settings.iterations

    def pretrack(self, section: Section, mask: npt.NDArray[np.uint8], T_guess: npt.NDArray[np.float64]) -> PoseEstimate:
        return self._descend(section, mask, T_guess, self._settings.pretrack_iterations)

    def solve(self, section: Section, mask: npt.NDArray[np.uint8], T_guess: npt.NDArray[np.float64]) -> PoseEstimate:
        return self._descend(section, mask, T_guess, self._iterations)

    def _descend(
        self, section: Section, mask: npt.NDArray[np.uint8], T_guess: npt.NDArray[np.float64], iterations: int
    ) -> PoseEstimate:
        s = self._settings
        adam = PoseAdam(T_guess, rate_rotation=s.learning_rate_rotation, rate_translation=s.learning_rate_translation)
        target = Target(rgb=self._rgb, depth_m=self._depth_m, mask=mask)
        threshold = s.silhouette_threshold
        first: TrackingLoss | None = None
        best: tuple[float, TrackingLoss, npt.NDArray[np.float64]] | None = None
        renders = 0
        while renders < iterations:
            T = adam.T_camera_map
            rendering = self._engine.render(section.splats, self._camera, T)
            renders += 1
            if first is None and s.silhouette_adaptive:
                threshold = _adaptive_silhouette(rendering, target)
            loss, d_rgb, d_depth = tracking_loss(
                rendering,
                target,
                silhouette_threshold=threshold,
                color_weight=s.color_weight,
                depth_weight=s.depth_weight,
            )
            first = first or loss
            prior_cost, prior_gradient = self._prior_terms(T)
            cost = loss.total + prior_cost / max(loss.pixels, 1)
            if best is None or cost < best[0]:
                best = (cost, loss, T)
            if loss.pixels == 0:
                break
            adam.step(self._engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth).pose + prior_gradient)
        assert first is not None
        assert best is not None
        return PoseEstimate(
            T_camera_section=best[2],
            covariance=_adam_covariance(best[1]),
            first_loss=first,
            loss=best[1],
            renders=renders,
        )

    def _prior_terms(self, T: npt.NDArray[np.float64]) -> tuple[float, npt.NDArray[np.float64]]:
        """Cost and gradient of the prior at ``T``, on the scale of Eq. 1's sums."""
        if self._prior is None:
            return 0.0, np.zeros(6)
        error = se3.log(T @ se3.inverse(self._prior.T_camera_map))
        pull = self._prior.information @ error
        return 0.5 * float(error @ pull), pull


def _adam_covariance(loss: TrackingLoss) -> npt.NDArray[np.float64]:
    """A rough covariance of a first-order estimate: the depth error averaged over its pixels, at 1 m lever arm."""
    if loss.pixels == 0:
        return np.eye(6) * UNKNOWN_VARIANCE
    # Neighbouring residuals are alike: count one independent measurement per 16x16 pixels.
    independent = max(loss.pixels / 256.0, 1.0)
    return np.eye(6) * max(loss.depth_m, 1e-4) ** 2 / independent


def _adaptive_silhouette(rendering: Rendering, target: Target) -> float:
    """The threshold with the smallest mean squared colour error inside it (docs/method.md, 2.3)."""
    squared = np.square(rendering.rgb - target.rgb).mean(axis=2)
    errors = []
    for threshold in _ADAPTIVE_SILHOUETTES:
        inside = (rendering.alpha > threshold) & (target.depth_m > 0)
        errors.append(float(squared[inside].mean()) if inside.any() else np.inf)
    return _ADAPTIVE_SILHOUETTES[int(np.argmin(errors))]


class _GaussNewton:
    """Render, align the frame to the rendered view until that converges, render again from there."""

    def __init__(
        self,
        frame: Frame,
        rgb: npt.NDArray[np.float32],
        engine: Engine,
        settings: TrackerSettings,
        *,
        prior: PosePrior | None,
        threads: int,
    ) -> None:
        self._camera, self._engine, self._prior, self._threads = frame.camera, engine, prior, threads
        self._settings: GaussNewtonSettings = settings.gauss_newton
        self._weights = settings.adam
        self._rgb, self._depth_m = rgb, frame.depth_m()

    def pretrack(self, section: Section, mask: npt.NDArray[np.uint8], T_guess: npt.NDArray[np.float64]) -> PoseEstimate:
        return self._refine(section, mask, T_guess, renders=2)

    def solve(self, section: Section, mask: npt.NDArray[np.uint8], T_guess: npt.NDArray[np.float64]) -> PoseEstimate:
        return self._refine(section, mask, T_guess, renders=self._settings.renders)

    def _refine(
        self, section: Section, mask: npt.NDArray[np.uint8], T_guess: npt.NDArray[np.float64], *, renders: int
    ) -> PoseEstimate:
        s = self._settings
        masked_depth = np.where(mask > 0, self._depth_m, np.float32(0))
        levels = pyramid_levels(s.levels, self._camera)
        observed = observed_frame(self._rgb, masked_depth, self._camera, levels)
        target = Target(rgb=self._rgb, depth_m=self._depth_m, mask=mask)
        T, information, first, loss, spent = T_guess, np.zeros((6, 6)), None, None, 0
        for _ in range(renders):
            rendering = self._engine.render(section.splats, self._camera, T)
            spent += 1
            loss, _, _ = tracking_loss(
                rendering,
                target,
                silhouette_threshold=s.silhouette_threshold,
                color_weight=self._weights.color_weight,
                depth_weight=self._weights.depth_weight,
            )
            first = first or loss
            # From the guess the view differs too much for its pixels to matter: they wait for the second rendering.
            coarsest, finest = (levels - 1, int(renders > 1)) if spent == 1 else (0, 0)
            reference = reference_view(
                rendering,
                self._camera,
                T,
                surface=section.surface,
                levels=coarsest + 1,
                silhouette_threshold=s.silhouette_threshold,
            )
            alignment = align(
                reference,
                observed,
                s,
                T_observed_reference=np.eye(4),
                prior=self._relative_prior(T),
                coarsest=coarsest,
                finest=finest,
                threads=self._threads,
            )
            if not alignment.solved:
                break
            T = se3.orthonormalized(alignment.T_observed_reference @ T)
            information = alignment.information
            step = se3.log(alignment.T_observed_reference)
            if finest == 0 and is_small_step(step, s):
                break
        assert first is not None
        assert loss is not None
        return PoseEstimate(
            T_camera_section=T, covariance=_covariance(information), first_loss=first, loss=loss, renders=spent
        )

    def _relative_prior(
        self, T_camera_map: npt.NDArray[np.float64]
    ) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None:
        if self._prior is None:
            return None
        return self._prior.T_camera_map @ se3.inverse(T_camera_map), self._prior.information


def is_small_step(step: npt.NDArray[np.float64], settings: GaussNewtonSettings) -> bool:
    """Whether a view from the pose before the step is as good as one from the pose after it."""
    return bool(
        np.linalg.norm(step[:3]) < _SMALL_STEP * settings.converged_m
        and np.linalg.norm(step[3:]) < _SMALL_STEP * settings.converged_rad
    )


def pyramid_levels(wanted: int, camera: Camera) -> int:
    """Levels whose images have at least ``_COARSEST_SIDE_PX`` rows and columns; one at least."""
    side = min(camera.width, camera.height)
    return max(1, min(wanted, (side // _COARSEST_SIDE_PX).bit_length()))


def _covariance(information: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Inverse information; directions nothing was measured along get a large variance."""
    values, vectors = np.linalg.eigh(information)
    # Pixels are correlated over the footprint of a Gaussian and of the depth sensor's filter: 1 in 16 counts.
    variances = np.minimum(16.0 / np.maximum(values, 1e-12), UNKNOWN_VARIANCE)
    return np.asarray((vectors * variances) @ vectors.T)

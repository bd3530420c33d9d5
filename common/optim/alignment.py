"""Damped Gauss-Newton alignment of a frame to a rendered view, coarse to fine (the robust, masked form of Eq. 1)."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.optim import _align
from vtslam.common.settings import GaussNewtonSettings
from vtslam.common.splat.engine import Rendering

FloatImage = npt.NDArray[np.float32]

_MAX_RELATIVE_DEPTH_STEP = 0.05  # pixels further apart than this are not merged in a pyramid
_VISIBLE_TOLERANCE = 0.03  # relative; a point this near to the rendered depth is what the view shows
_BORDER_PX = 1.0
_MIN_MEASUREMENTS = 30  # six unknowns need a margin
_DAMPING = 1e-6  # of H's diagonal: keeps a flat wall solvable


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservedLevel:
    """One pyramid level of a frame: rgb, d rgb/du, d rgb/dv and depth (m), packed float32 [H,W,10]."""

    camera: Camera
    packed: FloatImage


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReferenceLevel:
    """One pyramid level of a rendered view: what each pixel shows and how far away it is."""

    camera: Camera
    rgb: FloatImage
    depth_m: FloatImage
    mask: npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """A rendered view as the frame is aligned to it.

    Attributes:
        levels: Colour pyramid, finest first.
        points: float32 [M,6], the measured points it shows: position (m) and normal, rendered camera's frame.
    """

    levels: list[ReferenceLevel]
    points: FloatImage


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Observed:
    """A frame as it is aligned: colour pyramid, finest first, and its depth image float32 [H,W] (m, 0 = left out)."""

    levels: list[ObservedLevel]
    depth_m: FloatImage
    camera: Camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PosePrior:
    """An external estimate of ``T_camera_map`` with its information matrix [6,6] (left twist, camera frame)."""

    T_camera_map: npt.NDArray[np.float64]
    information: npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """Result of aligning a frame to one rendered view.

    Attributes:
        T_observed_reference: float64 [4,4], from the rendered camera to the frame's.
        information: float64 [6,6], H at the solution (left twist on T_observed_reference).
        cost: Mean robust cost per measurement, in squared sigmas.
        solved: Whether there were enough measurements at the finest level.
    """

    T_observed_reference: npt.NDArray[np.float64]
    information: npt.NDArray[np.float64]
    cost: float
    solved: bool


def _halved_camera(camera: Camera) -> Camera:
    width, height = camera.width // 2, camera.height // 2
    return Camera(width=width, height=height, fx=camera.fx / 2, fy=camera.fy / 2, cx=camera.cx / 2, cy=camera.cy / 2)


def _quads(image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The four children [4,h,w,...] of each pixel of the halved image; an odd last row or column is left out."""
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.stack([image[i:h:2, j:w:2] for i in (0, 1) for j in (0, 1)])


def _halved_depth(depth_m: FloatImage) -> FloatImage:
    """Mean of the four children where all are valid and on one surface, else 0."""
    quads = _quads(depth_m)
    low, high = quads.min(axis=0), quads.max(axis=0)
    one_surface = (low > 0) & (high - low < _MAX_RELATIVE_DEPTH_STEP * low)
    return np.where(one_surface, quads.mean(axis=0), np.float32(0)).astype(np.float32)


def observed_frame(rgb: FloatImage, depth_m: FloatImage, camera: Camera, levels: int) -> Observed:
    """A frame ready for alignment: rgb float32 [H,W,3] in 0..1, depth float32 [H,W] (m, 0 = left out)."""
    pyramid, full_depth_m, full_camera = [], depth_m, camera
    for level in range(levels):
        if level:
            rgb, depth_m = _quads(rgb).mean(axis=0), _halved_depth(depth_m)
            camera = _halved_camera(camera)
        packed = np.empty((camera.height, camera.width, 10), np.float32)
        packed[..., 0:3] = rgb
        packed[..., 3:6] = cv2.Scharr(rgb, cv2.CV_32F, 1, 0, scale=1 / 32)
        packed[..., 6:9] = cv2.Scharr(rgb, cv2.CV_32F, 0, 1, scale=1 / 32)
        packed[..., 9] = depth_m
        pyramid.append(ObservedLevel(camera=camera, packed=packed))
    return Observed(levels=pyramid, depth_m=full_depth_m, camera=full_camera)


def reference_view(
    rendering: Rendering,
    camera: Camera,
    T_camera_map: npt.NDArray[np.float64],
    *,
    surface: FloatImage,
    levels: int,
    silhouette_threshold: float,
) -> Reference:
    """A rendered view ready for alignment, colour and depth divided by the silhouette where that is high.

    Depth accumulated front to back leans towards the camera on slanted surfaces, so distances are not measured to it:
    it only tells which of the map's measured points (``surface`` float32 [M,6], map frame) the view shows.
    """
    covered = rendering.alpha > max(silhouette_threshold, 1e-3)
    inverse = np.where(covered, 1.0 / np.maximum(rendering.alpha, 1e-3), 0.0).astype(np.float32)
    rgb, depth_m = rendering.rgb * inverse[..., None], rendering.depth_m * inverse
    points = _align.visible_points(
        surface, np.ascontiguousarray(T_camera_map), depth_m, _intrinsics(camera), _VISIBLE_TOLERANCE
    )
    mask = covered.astype(np.uint8)
    pyramid = []
    for level in range(levels):
        if level:
            rgb, depth_m = _quads(rgb).mean(axis=0), _halved_depth(depth_m)
            mask = _quads(mask.astype(np.float32)).min(axis=0).astype(np.uint8)
            camera = _halved_camera(camera)
        pyramid.append(ReferenceLevel(camera=camera, rgb=np.ascontiguousarray(rgb), depth_m=depth_m, mask=mask))
    return Reference(levels=pyramid, points=np.asarray(points))


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearSystem:
    """Normal equations of a left twist on ``T_observed_reference``.

    Attributes:
        H: float64 [6,6].
        g: float64 [6].
        mean_cost: Mean robust cost per measurement, in squared sigmas.
        measured: Measurements, in pixels of the full image.
    """

    H: npt.NDArray[np.float64]
    g: npt.NDArray[np.float64]
    mean_cost: float
    measured: int


def linearised(
    reference: Reference,
    points: FloatImage,
    observed: Observed,
    level: int,
    T: npt.NDArray[np.float64],
    settings: GaussNewtonSettings,
    prior: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None,
    threads: int,
) -> LinearSystem:
    """Both terms of one pyramid level, linearised.

    Args:
        reference: The rendered view.
        points: float32 [M,6], those of its points that this level uses.
        observed: The frame.
        level: 0 is the finest.
        T: ``T_observed_reference`` float64 [4,4].
        settings: Noise model and weights.
        prior: (``T_observed_reference`` it asks for, information [6,6]) or None.
        threads: Threads of the kernel; the result does not depend on it.
    """
    share = 4.0**level  # a pixel of a coarse level stands for so many pixels, and so does a point
    options = _align.AlignmentOptions(
        color_sigma=settings.color_sigma,
        color_weight=settings.color_weight * share,
        depth_sigma_base=settings.depth_sigma_base_m,
        depth_sigma_quadratic=settings.depth_sigma_per_m,
        depth_weight=settings.depth_weight * share,
        depth_gate_sigmas=settings.depth_gate_sigmas * 3.0**level,  # the first guess may be far off
        border_px=_BORDER_PX,
    )
    view, frame = reference.levels[level], observed.levels[level]
    H, g, color_cost, depth_cost, color_count, depth_count = _align.normal_equations(
        view.rgb,
        view.depth_m,
        view.mask,
        frame.packed,
        _intrinsics(view.camera),
        points,
        observed.depth_m,
        _intrinsics(observed.camera),
        np.ascontiguousarray(T),
        options,
        threads,
    )
    H, g, cost = np.asarray(H), np.asarray(g), color_cost + depth_cost
    if prior is not None:
        error = se3.log(T @ se3.inverse(prior[0]))
        H, g, cost = H + prior[1], g + prior[1] @ error, cost + 0.5 * float(error @ prior[1] @ error)
    measured = int((color_count + depth_count) * share)
    return LinearSystem(H=H, g=g, mean_cost=cost / max(measured, 1), measured=measured)


def align(
    reference: Reference,
    observed: Observed,
    settings: GaussNewtonSettings,
    *,
    T_observed_reference: npt.NDArray[np.float64],
    prior: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None = None,
    coarsest: int,
    finest: int = 0,
    threads: int = 1,
) -> Alignment:
    """Move the frame's camera until the rendered surface agrees with the frame, from level ``coarsest`` to ``finest``.

    Args:
        reference: The rendered view.
        observed: The frame.
        settings: Noise model, iterations and convergence test.
        T_observed_reference: float64 [4,4], first guess.
        prior: (pose it asks for, information [6,6]) or None.
        coarsest: Level to start at.
        finest: Level to end at; the coarsest there is, if it has fewer.
        threads: Threads of the kernel; the result does not depend on it.
    """
    T = T_observed_reference
    system: LinearSystem | None = None
    first = min(coarsest, len(reference.levels) - 1, len(observed.levels) - 1)
    for level in range(first, min(finest, first) - 1, -1):
        T, system = _solved_level(reference, observed, level, T, settings, prior, threads)
    assert system is not None
    return Alignment(
        T_observed_reference=T,
        information=system.H,
        cost=system.mean_cost,
        solved=system.measured >= _MIN_MEASUREMENTS,
    )


def _solved_level(
    reference: Reference,
    observed: Observed,
    level: int,
    T: npt.NDArray[np.float64],
    settings: GaussNewtonSettings,
    prior: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None,
    threads: int,
) -> tuple[npt.NDArray[np.float64], LinearSystem]:
    """Gauss-Newton on one level; a step that raises the mean cost is halved once, then ends the level."""
    points = np.ascontiguousarray(reference.points[:: 4**level])
    system = linearised(reference, points, observed, level, T, settings, prior, threads)
    for _ in range(settings.iterations):
        if system.measured < _MIN_MEASUREMENTS:
            break
        damped = system.H + _DAMPING * np.diag(np.diag(system.H)) + 1e-9 * np.eye(6)
        step = np.asarray(-np.linalg.solve(damped, system.g), np.float64)
        trial = linearised(reference, points, observed, level, se3.exp(step) @ T, settings, prior, threads)
        if trial.mean_cost > system.mean_cost or trial.measured < _MIN_MEASUREMENTS:
            step = 0.5 * step
            trial = linearised(reference, points, observed, level, se3.exp(step) @ T, settings, prior, threads)
            if trial.mean_cost > system.mean_cost or trial.measured < _MIN_MEASUREMENTS:
                break
        T, system = se3.exp(step) @ T, trial
        if np.linalg.norm(step[:3]) < settings.converged_m and np.linalg.norm(step[3:]) < settings.converged_rad:
            break
    return T, system

"""Comparison of a rasteriser with the reference: the same suite for the tests and for ``vtslam doctor --gpu``.

A float32 engine and the float64 reference can disagree by a whole step where a splat's alpha meets ``alpha_min`` or a
pixel's transmittance meets its minimum. Pixels that near to a cut are left out of the maximum errors and get zero
image derivatives; their share is bounded, and the mean errors count every pixel.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch

from vtslam.common.geometry import se3
from vtslam.common.splat.engine import Engine, RasterSettings, Rendering
from vtslam.common.splat.parity_scenes import Scene, scenes, smooth_scenes
from vtslam.common.splat.reference import ReferenceEngine

MakeEngine = Callable[[RasterSettings], Engine]
Float64 = npt.NDArray[np.float64]

_ALPHA_BAND = 1e-6  # |alpha - alpha_min| of a left-out pixel; float32 rounding stays below
_STOP_BAND = 1e-3  # the same for the transmittance, relative
_DEPTH_FLOOR_M = 0.01  # where less depth has accumulated, errors are relative to this
_GRADIENT_FLOOR = 1e-2  # absolute L1 below which a gradient counts as zero
_STEP = 1e-3  # of finite differences, m and rad


@dataclass(frozen=True, slots=True, kw_only=True)
class Tolerances:
    """Largest errors allowed; the defaults are the native engine's."""

    image: float = 1e-5
    image_mean: float = 1e-6
    gradient: float = 1e-4
    pose_difference: float = 2e-3
    left_out: float = 1e-3


# gsplat's kernels use approximate exponentials and divisions, and recover the transmittance from 1 - alpha in float32.
# Chosen from those causes, before anyone ran it.
GSPLAT_TOLERANCES = Tolerances(image=1e-4, image_mean=1e-5, gradient=2e-3)


@dataclass(frozen=True, slots=True, kw_only=True)
class ParityReport:
    """Errors of one scene.

    Attributes:
        scene: Its name. pixels, left_out: Number of pixels, and of those too near to a cut.
        rgb, depth, alpha: Largest error over the pixels kept; depth relative to the reference's.
        rgb_mean, depth_mean, alpha_mean: Mean error over all pixels.
        gradients: Relative L1 error by name: colors, log_radii, opacity_logits, means_m, pose, weights.
    """

    scene: str
    pixels: int
    left_out: int
    rgb: float
    depth: float
    alpha: float
    rgb_mean: float
    depth_mean: float
    alpha_mean: float
    gradients: dict[str, float]

    def failures(self, tolerances: Tolerances) -> list[str]:
        """What is out of tolerance, one line each."""
        checks = [(name, getattr(self, name), tolerances.image) for name in ("rgb", "depth", "alpha")]
        checks += [(f"gradient of {name}", error, tolerances.gradient) for name, error in self.gradients.items()]
        return [
            f"{self.scene}: {name} is off by {error:.2e}, allowed {limit:.0e}"
            for name, error, limit in checks
            if not error <= limit
        ]


def _errors(engine_image: Float64, reference_image: Float64, scale: Float64 | float) -> Float64:
    return np.abs(engine_image.astype(np.float64) - reference_image) / scale


def _relative_l1(given: npt.ArrayLike, expected: Float64) -> float:
    error = np.abs(np.asarray(given, np.float64) - expected).sum()
    return float(error / max(np.abs(expected).sum(), _GRADIENT_FLOOR))


def compare(engine: Engine, reference: ReferenceEngine, scene: Scene) -> ParityReport:
    """Render ``scene`` with both, pull random image derivatives back through both, and measure the differences."""
    expected = reference.render(scene.splats, scene.camera, scene.T_camera_map)
    given = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    truth = expected.saved.images
    keep = ((truth.alpha_margin > _ALPHA_BAND) & (truth.stop_margin > _STOP_BAND)).numpy()
    rgb, depth, alpha = (image.detach().numpy() for image in (truth.rgb, truth.depth_m, truth.alpha))
    errors = {
        "rgb": _errors(np.asarray(given.rgb), rgb, 1.0).max(-1),
        "depth": _errors(np.asarray(given.depth_m), depth, np.maximum(depth, _DEPTH_FLOOR_M)),
        "alpha": _errors(np.asarray(given.alpha), alpha, 1.0),
    }
    return ParityReport(
        scene=scene.name,
        pixels=keep.size,
        left_out=int((~keep).sum()),
        gradients=_gradient_errors(engine, given, expected, scene, keep),
        **{name: float(np.max(error, where=keep, initial=0.0)) for name, error in errors.items()},
        **{f"{name}_mean": float(error.mean()) for name, error in errors.items()},
    )


def _gradient_errors(
    engine: Engine, given: Rendering, expected: Rendering, scene: Scene, keep: npt.NDArray[np.bool_]
) -> dict[str, float]:
    d_rgb, d_depth, d_alpha = scene.d_rgb * keep[..., None], scene.d_depth * keep, scene.d_alpha * keep
    names = ("means_m", "colors", "log_radii", "opacity_logits", "pose")
    truth = ReferenceEngine.backward_torch(expected.saved, d_rgb, d_depth, d_alpha)
    ours = engine.backward(given, d_rgb=d_rgb, d_depth=d_depth, d_alpha=d_alpha, want_means=True, want_weights=True)
    errors = {
        name: _relative_l1(getattr(ours, name), gradient.numpy()) for name, gradient in zip(names, truth, strict=True)
    }
    assert ours.weights is not None
    weights = ReferenceEngine.weights_torch(expected.saved).numpy()
    return {**errors, "weights": _relative_l1(ours.weights, weights)}


def pose_difference_error(engine: Engine, scene: Scene) -> float:
    """Largest error of the pose gradient against central finite differences of the reference's float64 images.

    Per component, relative to it, or to a hundredth of the largest one where it is smaller.
    """
    reference = ReferenceEngine(scene.settings)
    cotangents = [torch.as_tensor(image, dtype=torch.float64) for image in (scene.d_rgb, scene.d_depth, scene.d_alpha)]

    def loss(twist: Float64) -> float:
        images = reference.render(scene.splats, scene.camera, se3.exp(twist) @ scene.T_camera_map).saved.images
        pairs = zip((images.rgb, images.depth_m, images.alpha), cotangents, strict=True)
        return float(sum((image.detach() * cotangent).sum() for image, cotangent in pairs))

    expected = np.array([_central_difference(loss, axis) for axis in np.eye(6)])
    rendering = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    given = engine.backward(rendering, d_rgb=scene.d_rgb, d_depth=scene.d_depth, d_alpha=scene.d_alpha).pose
    scale = np.maximum(np.abs(expected), 0.01 * np.abs(expected).max())
    return float((np.abs(np.asarray(given) - expected) / scale).max())


def _central_difference(loss: Callable[[Float64], float], direction: Float64) -> float:
    """Derivative along ``direction`` at zero, of fourth order."""
    near, far = (loss(step * direction) - loss(-step * direction) for step in (_STEP, 2.0 * _STEP))
    return (8.0 * near - far) / (12.0 * _STEP)


@dataclass(frozen=True, slots=True, kw_only=True)
class SuiteReport:
    """All scenes' reports, the pose gradient's errors by scene, and what was allowed."""

    engine: str
    tolerances: Tolerances
    reports: list[ParityReport]
    pose_differences: dict[str, float] = field(default_factory=dict)

    @property
    def left_out(self) -> float:
        """Share of all pixels left out."""
        return sum(report.left_out for report in self.reports) / max(sum(r.pixels for r in self.reports), 1)

    def image_mean(self, name: str) -> float:
        """Mean error of an image (rgb, depth, alpha) over all pixels of all scenes."""
        total = sum(getattr(report, f"{name}_mean") * report.pixels for report in self.reports)
        return float(total / max(sum(report.pixels for report in self.reports), 1))

    def failures(self) -> list[str]:
        """What is out of tolerance, one line each; empty if the engines agree."""
        lines = [line for report in self.reports for line in report.failures(self.tolerances)]
        limit = self.tolerances.pose_difference
        for scene, error in self.pose_differences.items():
            if not error <= limit:
                lines.append(f"{scene}: pose gradient is off finite differences by {error:.2e}, allowed {limit:.0e}")
        for name in ("rgb", "depth", "alpha"):
            if not self.image_mean(name) <= self.tolerances.image_mean:
                lines.append(f"mean error of {name} over all pixels is {self.image_mean(name):.2e}")
        if self.left_out > self.tolerances.left_out:
            lines.append(f"{self.left_out:.3%} of pixels were left out, allowed {self.tolerances.left_out:.1%}")
        return lines

    def table(self) -> str:
        """The worst error of each quantity with its scene and its limit, as lines of text."""
        allowed = self.tolerances
        rows = [(name, _worst(self.reports, name), allowed.image) for name in ("rgb", "depth", "alpha")]
        for name in self.reports[0].gradients if self.reports else ():
            errors = {report.scene: report.gradients[name] for report in self.reports}
            rows.append((f"d/d {name}", _largest(errors), allowed.gradient))
        if self.pose_differences:
            rows.append(("d/d pose, differences", _largest(self.pose_differences), allowed.pose_difference))
        means = [(f"{name}, mean", (self.image_mean(name), "all"), allowed.image_mean) for name in _IMAGES]
        lines = [f"{self.engine} against reference, {len(self.reports)} scenes, {self.left_out:.4%} of pixels left out"]
        lines.append(f"{'quantity':<24}{'worst':>10}{'allowed':>10}  scene")
        for name, (error, scene), limit in [*rows, *means]:
            lines.append(f"{name:<24}{error:>10.1e}{limit:>10.0e}  {scene}{'' if error <= limit else '   FAILED'}")
        return "\n".join(lines)


_IMAGES = ("rgb", "depth", "alpha")


def _largest(errors: dict[str, float]) -> tuple[float, str]:
    scene = max(errors, key=lambda name: np.nan_to_num(errors[name], nan=np.inf))
    return errors[scene], scene


def _worst(reports: Iterable[ParityReport], name: str) -> tuple[float, str]:
    errors = {report.scene: getattr(report, name) for report in reports}
    return _largest(errors) if errors else (0.0, "-")


def run_suite(
    make_engine: MakeEngine,
    *,
    count: int = 200,
    seed: int = 0,
    tolerances: Tolerances | None = None,
    alpha_caps: tuple[float, ...] = (0.999, 0.99),
    view_margin: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SuiteReport:
    """Compare an engine with the reference on ``count`` scenes and a tenth as many smooth ones.

    Args:
        make_engine: Gives the engine for some constants of the image model.
        count: Number of scenes.
        seed: Seed of the scenes.
        tolerances: Largest errors allowed.
        alpha_caps: Caps the engine can have, see :func:`~vtslam.common.splat.parity_scenes.scenes`.
        view_margin: How far outside the image it follows the image model, see there.
        progress: Called with (scenes done, scenes in all) after each scene.
    """
    reports = []
    for scene in scenes(seed, count, alpha_caps=alpha_caps, view_margin=view_margin):
        reports.append(compare(make_engine(scene.settings), ReferenceEngine(scene.settings), scene))
        if progress is not None:
            progress(len(reports), count)
    smooth = smooth_scenes(seed, max(count // 10, 1))
    return SuiteReport(
        engine=make_engine(RasterSettings()).name,
        tolerances=tolerances or Tolerances(),
        reports=reports,
        pose_differences={scene.name: pose_difference_error(make_engine(scene.settings), scene) for scene in smooth},
    )

"""The reference against a per-pixel loop, its gradients against finite differences, and the suite against errors."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from vtslam.common.geometry.camera import Camera
from vtslam.common.splat import parity
from vtslam.common.splat.engine import FloatArray, Gradients, RasterSettings, Rendering, Splats
from vtslam.common.splat.parity_scenes import Scene, scenes, smooth_scenes
from vtslam.common.splat.reference import ReferenceEngine

Float64 = npt.NDArray[np.float64]
Footprint = tuple[float, Float64, Float64, float, Float64]


def _footprints(scene: Scene) -> list[Footprint]:
    """(z, image mean, inverse covariance, opacity, colour) by depth, of what is in front of the near plane."""
    camera = scene.camera
    out: list[Footprint] = []
    for index in range(scene.splats.count):
        mean = scene.splats.means_m[index].astype(np.float64)
        x, y, z = scene.T_camera_map[:3, :3] @ mean + scene.T_camera_map[:3, 3]
        if z <= scene.settings.near_m:
            continue
        J = camera.fx / z * np.array([[1.0, 0.0, -x / z], [0.0, 0.0, 0.0]])
        J += camera.fy / z * np.array([[0.0, 0.0, 0.0], [0.0, 1.0, -y / z]])
        sigma = np.exp(np.float64(scene.splats.log_radii[index]))
        covariance = sigma**2 * J @ J.T + scene.settings.low_pass_px2 * np.eye(2)
        center = np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
        opacity = float(1.0 / (1.0 + np.exp(-np.float64(scene.splats.opacity_logits[index]))))
        out.append((z, center, np.linalg.inv(covariance), opacity, scene.splats.colors[index].astype(np.float64)))
    return sorted(out, key=lambda footprint: footprint[0])


def _pixel(footprints: list[Footprint], at: Float64, s: RasterSettings) -> Float64:
    """Red, green, blue, depth, alpha of one pixel."""
    out, transmittance = np.zeros(5), 1.0
    for z, center, inverse, opacity, color in footprints:
        delta = at - center
        alpha = min(s.alpha_cap, opacity * float(np.exp(-0.5 * delta @ inverse @ delta)))
        if alpha < s.alpha_min:
            continue
        if transmittance * (1.0 - alpha) < s.transmittance_min:
            break
        out += alpha * transmittance * np.array([*color, z, 1.0])
        transmittance *= 1.0 - alpha
    return out


# One scene of each kind; the larger sizes cost the loop too long.
SMALL = [scene for scene in scenes(5, 60) if scene.camera.width * scene.camera.height < 300]


@pytest.mark.parametrize("scene", SMALL, ids=lambda scene: scene.name)
def test_images_are_those_of_a_loop_over_pixels(scene: Scene) -> None:
    rendering = ReferenceEngine(scene.settings).render(scene.splats, scene.camera, scene.T_camera_map)
    images = rendering.saved.images
    ours = np.concatenate([image.detach().numpy() for image in (images.rgb, images.depth_m[..., None])], -1)
    alpha = images.alpha.detach()
    footprints = _footprints(scene)
    for row, column in np.ndindex(scene.camera.height, scene.camera.width):
        expected = _pixel(footprints, np.array([column + 0.5, row + 0.5]), scene.settings)
        np.testing.assert_allclose(ours[row, column], expected[:4], rtol=1e-9, atol=1e-11)
        assert abs(float(alpha[row, column]) - expected[4]) < 1e-11


def test_small_scenes_cover_all_kinds() -> None:
    kinds = {scene.name.rsplit("-", 1)[0] for scene in SMALL}
    assert kinds >= {"scattered", "borders", "behind", "near-plane", "deep", "huge", "invisible", "opaque", "ties"}


def test_gradients_are_those_of_finite_differences() -> None:
    scene = next(iter(smooth_scenes(11, 1)))
    engine = ReferenceEngine(scene.settings)

    def loss(splats: Splats) -> float:
        images = engine.render(splats, scene.camera, scene.T_camera_map).saved.images
        pairs = ((images.rgb, scene.d_rgb), (images.depth_m, scene.d_depth), (images.alpha, scene.d_alpha))
        return float(sum((image.detach().numpy() * derivative).sum() for image, derivative in pairs))

    rendering = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    gradients = engine.backward(
        rendering, d_rgb=scene.d_rgb, d_depth=scene.d_depth, d_alpha=scene.d_alpha, want_means=True
    )
    for name in ("means_m", "colors", "log_radii", "opacity_logits"):
        column: Float64 = getattr(scene.splats, name).astype(np.float64)
        expected = np.empty_like(column)
        for index in np.ndindex(column.shape):
            step = np.zeros_like(column)
            step[index] = 1e-5
            # Columns may have any type inside: float64 here, so that the differences mean something.
            more: Any = {name: column + step}
            less: Any = {name: column - step}
            expected[index] = (loss(replace(scene.splats, **more)) - loss(replace(scene.splats, **less))) / 2e-5
        np.testing.assert_allclose(getattr(gradients, name), expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("scene", list(smooth_scenes(2, 3)), ids=lambda scene: scene.name)
def test_pose_gradient_is_that_of_finite_differences(scene: Scene) -> None:
    assert parity.pose_difference_error(ReferenceEngine(scene.settings), scene) < 1e-6


def test_margins_tell_how_far_a_pixel_is_from_a_cut() -> None:
    camera = Camera(width=1, height=1, fx=1.0, fy=1.0, cx=0.5, cy=0.5)
    alphas = np.array([0.9, 1.5 / 255.0, 0.9985, 0.5])  # transmittances 0.1, 0.0994, 1.49e-4, (7.5e-5: the stop)
    splats = Splats(
        means_m=np.array([[0.0, 0.0, 1.0 + i] for i in range(4)], np.float32),
        colors=np.ones((4, 3), np.float32),
        log_radii=np.zeros(4, np.float32),
        opacity_logits=np.log(alphas / (1.0 - alphas)).astype(np.float32),
    )
    images = ReferenceEngine().render(splats, camera, np.eye(4)).saved.images
    stop = 0.1 * (1.0 - alphas[1]) * (1.0 - alphas[2])
    assert float(images.alpha_margin) == pytest.approx(0.5 / 255.0, rel=1e-5)
    assert float(images.stop_margin) == pytest.approx(abs(0.5 * stop / 1e-4 - 1.0), rel=1e-3)
    assert float(images.alpha.detach()) == pytest.approx(1.0 - stop, rel=1e-6)


class _Altered:
    """The reference with one thing wrong."""

    name = "altered"

    def __init__(self, settings: RasterSettings, fault: str) -> None:
        self.settings = settings
        self._fault = fault
        wrong = replace(settings, low_pass_px2=settings.low_pass_px2 + 1e-4) if fault == "low_pass" else settings
        self._engine = ReferenceEngine(wrong)

    def render(self, splats: Splats, camera: Camera, T_camera_map: Float64) -> Rendering:
        rendering = self._engine.render(splats, camera, T_camera_map)
        rgb = rendering.rgb.copy()
        if self._fault == "corner":
            rgb[-1, -1] += 3e-5
        if self._fault == "nan":
            rgb[0, 0] = np.nan
        return replace(rendering, rgb=rgb)

    def backward(
        self,
        rendering: Rendering,
        *,
        d_rgb: FloatArray,
        d_depth: FloatArray,
        d_alpha: FloatArray | None = None,
        want_means: bool = False,
        want_pose: bool = True,
        want_weights: bool = False,
    ) -> Gradients:
        gradients = self._engine.backward(
            rendering,
            d_rgb=d_rgb,
            d_depth=d_depth,
            d_alpha=d_alpha,
            want_means=want_means,
            want_pose=want_pose,
            want_weights=want_weights,
        )
        right = getattr(gradients, self._fault, None)
        if right is None:
            return gradients
        wrong: Any = {self._fault: right * np.float32(1.0003)}
        return replace(gradients, **wrong)


def test_the_suite_passes_the_reference_itself() -> None:
    report = parity.run_suite(ReferenceEngine, count=12, seed=1)
    assert report.failures() == []
    assert "12 scenes" in report.table()


@pytest.mark.parametrize(
    "fault", ["corner", "nan", "low_pass", "colors", "log_radii", "opacity_logits", "means_m", "pose"]
)
def test_the_suite_sees_a_wrong_engine(fault: str) -> None:
    report = parity.run_suite(lambda settings: _Altered(settings, fault), count=3, seed=1)
    assert report.failures() != []
    assert "FAILED" in report.table()


@pytest.mark.parametrize("name", ["means_m", "colors", "log_radii", "opacity_logits"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_refuses_what_is_not_finite(name: str, value: float) -> None:
    scene = next(scenes(3, 1))
    getattr(scene.splats, name).flat[-1] = value
    with pytest.raises(ValueError, match=name):
        ReferenceEngine().render(scene.splats, scene.camera, scene.T_camera_map)


def test_refuses_misshapen_input() -> None:
    scene = next(scenes(3, 1))
    engine = ReferenceEngine()
    short: Any = {"colors": scene.splats.colors[:-1]}
    with pytest.raises(ValueError, match="colors must have shape"):
        engine.render(replace(scene.splats, **short), scene.camera, scene.T_camera_map)
    with pytest.raises(ValueError, match="rigid"):
        engine.render(scene.splats, scene.camera, 2.0 * scene.T_camera_map)
    rendering = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    with pytest.raises(ValueError, match="derivative"):
        engine.backward(rendering, d_rgb=scene.d_rgb[1:], d_depth=scene.d_depth)
    with pytest.raises(ValueError, match="derivative"):
        engine.backward(rendering, d_rgb=scene.d_rgb, d_depth=scene.d_depth * np.float32(np.inf))

import dataclasses
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from helpers.native_scene import as_floats, image_derivatives, scattered

from vtslam.common.geometry.camera import Camera
from vtslam.common.splat import _native
from vtslam.common.splat.engine import Gradients, RasterSettings, Rendering, Splats
from vtslam.common.splat.native_engine import NativeEngine

_FIELDS = ("colors", "log_radii", "opacity_logits", "means_m", "pose")


@pytest.fixture(params=_native.available_simd())
def simd(request: pytest.FixtureRequest) -> Iterator[str]:
    before = _native.simd()
    _native.select_simd(request.param)
    yield request.param
    _native.select_simd(before)


def _one(*, z: float = 2.0, log_radius: float = -4.0, logit: float = 0.5) -> Splats:
    return Splats(
        means_m=as_floats([[0.0, 0.0, z]]),
        colors=as_floats([[0.2, 0.4, 0.8]]),
        log_radii=as_floats([log_radius]),
        opacity_logits=as_floats([logit]),
    )


def _camera(width: int = 20, height: int = 12) -> Camera:
    return Camera(width=width, height=height, fx=100.0, fy=110.0, cx=width / 2, cy=height / 2)


def _passes(engine: NativeEngine, width: int, height: int, **wanted: bool) -> tuple[Rendering, Gradients]:
    splats, camera, T_camera_map = scattered(300, width=width, height=height)
    d_rgb, d_depth, d_alpha = image_derivatives(camera)
    rendering = engine.render(splats, camera, T_camera_map)
    return rendering, engine.backward(
        rendering, d_rgb=d_rgb, d_depth=d_depth, d_alpha=d_alpha, want_means=True, **wanted
    )


def _bytes(rendering: Rendering, gradients: Gradients) -> list[bytes]:
    images = [rendering.rgb, rendering.depth_m, rendering.alpha]
    return [a.tobytes() for a in [*images, *(getattr(gradients, name) for name in _FIELDS)]]


@pytest.mark.usefixtures("simd")
def test_one_gaussian_has_the_alpha_of_the_image_model() -> None:
    camera, settings = _camera(), RasterSettings(low_pass_px2=0.3)
    rendering = NativeEngine(settings).render(_one(), camera, np.eye(4))
    opacity = 1.0 / (1.0 + np.exp(-0.5))
    variance_u, variance_v = ((f * np.exp(-4.0) / 2.0) ** 2 + 0.3 for f in (100.0, 110.0))
    columns, rows = np.meshgrid(np.arange(20) + 0.5 - 10.0, np.arange(12) + 0.5 - 6.0)
    alpha = opacity * np.exp(-0.5 * (columns**2 / variance_u + rows**2 / variance_v))
    alpha[alpha < settings.alpha_min] = 0.0
    np.testing.assert_allclose(rendering.alpha, alpha, atol=2e-6)
    np.testing.assert_allclose(rendering.depth_m, 2.0 * alpha, atol=4e-6)
    np.testing.assert_allclose(rendering.rgb, alpha[..., None] * [0.2, 0.4, 0.8], atol=2e-6)


@pytest.mark.usefixtures("simd")
def test_alpha_is_capped_and_a_capped_pixel_moves_the_colour_only() -> None:
    engine = NativeEngine(RasterSettings(alpha_cap=0.9, low_pass_px2=0.3))
    rendering = engine.render(_one(log_radius=6.0, logit=9.0), _camera(), np.eye(4))
    np.testing.assert_allclose(rendering.alpha, 0.9, atol=1e-6)
    ones = np.ones((12, 20), np.float32)
    gradients = engine.backward(rendering, d_rgb=np.ones((12, 20, 3), np.float32), d_depth=ones, want_means=True)
    np.testing.assert_allclose(gradients.colors, 0.9 * 240, rtol=1e-5)
    assert gradients.opacity_logits == 0.0
    assert gradients.log_radii == 0.0
    assert gradients.means_m is not None
    np.testing.assert_allclose(gradients.means_m, [[0.0, 0.0, 0.9 * 240]], rtol=1e-5)


@pytest.mark.usefixtures("simd")
def test_the_splat_that_would_end_a_pixel_is_left_out_with_all_behind_it() -> None:
    # T goes 1, 0.1, 0.01; the third would leave 0.001, below the minimum; the fourth must not slip in behind it.
    logit = float(np.log(9.0))
    splats = Splats(
        means_m=as_floats([[0, 0, z] for z in (3.0, 1.0, 4.0, 2.0)]),
        colors=as_floats(np.eye(4)[:, :3]),
        log_radii=as_floats([6.0] * 4),
        opacity_logits=as_floats([logit, logit, -2.0, logit]),
    )
    engine = NativeEngine(RasterSettings(transmittance_min=0.005))
    rendering = engine.render(splats, _camera(), np.eye(4))
    np.testing.assert_allclose(rendering.alpha, 0.99, atol=1e-5)
    np.testing.assert_allclose(rendering.depth_m, 0.9 * 1.0 + 0.09 * 2.0, rtol=1e-5)
    gradients = engine.backward(rendering, d_rgb=np.ones_like(rendering.rgb), d_depth=np.zeros_like(rendering.depth_m))
    assert (gradients.colors[[0, 2]] == 0.0).all()
    assert (gradients.colors[[1, 3]] > 0.0).all()


@pytest.mark.usefixtures("simd")
def test_equal_depths_are_blended_in_the_order_of_their_indices() -> None:
    count = 3000  # more than one radix pass would need if ties were not kept
    rng = np.random.default_rng(3)
    depths = rng.choice(as_floats(np.linspace(1.0, 4.0, 50)), count)
    splats = Splats(
        means_m=as_floats(np.stack([np.zeros(count), np.zeros(count), depths], -1)),
        colors=as_floats(rng.uniform(size=(count, 3))),
        log_radii=as_floats(np.full(count, 3.0)),
        opacity_logits=as_floats(np.full(count, -5.0)),
    )
    sorted_splats = Splats(
        **{f.name: getattr(splats, f.name)[np.argsort(depths, kind="stable")] for f in dataclasses.fields(Splats)}
    )
    engine, camera = NativeEngine(), _camera()
    given, expected = (engine.render(s, camera, np.eye(4)) for s in (splats, sorted_splats))
    assert given.rgb.tobytes() == expected.rgb.tobytes()


@pytest.mark.usefixtures("simd")
@pytest.mark.parametrize(("width", "height"), [(1, 1), (33, 31), (70, 45)])
def test_bytes_do_not_depend_on_the_number_of_threads(width: int, height: int) -> None:
    one, two, four = (_bytes(*_passes(NativeEngine(threads=n), width, height)) for n in (1, 2, 4))
    assert one == two == four


def test_bytes_do_not_depend_on_threads_with_many_chunks_of_gaussians() -> None:
    splats, camera, T_camera_map = scattered(40_000, width=64, height=48)
    d_rgb, d_depth, _ = image_derivatives(camera)

    def run(threads: int) -> list[bytes]:
        engine = NativeEngine(threads=threads)
        rendering = engine.render(splats, camera, T_camera_map)
        return _bytes(rendering, engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth, want_means=True))

    assert run(1) == run(2) == run(4)


@pytest.mark.parametrize(("width", "height"), [(33, 31), (70, 45)])
def test_instruction_sets_agree(width: int, height: int) -> None:
    before = _native.simd()
    results = []
    for name in _native.available_simd():
        _native.select_simd(name)
        results.append(_passes(NativeEngine(), width, height))
    _native.select_simd(before)
    expected_image, expected = results[0]
    for image, gradients in results[1:]:
        np.testing.assert_allclose(image.rgb, expected_image.rgb, atol=1e-5)
        np.testing.assert_allclose(image.depth_m, expected_image.depth_m, atol=3e-5)
        for name in _FIELDS:
            a, b = getattr(gradients, name), getattr(expected, name)
            assert np.abs(a - b).sum() <= 1e-4 * np.abs(b).sum(), name


@pytest.mark.usefixtures("simd")
def test_leaving_out_gradients_does_not_change_the_others() -> None:
    engine = NativeEngine()
    _, both = _passes(engine, 40, 30)
    _, pose_only = _passes(engine, 40, 30, want_attributes=False)
    splats, camera, T_camera_map = scattered(300, width=40, height=30)
    d_rgb, d_depth, d_alpha = image_derivatives(camera)
    rendering = engine.render(splats, camera, T_camera_map)
    attributes_only = engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth, d_alpha=d_alpha, want_pose=False)
    assert (pose_only.pose == both.pose).all()
    assert not pose_only.colors.any()
    assert not attributes_only.pose.any()
    assert attributes_only.means_m is None
    np.testing.assert_array_equal(attributes_only.colors, both.colors)
    np.testing.assert_allclose(attributes_only.log_radii, both.log_radii, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(attributes_only.opacity_logits, both.opacity_logits)


@pytest.mark.usefixtures("simd")
def test_pose_gradient_equals_the_sum_over_the_moved_means() -> None:
    splats, _, T_camera_map = scattered(300, width=40, height=30)
    _, gradients = _passes(NativeEngine(), 40, 30)
    assert gradients.means_m is not None
    points = splats.means_m @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
    by_point = gradients.means_m.astype(np.float64) @ T_camera_map[:3, :3].T
    expected = np.concatenate([by_point.sum(0), np.cross(points, by_point).sum(0)])
    np.testing.assert_allclose(gradients.pose, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


@pytest.mark.usefixtures("simd")
def test_no_gaussians_give_a_black_image_and_empty_gradients() -> None:
    splats, camera, T_camera_map = scattered(0, width=45, height=33)
    engine = NativeEngine()
    rendering = engine.render(splats, camera, T_camera_map)
    assert not rendering.rgb.any()
    assert not rendering.depth_m.any()
    assert not rendering.alpha.any()
    d_rgb, d_depth, d_alpha = image_derivatives(camera)
    gradients = engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth, d_alpha=d_alpha, want_means=True)
    assert gradients.colors.shape == (0, 3)
    assert gradients.means_m is not None
    assert gradients.means_m.shape == (0, 3)
    assert not gradients.pose.any()


@pytest.mark.usefixtures("simd")
@pytest.mark.parametrize("log_radius", [-50.0, 50.0])
@pytest.mark.parametrize("logit", [-3e38, 3e38])
def test_extreme_radii_and_opacities_stay_finite(log_radius: float, logit: float) -> None:
    engine, camera = NativeEngine(), _camera(40, 35)
    rendering = engine.render(_one(log_radius=log_radius, logit=logit), camera, np.eye(4))
    d_rgb, d_depth, d_alpha = image_derivatives(camera)
    gradients = engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth, d_alpha=d_alpha, want_means=True)
    for array in (rendering.rgb, rendering.alpha, *(getattr(gradients, name) for name in _FIELDS)):
        assert np.isfinite(array).all()
    covers_all = log_radius > 0 and logit > 0
    np.testing.assert_allclose(rendering.alpha.min(), 0.999 if covers_all else 0.0, atol=1e-6)


def test_a_rendering_can_be_pulled_back_after_its_inputs_changed() -> None:
    splats, camera, T_camera_map = scattered(100, width=40, height=30)
    d_rgb, d_depth, _ = image_derivatives(camera)
    engine = NativeEngine()
    rendering = engine.render(splats, camera, T_camera_map)
    before = engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth)
    splats.colors[:] = 0.0
    splats.opacity_logits[:] = 0.0
    rendering.rgb[:] = 0.0
    after = engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth)
    assert before.opacity_logits.tobytes() == after.opacity_logits.tobytes()


def _with(name: str, value: npt.NDArray[Any]) -> Splats:
    splats, _, _ = scattered(6, width=8, height=8)
    return dataclasses.replace(splats, **{name: value})


@pytest.mark.parametrize(
    ("splats", "message"),
    [
        (_with("colors", np.zeros((6, 3))), r"colors must be float32 \[6, 3\], got float64 \[6, 3\]"),
        (_with("colors", np.zeros((5, 3), np.float32)), r"colors must be float32 \[6, 3\], got float32 \[5, 3\]"),
        (_with("means_m", np.zeros((6, 2), np.float32)), r"means_m must be float32 \[6, 3\], got float32 \[6, 2\]"),
        (_with("means_m", np.zeros((3, 6), np.float32).T), "means_m must be C-contiguous"),
        (_with("log_radii", np.zeros((6, 1), np.float32)), "log_radii must be float32"),
        (
            _with("opacity_logits", as_floats([0, 0, 0, np.nan, 0, 0])),
            r"opacity_logits must be finite, got nan at \[3\]",
        ),
        (_with("log_radii", as_floats([0, 0, 0, 0, 51, 0])), r"log_radii must be within -50..50, got 51.0* at \[4\]"),
        (
            _with("means_m", as_floats([[0, 0, 1]] * 5 + [[0, -np.inf, 0]])),
            r"means_m must be finite, got -inf at \[5, 1\]",
        ),
        (_with("colors", as_floats([[0, 0, np.inf]] * 6)), r"colors must be finite, got inf at \[0, 2\]"),
    ],
)
def test_bad_splats_are_refused(splats: Splats, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NativeEngine().render(splats, _camera(), np.eye(4))


def test_bad_poses_are_refused() -> None:
    splats, camera, _ = scattered(6, width=8, height=8)
    with pytest.raises(ValueError, match="T_camera_map must be finite"):
        NativeEngine().render(splats, camera, np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match=r"T_camera_map must be float64 \[4, 4\], got float64 \[3, 4\]"):
        NativeEngine().render(splats, camera, np.eye(4)[:3])


@pytest.mark.usefixtures("simd")
def test_bad_image_derivatives_are_refused() -> None:
    splats, camera, T_camera_map = scattered(6, width=40, height=33)
    engine = NativeEngine()
    rendering = engine.render(splats, camera, T_camera_map)
    d_rgb, d_depth, d_alpha = image_derivatives(camera)
    with pytest.raises(ValueError, match=r"d_depth must be float32 \[33, 40\], got float32 \[40, 33\]"):
        engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth.reshape(40, 33))
    d_alpha[32, 39] = np.inf
    with pytest.raises(ValueError, match=r"d_alpha must be finite, got inf at \[32, 39\]"):
        engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth, d_alpha=d_alpha)
    d_rgb[5, 6, 1] = np.nan
    with pytest.raises(ValueError, match=r"d_rgb must be finite, got -?nan at \[5, 6, 1\]"):
        engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (RasterSettings(low_pass_px2=0.0), "low_pass_px2"),
        (RasterSettings(near_m=0.0), "near_m"),
        (RasterSettings(alpha_cap=1.0), "alpha_cap"),
        (RasterSettings(alpha_min=0.0), "alpha_min"),
        (RasterSettings(transmittance_min=0.0), "transmittance_min"),
    ],
)
def test_settings_out_of_range_are_refused(settings: RasterSettings, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NativeEngine(settings)


def _run_python(code: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    env = {**os.environ, **environment, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)


def test_the_environment_names_the_instruction_set() -> None:
    code = "from vtslam.common.splat import _native; print(_native.simd())"
    assert _run_python(code, VTSLAM_SIMD="portable").stdout.strip() == "portable"
    refused = _run_python(code, VTSLAM_SIMD="sse9")
    assert refused.returncode != 0
    assert "ValueError: instruction set 'sse9' is unknown or missing here" in refused.stderr


def test_the_environment_names_the_number_of_threads() -> None:
    code = "from vtslam.common.splat import _native; print(_native.threads())"
    assert _run_python(code, VTSLAM_THREADS="3").stdout.strip() == "3"
    refused = _run_python(code, VTSLAM_THREADS="many")
    assert "VTSLAM_THREADS must be a whole number from 1 to 256, got 'many'" in refused.stderr


def test_a_forked_child_renders_the_same() -> None:
    code = """
import os, sys
from helpers.native_scene import scattered
from vtslam.common.splat.native_engine import NativeEngine
splats, camera, pose = scattered(300, width=70, height=40)
engine = NativeEngine(threads=2)
expected = engine.render(splats, camera, pose).rgb.tobytes()
child = os.fork()
if child == 0:
    os._exit(0 if engine.render(splats, camera, pose).rgb.tobytes() == expected else 7)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    result = _run_python(code)
    assert result.stdout.strip() == "0", result.stderr

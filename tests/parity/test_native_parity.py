"""The native engine, its fused loss and its optimiser against plain torch, on every instruction set of the machine."""

import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch.optim.adam import adam

from vtslam.common.geometry import se3
from vtslam.common.optim.adam import Adam
from vtslam.common.optim.mapping_loss import mapping_loss
from vtslam.common.splat import _native, parity
from vtslam.common.splat.engine import RasterSettings
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.common.splat.parity_scenes import Scene, crowded_scene, scenes, smooth_scenes
from vtslam.common.splat.reference import ReferenceEngine
from vtslam.common.splat.reference_loss import reference_mapping_loss
from vtslam.common.splat.torch_inputs import SplatTensors

Float32 = npt.NDArray[np.float32]


def _relative_l1(given: Float32, expected: torch.Tensor) -> float:
    reference = expected.detach().numpy()
    return float(np.abs(given - reference).sum() / max(np.abs(reference).sum(), 1e-12))


def test_agrees_with_the_reference(simd: str) -> None:
    best = simd == _native.available_simd()[0]
    report = parity.run_suite(NativeEngine, count=216 if best else 60)
    assert report.failures() == []


def test_agrees_with_the_reference_on_a_crowded_scene(simd: str) -> None:
    scene = crowded_scene(1)
    report = parity.compare(NativeEngine(scene.settings), ReferenceEngine(scene.settings), scene)
    assert report.failures(parity.Tolerances()) == []
    assert report.left_out < 0.1 * report.pixels


def test_pose_gradient_is_that_of_the_engines_own_images(simd: str) -> None:
    """Finite differences of the float32 images themselves, whatever the reference says."""
    scene = next(iter(smooth_scenes(8, 1)))
    engine = NativeEngine(scene.settings)
    d_rgb = np.ones_like(scene.d_rgb)
    d_depth = np.ones_like(scene.d_depth)

    def loss(twist: npt.NDArray[np.float64]) -> float:
        rendering = engine.render(scene.splats, scene.camera, se3.exp(twist) @ scene.T_camera_map)
        return float(rendering.rgb.sum(dtype=np.float64) + rendering.depth_m.sum(dtype=np.float64))

    step = 2e-3
    expected = [(loss(step * axis) - loss(-step * axis)) / (2.0 * step) for axis in np.eye(6)]
    rendering = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    given = engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth).pose
    np.testing.assert_allclose(given, expected, rtol=2e-3, atol=2e-4 * np.abs(expected).max())


def _everything(scene: Scene, threads: int) -> list[bytes]:
    """Bytes of all outputs: images, gradients, loss, a step of Adam."""
    engine = NativeEngine(scene.settings, threads=threads)
    rendering = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    gradients = engine.backward(
        rendering, d_rgb=scene.d_rgb, d_depth=scene.d_depth, d_alpha=scene.d_alpha, want_means=True
    )
    target, target_depth = np.abs(scene.d_rgb) % 1, np.maximum(scene.d_depth, 0)
    loss = mapping_loss(rendering.rgb, rendering.depth_m, target, target_depth, threads=threads)
    colors = scene.splats.colors.copy()
    optimizer = Adam(colors.shape, lr=0.01, threads=threads)
    optimizer.step(colors, gradients.colors)
    assert gradients.means_m is not None
    arrays = [rendering.rgb, rendering.depth_m, rendering.alpha, gradients.colors, gradients.log_radii]
    arrays += [gradients.opacity_logits, gradients.means_m, loss.d_rgb, loss.d_depth, colors, optimizer.m, optimizer.v]
    return [array.tobytes() for array in arrays] + [gradients.pose.tobytes(), np.float64(loss.loss).tobytes()]


@pytest.mark.parametrize("scene", [*scenes(21, 12), crowded_scene(3)], ids=lambda scene: scene.name)
def test_same_bytes_for_any_number_of_threads(simd: str, scene: Scene) -> None:
    one = _everything(scene, 1)
    assert _everything(scene, 2) == one
    assert _everything(scene, 4) == one


@pytest.mark.parametrize("name", ["means_m", "colors", "log_radii", "opacity_logits"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_refuses_splats_that_are_not_finite(simd: str, name: str, value: float) -> None:
    scene = next(scenes(3, 1))
    getattr(scene.splats, name).flat[-1] = value
    with pytest.raises(ValueError, match=f"{name} must be finite"):
        NativeEngine().render(scene.splats, scene.camera, scene.T_camera_map)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_refuses_a_pose_or_derivatives_that_are_not_finite(simd: str, value: float) -> None:
    scene = next(scenes(3, 1))
    engine = NativeEngine(scene.settings)
    pose = scene.T_camera_map.copy()
    pose[1, 3] = value
    with pytest.raises(ValueError, match="T_camera_map must be finite"):
        engine.render(scene.splats, scene.camera, pose)
    rendering = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    for name in ("d_rgb", "d_depth", "d_alpha"):
        derivatives = {key: getattr(scene, key).copy() for key in ("d_rgb", "d_depth", "d_alpha")}
        derivatives[name].flat[0] = value
        with pytest.raises(ValueError, match=name):
            engine.backward(rendering, **derivatives)


def test_refuses_misshapen_splats() -> None:
    scene = next(scenes(3, 1))
    short: Any = {"colors": scene.splats.colors[:-1]}
    double: Any = {"means_m": scene.splats.means_m.astype(np.float64)}
    for wrong in (short, double):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            NativeEngine().render(replace(scene.splats, **wrong), scene.camera, scene.T_camera_map)


def _images(rng: np.random.Generator, height: int, width: int) -> tuple[Float32, Float32, Float32, Float32]:
    """A smooth rendering and target with texture, and depths with holes."""
    base = rng.uniform(0.2, 0.8, (1, 1, 3))
    rgb, target = (base + rng.normal(0.0, 0.1, (height, width, 3)) for _ in range(2))
    depth, target_depth = (rng.uniform(0.5, 3.0, (height, width)) for _ in range(2))
    target_depth[rng.random((height, width)) < 0.3] = 0.0
    return (
        rgb.astype(np.float32),
        depth.astype(np.float32),
        target.astype(np.float32),
        target_depth.astype(np.float32),
    )


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (17, 33), (47, 65)])
@pytest.mark.parametrize("ssim_share", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("masked", [False, True])
def test_mapping_loss_is_that_of_plain_torch(simd: str, size: tuple[int, int], ssim_share: float, masked: bool) -> None:
    rng = np.random.default_rng(6)
    rgb, depth, target, target_depth = _images(rng, *size)
    mask = (rng.random(size) < 0.6).astype(np.uint8) if masked else None
    weights: Any = {"weight_color": 0.7, "weight_depth": 1.3, "ssim_share": ssim_share}
    ours = mapping_loss(rgb, depth, target, target_depth, mask=mask, **weights)

    leaves = [torch.from_numpy(image).double().requires_grad_() for image in (rgb, depth)]
    targets = [torch.from_numpy(image).double() for image in (target, target_depth)]
    chosen = None if mask is None else torch.from_numpy(mask).bool()
    loss = reference_mapping_loss(*leaves, *targets, mask=chosen, **weights)
    d_rgb, d_depth = torch.autograd.grad(loss, leaves, allow_unused=True, materialize_grads=True)
    assert ours.loss == pytest.approx(float(loss.detach()), rel=1e-5, abs=1e-6)
    assert _relative_l1(ours.d_rgb, d_rgb) < 1e-4
    assert _relative_l1(ours.d_depth, d_depth) < 1e-6


def test_adam_is_that_of_torch(simd: str) -> None:
    rng = np.random.default_rng(2)
    parameters = rng.normal(size=(37, 3)).astype(np.float32)
    ours = Adam(parameters.shape, lr=0.02, betas=(0.9, 0.99), eps=1e-8)
    theirs = torch.from_numpy(parameters.copy()).double()
    m, v = torch.zeros_like(theirs), torch.zeros_like(theirs)
    count = torch.tensor(0.0)
    for step in range(50):
        gradients = rng.normal(size=parameters.shape) * 10.0 ** rng.uniform(-6, 2, parameters.shape)
        gradients[step % 37] = 0.0
        ours.step(parameters, gradients.astype(np.float32))
        # As a function: the class loads torch's compiler, which takes seconds.
        adam(
            [theirs],
            [torch.from_numpy(gradients.astype(np.float32)).double()],
            [m],
            [v],
            [],
            [count],
            foreach=False,
            amsgrad=False,
            beta1=0.9,
            beta2=0.99,
            lr=0.02,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )
        np.testing.assert_allclose(parameters, theirs.numpy(), atol=5e-6)
    assert ours.step_count == 50


def test_a_mapping_step_is_that_of_plain_torch(simd: str) -> None:
    """Rendering, loss, derivative and step in a row, on the kind of scene that mapping sees."""
    scene = next(scene for scene in scenes(13, 36) if scene.name == "view-tied-26")
    rng = np.random.default_rng(3)
    size = (scene.camera.height, scene.camera.width)
    target = rng.uniform(0.0, 1.0, (*size, 3)).astype(np.float32)
    target_depth = rng.uniform(1.0, 3.0, size).astype(np.float32)

    engine = NativeEngine(scene.settings)
    rendering = engine.render(scene.splats, scene.camera, scene.T_camera_map)
    loss = mapping_loss(rendering.rgb, rendering.depth_m, target, target_depth)
    gradients = engine.backward(rendering, d_rgb=loss.d_rgb, d_depth=loss.d_depth)

    tensors = SplatTensors.of(scene.splats)
    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    images = ReferenceEngine(scene.settings).render_torch(tensors, scene.camera, scene.T_camera_map, twist)
    expected = reference_mapping_loss(
        images.rgb,
        images.depth_m,
        torch.from_numpy(target).double(),
        torch.from_numpy(target_depth).double(),
        weight_color=1.0,
        weight_depth=1.0,
        ssim_share=0.2,
    )
    leaves = [tensors.colors, tensors.log_radii, tensors.opacity_logits, twist]
    colors, log_radii, opacity_logits, pose = torch.autograd.grad(expected, leaves)
    assert loss.loss == pytest.approx(float(expected.detach()), rel=1e-5)
    assert _relative_l1(gradients.colors, colors) < 1e-4
    assert _relative_l1(gradients.log_radii, log_radii) < 1e-4
    assert _relative_l1(gradients.opacity_logits, opacity_logits) < 1e-4
    assert _relative_l1(gradients.pose.astype(np.float32), pose) < 1e-4


def _simd_in_use(name: str) -> subprocess.CompletedProcess[str]:
    """A fresh process started with `VTSLAM_SIMD`, which prints the instruction set it took."""
    code = "from vtslam.common.splat import _native; print(_native.simd())"
    environment = os.environ | {"VTSLAM_SIMD": name, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)


def test_the_environment_chooses_the_instruction_set() -> None:
    worst = _native.available_simd()[-1]
    assert _simd_in_use(worst).stdout.strip() == worst
    refused = _simd_in_use("mmx")
    assert refused.returncode != 0
    assert "instruction set 'mmx' is unknown or missing here" in refused.stderr


def test_settings_reach_the_kernels() -> None:
    scene = next(scenes(4, 1))
    usual = NativeEngine().render(scene.splats, scene.camera, scene.T_camera_map)
    for name, value in {"low_pass_px2": 0.3, "near_m": 2.0, "alpha_cap": 0.5, "transmittance_min": 0.5}.items():
        other = NativeEngine(RasterSettings(**{name: value}))
        assert not np.array_equal(usual.rgb, other.render(scene.splats, scene.camera, scene.T_camera_map).rgb), name

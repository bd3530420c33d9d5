"""How long rendering takes: one Gaussian per pixel of a smooth depth map, as a head frame of a section has."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from vtslam.common.geometry.camera import Camera
from vtslam.common.optim.mapping_loss import mapping_loss
from vtslam.common.splat import _native
from vtslam.common.splat.engine import RasterSettings, Splats
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.services.bench.comparison import median_ms

_LOW_PASS_PX2, _NEAR_M = 0.3, 0.01
_COTANGENT = 0.001
_STEP_M = (0.02, 0.01, 0.05)  # the camera moves by this after the Gaussians were placed


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatTimes:
    """Medians over the repeats, in milliseconds.

    Attributes:
        forward_ms: One rendering.
        forward_backward_ms: One rendering and all its gradients, those by position and pose included.
        loss_ms: The mapping loss with its image derivatives.
        gaussians: Gaussians of the scene.
        simd: Instruction set.
        threads: Threads.
        width, height: Image, pixels.
        repeats: Measurements behind each median.
    """

    forward_ms: float
    forward_backward_ms: float
    loss_ms: float
    gaussians: int
    simd: str
    threads: int
    width: int
    height: int
    repeats: int


def yardstick_scene(width: int, height: int) -> tuple[Splats, Camera]:
    """A smooth depth map of about 1.2 to 3.8 m, one Gaussian of one pixel and opacity 0.5 at each pixel."""
    focal_px = 0.9 * width
    camera = Camera(width=width, height=height, fx=focal_px, fy=focal_px, cx=0.5 * width, cy=0.5 * height)
    row, column = np.divmod(np.arange(width * height), width)
    ripple = 0.001 * (np.arange(width * height) * 7919 % 13)
    z = 2.5 + 0.8 * np.sin(0.01 * column) + 0.5 * np.cos(0.013 * row) + ripple
    x, y = (column + 0.5 - camera.cx) / focal_px * z, (row + 0.5 - camera.cy) / focal_px * z
    colors = np.stack([0.1 * column % 1.0, 0.1 * row % 1.0, np.full(z.size, 0.5)], axis=1)
    splats = Splats(
        means_m=np.stack([x, y, z], axis=1).astype(np.float32),
        colors=colors.astype(np.float32),
        log_radii=np.log(z / focal_px).astype(np.float32),
        opacity_logits=np.zeros(z.size, np.float32),
    )
    return splats, camera


def bench_splat(size: tuple[int, int], *, threads: int, repeats: int, on_step: Callable[[], None]) -> dict[str, object]:
    """Measure the CPU engine.

    Args:
        size: Width and height, pixels.
        threads: Threads of the engine.
        repeats: Measurements; forward, backward and loss take turns.
        on_step: Called after each.
    """
    splats, camera = yardstick_scene(*size)
    engine = NativeEngine(RasterSettings(low_pass_px2=_LOW_PASS_PX2, near_m=_NEAR_M), threads=threads)
    T_camera_map = np.eye(4)
    T_camera_map[:3, 3] = _STEP_M
    d_depth = np.full((camera.height, camera.width), _COTANGENT, np.float32)
    d_rgb = np.full((camera.height, camera.width, 3), _COTANGENT, np.float32)
    target_rgb, target_depth_m = np.full_like(d_rgb, 0.5), np.full_like(d_depth, 2.5)
    forward, both, loss = [], [], []
    for _ in range(repeats):
        start_s = time.perf_counter()
        rendering = engine.render(splats, camera, T_camera_map)
        rendered_s = time.perf_counter()
        engine.backward(rendering, d_rgb=d_rgb, d_depth=d_depth, want_means=True)
        pulled_back_s = time.perf_counter()
        mapping_loss(rendering.rgb, rendering.depth_m, target_rgb, target_depth_m, threads=threads)
        forward.append(rendered_s - start_s)
        both.append(pulled_back_s - start_s)
        loss.append(time.perf_counter() - pulled_back_s)
        on_step()
    times = SplatTimes(
        forward_ms=median_ms(forward),
        forward_backward_ms=median_ms(both),
        loss_ms=median_ms(loss),
        gaussians=splats.count,
        simd=_native.simd(),
        threads=threads,
        width=camera.width,
        height=camera.height,
        repeats=repeats,
    )
    return asdict(times)

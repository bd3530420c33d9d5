"""What a view saw, against the definition written out point by point."""

import math

import numpy as np
import numpy.typing as npt
from hypothesis import given
from hypothesis import strategies as st

from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.overlap.selection import seen_by_view

UNIT_M = 0.001
twists = st.lists(st.floats(-0.6, 0.6), min_size=6, max_size=6).map(np.array)


def bilinear(depth: npt.NDArray[np.uint16], x: float, y: float) -> float:
    """At integer-centred coordinates; zero outside."""
    height, width = depth.shape
    total = 0.0
    for row, column in ((r, c) for r in (math.floor(y), math.floor(y) + 1) for c in (math.floor(x), math.floor(x) + 1)):
        if 0 <= row < height and 0 <= column < width:
            total += (1.0 - abs(x - column)) * (1.0 - abs(y - row)) * float(depth[row, column])
    return total


def margin(
    point: npt.NDArray[np.float64],
    T_world_view: npt.NDArray[np.float64],
    depth: npt.NDArray[np.uint16],
    camera: Camera,
    tolerance: float,
    border_px: float,
) -> float:
    """Positive if the view saw the point, negative if not; the smaller, the less clear."""
    x, y, z = np.linalg.inv(T_world_view)[:3] @ np.array([*point, 1.0])
    if z <= 0.0:
        return -1.0 if z < -1e-6 else -1e-9
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = min(u - border_px, v - border_px, camera.width - border_px - u, camera.height - border_px - v)
    if inside < 0:
        return float(inside)
    measured = bilinear(depth, u - 0.5, v - 0.5) * UNIT_M
    return float(min(inside, tolerance - abs(measured - z) / max(min(measured, z), 1e-12)))


@given(
    twist=twists,
    seed=st.integers(0, 2**32 - 1),
    tolerance=st.floats(0.005, 0.5),
    border_px=st.floats(0.0, 8.0),
    width=st.integers(1, 30),
    height=st.integers(1, 30),
)
def test_seen_by_view_is_its_definition(
    twist: npt.NDArray[np.float64], seed: int, tolerance: float, border_px: float, width: int, height: int
) -> None:
    rng = np.random.default_rng(seed)
    camera = Camera(width=width, height=height, fx=0.8 * width, fy=0.9 * width, cx=0.5 * width, cy=0.45 * height)
    # A smooth surface with holes: where depth varies strongly within a pixel, sampling is a matter of rounding.
    slope_u, slope_v = rng.uniform(-0.4, 0.4, 2)
    surface = 2.0 + slope_u * np.arange(width) / width + slope_v * np.arange(height)[:, None] / height
    depth = np.asarray(np.where(rng.random((height, width)) < 0.1, 0.0, surface / UNIT_M), np.uint16)
    T_world_view = se3.exp(twist)
    local = rng.uniform([-1.5, -1.5, -0.5], [1.5, 1.5, 4.0], (60, 3))
    local[:30, 2] = rng.uniform(1.8, 2.4, 30)
    points = local @ T_world_view[:3, :3].T + T_world_view[:3, 3]
    found = seen_by_view(
        points,
        T_world_view=T_world_view,
        view_depth=depth,
        depth_scale_m=UNIT_M,
        camera=camera,
        tolerance=tolerance,
        border_px=border_px,
    )
    margins = np.array([margin(p, T_world_view, depth, camera, tolerance, border_px) for p in points])
    # Samples are taken at 1/32 of a pixel; beside a hole that is 1/32 of the whole depth.
    clear = np.abs(margins) > 0.04
    np.testing.assert_array_equal(found[clear], margins[clear] > 0)
    assert clear.any()

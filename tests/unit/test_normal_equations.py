"""The normal equations of dense alignment: against numerical derivatives, and what counts in them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers.aligned_room import CAMERA, START, Array, motion, observed_of, reference_of, with_mask
from helpers.smooth_room import SmoothRoom

from vtslam.common.geometry import se3
from vtslam.common.optim import _align
from vtslam.common.optim.alignment import Observed, Reference, observed_frame

INTRINSICS = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)


@dataclass(frozen=True, slots=True, kw_only=True)
class Equations:
    H: Array
    g: Array
    color_cost: float
    depth_cost: float
    color_count: int
    depth_count: int

    @property
    def cost(self) -> float:
        return self.color_cost + self.depth_cost


def equations(
    reference: Reference,
    observed: Observed,
    T: Array,
    *,
    color_weight: float = 1.0,
    depth_weight: float = 1.0,
    gate_sigmas: float = 100.0,
    color_sigma: float = 0.03,
    threads: int = 1,
) -> Equations:
    """The kernel at the finest level."""
    options = _align.AlignmentOptions(
        color_sigma=color_sigma,
        color_weight=color_weight,
        depth_sigma_base=0.002,
        depth_sigma_quadratic=0.0015,
        depth_weight=depth_weight,
        depth_gate_sigmas=gate_sigmas,
        border_px=1.0,
    )
    level = reference.levels[0]
    H, g, color_cost, depth_cost, color_count, depth_count = _align.normal_equations(
        level.rgb,
        level.depth_m,
        level.mask,
        observed.levels[0].packed,
        INTRINSICS,
        reference.points,
        observed.depth_m,
        INTRINSICS,
        np.ascontiguousarray(T),
        options,
        threads,
    )
    return Equations(
        H=H, g=g, color_cost=color_cost, depth_cost=depth_cost, color_count=color_count, depth_count=depth_count
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("color_weight", "depth_weight"), [(1.0, 0.0), (0.0, 1.0), (0.7, 1.3)])
def test_gradient_is_the_derivative_of_the_robust_cost(seed: int, color_weight: float, depth_weight: float) -> None:
    room = SmoothRoom(seed=seed)
    reference = reference_of(room, margin=6)
    # Large enough that some residuals are in the linear part of the Huber cost, and some are not.
    observed = observed_of(room, START @ motion(seed, metres=0.02, degrees=1.0))

    def at(T: Array) -> Equations:
        return equations(reference, observed, T, color_weight=color_weight, depth_weight=depth_weight)

    here = at(np.eye(4))
    numeric = np.zeros(6)
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 2e-4
        numeric[axis] = (at(se3.exp(step)).cost - at(se3.exp(-step)).cost) / 4e-4
    counts = [count for count, weight in ((here.color_count, color_weight), (here.depth_count, depth_weight)) if weight]
    assert min(counts) > 1500
    assert np.linalg.norm(here.g - numeric) < 0.04 * np.linalg.norm(numeric)
    for part in (slice(0, 3), slice(3, 6)):
        assert np.linalg.norm(here.g[part] - numeric[part]) < 0.05 * np.linalg.norm(numeric[part])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("color_weight", "depth_weight"), [(1.0, 0.0), (0.0, 1.0), (0.7, 1.3)])
def test_information_is_the_curvature_of_the_cost_at_its_minimum(
    seed: int, color_weight: float, depth_weight: float
) -> None:
    room = SmoothRoom(seed=seed)
    true = motion(seed + 10, metres=0.01, degrees=0.5)
    reference, observed = reference_of(room, margin=6), observed_of(room, START @ true)
    T = se3.inverse(true)

    def at(step: Array) -> Equations:
        # A wide colour scale keeps all residuals of this test in the quadratic part.
        return equations(
            reference,
            observed,
            se3.exp(step) @ T,
            color_weight=color_weight,
            depth_weight=depth_weight,
            color_sigma=0.1,
        )

    here = at(np.zeros(6))
    np.testing.assert_array_equal(here.H, here.H.T)
    steps = np.random.default_rng(seed).normal(size=(12, 6)) * np.array([2e-3] * 3 + [1e-3] * 3)
    curvature = np.array([at(step).cost + at(-step).cost - 2.0 * here.cost for step in steps])
    expected = np.einsum("ni,ij,nj->n", steps, here.H, steps)
    # Along the surface the nearest pixel changes while the distance to the plane hardly does.
    np.testing.assert_allclose(curvature, expected, rtol=0.15)
    assert curvature.sum() == pytest.approx(expected.sum(), rel=0.03)


def test_robust_weight_falls_with_the_inverse_of_the_residual() -> None:
    room = SmoothRoom(seed=1)
    observed = observed_of(room, START)
    reference = reference_of(room)
    plain = equations(reference, observed, np.eye(4), depth_weight=0.0)
    level = reference.levels[0]
    shifted = replace(reference, levels=[replace(level, rgb=level.rgb - np.float32(4 * 0.03))])
    robust = equations(shifted, observed, np.eye(4), depth_weight=0.0)
    np.testing.assert_allclose(robust.H, plain.H / 4.0, rtol=1e-4, atol=1e-5 * np.abs(plain.H).max())
    assert robust.color_cost == pytest.approx(plain.color_cost + 3 * plain.color_count * (4.0 - 0.5), rel=1e-4)


@pytest.mark.parametrize("threads", [2, 3, 4, 16, 50])
def test_threads_do_not_change_a_byte(threads: int) -> None:
    room = SmoothRoom(seed=2)
    reference, observed = reference_of(room), observed_of(room, START)
    T = motion(3, metres=0.02, degrees=2.0)
    one, many = equations(reference, observed, T), equations(reference, observed, T, threads=threads)
    assert one.H.tobytes() == many.H.tobytes()
    assert one.g.tobytes() == many.g.tobytes()
    assert (one.cost, one.color_count, one.depth_count) == (many.cost, many.color_count, many.depth_count)


def test_colour_pixels_outside_the_mask_do_not_count() -> None:
    room = SmoothRoom(seed=3)
    reference, observed = reference_of(room), observed_of(room, START)
    T = motion(1, metres=0.01, degrees=1.0)
    left = np.zeros_like(reference.levels[0].mask)
    left[:, :30] = 1
    masks = (left, (1 - left).astype(np.uint8))
    everything = equations(reference, observed, T, depth_weight=0.0)
    parts = [equations(with_mask(reference, mask), observed, T, depth_weight=0.0) for mask in masks]
    assert all(part.color_count > 500 for part in parts)
    assert sum(part.color_count for part in parts) == everything.color_count
    np.testing.assert_allclose(parts[0].H + parts[1].H, everything.H, rtol=1e-6)
    np.testing.assert_allclose(parts[0].g + parts[1].g, everything.g, rtol=1e-5)


def test_points_add_up() -> None:
    room = SmoothRoom(seed=3)
    reference, observed = reference_of(room), observed_of(room, START)
    T = motion(1, metres=0.01, degrees=1.0)
    everything = equations(reference, observed, T, color_weight=0.0)
    halves = (reference.points[::2].copy(), reference.points[1::2].copy())
    parts = [equations(replace(reference, points=half), observed, T, color_weight=0.0) for half in halves]
    assert all(part.depth_count > 500 for part in parts)
    assert sum(part.depth_count for part in parts) == everything.depth_count
    np.testing.assert_allclose(parts[0].H + parts[1].H, everything.H, rtol=1e-6)
    np.testing.assert_allclose(parts[0].g + parts[1].g, everything.g, rtol=1e-5)


def test_pixels_of_the_frame_without_depth_do_not_count() -> None:
    room = SmoothRoom(seed=3)
    reference = reference_of(room)
    rgb, depth_m = room.view(START, CAMERA)
    depth_m[:, 30:] = 0.0
    found = equations(reference, observed_frame(rgb, depth_m, CAMERA, 1), np.eye(4))
    left = np.zeros_like(reference.levels[0].mask)
    left[:, :30] = 1
    inside = CAMERA.projected(reference.points[:, :3])[:, 0] < 30
    expected = equations(
        replace(with_mask(reference, left), points=reference.points[inside]), observed_of(room, START), np.eye(4)
    )
    assert (found.color_count, found.depth_count) == (expected.color_count, expected.depth_count)
    assert found.color_count > 500
    np.testing.assert_allclose(found.H, expected.H, rtol=1e-5)


def test_a_surface_that_only_the_frame_sees_is_gated() -> None:
    room = SmoothRoom(seed=4)
    reference = reference_of(room)
    rgb, depth_m = room.view(START, CAMERA)
    depth_m[10:20, 20:40] -= 0.4  # something stands in front
    occluded = equations(reference, observed_frame(rgb, depth_m, CAMERA, 1), np.eye(4), gate_sigmas=10.0)
    depth_m[10:20, 20:40] = 0.0
    without = equations(reference, observed_frame(rgb, depth_m, CAMERA, 1), np.eye(4), gate_sigmas=10.0)
    free = equations(reference, observed_of(room, START), np.eye(4), gate_sigmas=10.0)
    assert (occluded.color_count, occluded.depth_count) == (without.color_count, without.depth_count)
    assert (free.color_count - occluded.color_count, free.depth_count - occluded.depth_count) == (200, 200)
    np.testing.assert_allclose(occluded.H, without.H, rtol=1e-9)


@pytest.mark.parametrize("empty", ["reference", "frame", "behind"])
def test_nothing_in_common_gives_zero_equations(empty: str) -> None:
    room = SmoothRoom(seed=5)
    reference, observed = reference_of(room), observed_of(room, START)
    T = np.eye(4)
    if empty == "reference":
        none = np.zeros_like(reference.levels[0].mask)
        reference = replace(with_mask(reference, none), points=np.zeros((0, 6), np.float32))
    elif empty == "frame":
        rgb, depth_m = room.view(START, CAMERA)
        observed = observed_frame(rgb, np.zeros_like(depth_m), CAMERA, 1)
    else:
        T[2, 3] = -50.0
    found = equations(reference, observed, T)
    assert (found.color_count, found.depth_count, found.cost) == (0, 0, 0.0)
    assert not found.H.any()
    assert not found.g.any()


def test_misshapen_arrays_are_refused() -> None:
    room = SmoothRoom()
    reference, observed = reference_of(room), observed_of(room, START)
    with pytest.raises(ValueError, match="mask: wrong shape"):
        equations(with_mask(reference, np.ones((3, 3), np.uint8)), observed, np.eye(4))
    with pytest.raises(ValueError, match="points: wrong shape"):
        equations(replace(reference, points=np.zeros((5, 3), np.float32)), observed, np.eye(4))

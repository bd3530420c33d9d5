"""Dense alignment: its normal equations against numerical derivatives, and the motions it recovers."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.geometry import se3
from vtslam.common.optim import _align
from vtslam.common.optim.alignment import Alignment, Observed, Reference, align, observed_frame, reference_view
from vtslam.common.optim.surface import normals_from_depth
from vtslam.common.settings import GaussNewtonSettings
from vtslam.common.splat.engine import Rendering

Array = npt.NDArray[np.float64]

CAMERA = small_camera()
INTRINSICS = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
SETTINGS = GaussNewtonSettings(
    levels=3, iterations=10, color_sigma=0.03, depth_sigma_base_m=0.002, depth_sigma_per_m=0.0015
)
START = se3.exp(np.array([0.2, -0.1, 0.3, 0.1, 0.4, -0.2]))


def motion(seed: int, *, metres: float, degrees: float) -> Array:
    """A motion of this length and angle in random directions."""
    rng = np.random.default_rng(seed)
    rho, phi = rng.normal(size=3), rng.normal(size=3)
    return se3.exp(
        np.concatenate([rho * metres / np.linalg.norm(rho), phi * np.radians(degrees) / np.linalg.norm(phi)])
    )


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


def reference_of(room: SmoothRoom, *, levels: int = 1, margin: int = 0) -> Reference:
    """The room from START, with a point at every pixel; a margin keeps what is warped away from the image's border."""
    rendering = room.rendering(START, CAMERA)
    points = CAMERA.back_projected(rendering.depth_m)
    normals = room.normals(points @ START[:3, :3].T + START[:3, 3]) @ START[:3, :3]
    inner = np.ones(rendering.alpha.shape, np.bool_)
    if margin:
        inner[:margin], inner[-margin:], inner[:, :margin], inner[:, -margin:] = False, False, False, False
    rendering = replace(rendering, alpha=np.where(inner, rendering.alpha, np.float32(0)))
    surface = np.concatenate([points, normals], axis=-1).reshape(-1, 6).astype(np.float32)
    return reference_view(rendering, CAMERA, np.eye(4), surface=surface, levels=levels, silhouette_threshold=0.9)


def observed_of(room: SmoothRoom, T_world_camera: Array, *, levels: int = 1) -> Observed:
    return observed_frame(*room.view(T_world_camera, CAMERA), CAMERA, levels)


def with_mask(reference: Reference, mask: npt.NDArray[np.uint8]) -> Reference:
    return replace(reference, levels=[replace(reference.levels[0], mask=mask)])


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


def test_a_view_shows_the_points_that_are_as_deep_as_it_was_rendered() -> None:
    room = SmoothRoom()
    rendering = room.rendering(START, CAMERA)
    pixels = CAMERA.back_projected(rendering.depth_m).reshape(-1, 3)
    towards = np.tile(np.array([0, 0, -1], np.float32), (len(pixels), 1))
    T_camera_map = motion(3, metres=0.5, degrees=20.0)
    to_map = se3.inverse(T_camera_map)

    def shown(points_camera: npt.NDArray[np.float32], seen: Rendering = rendering) -> npt.NDArray[np.float32]:
        points = points_camera @ to_map[:3, :3].T + to_map[:3, 3]
        surface = np.concatenate([points, towards @ to_map[:3, :3].T], axis=1).astype(np.float32)
        return reference_view(seen, CAMERA, T_camera_map, surface=surface, levels=1, silhouette_threshold=0.9).points

    points = shown(pixels)
    assert points.shape == (len(pixels), 6)
    np.testing.assert_allclose(points[:, :3], pixels, atol=1e-5)
    np.testing.assert_allclose(points[:, 3:], towards, atol=1e-5)
    assert len(shown(pixels * np.float32(1.2))) == 0  # behind what the view shows
    assert len(shown(pixels * np.float32(0.8))) == 0
    assert len(shown(-pixels)) == 0
    bare = replace(rendering, alpha=np.where(np.arange(CAMERA.width) < 10, rendering.alpha, np.float32(0)))
    assert len(shown(pixels, bare)) == 10 * CAMERA.height


def test_normals_are_those_of_the_surface_on_both_sides_of_a_step() -> None:
    camera = small_camera(128, 96)
    room = SmoothRoom()
    _, depth_m = room.view(START, camera)
    true = room.normals(camera.back_projected(depth_m) @ START[:3, :3].T + START[:3, 3]) @ START[:3, :3]
    depth_m[:, 80:] *= 1.3  # nearer surface and farther surface, each as it was
    normals = normals_from_depth(depth_m, camera)
    lengths = np.linalg.norm(normals, axis=-1)
    known = lengths > 0
    assert known[8:-8, 8:-8].mean() > 0.9
    np.testing.assert_allclose(lengths[known], 1.0, atol=1e-5)
    left = known & (np.arange(camera.width) < 80)
    assert np.abs((normals * true).sum(-1))[left].min() > 0.99
    # All of one surface face the same way.
    assert len(np.unique(np.sign((normals * camera.pixel_rays()).sum(-1))[left])) == 1


def test_pixels_without_surface_around_them_have_no_normal() -> None:
    depth_m = np.zeros((48, 64), np.float32)
    depth_m[20, 30] = 2.0
    assert not normals_from_depth(depth_m, CAMERA).any()
    depth_m[20, :] = 2.0  # a line has no normal either
    assert not normals_from_depth(depth_m, CAMERA).any()
    depth_m[:] = 2.0
    depth_m[10, 12] = 0.0
    normals = normals_from_depth(depth_m, CAMERA)
    assert not normals[10, 12].any()
    np.testing.assert_allclose(np.abs(normals[20:40, 20:40]), np.broadcast_to([0, 0, 1], (20, 20, 3)), atol=1e-6)


def aligned(
    room: SmoothRoom,
    true: Array,
    *,
    prior: tuple[Array, Array] | None = None,
    threads: int = 1,
    coarsest: int = 2,
    settings: GaussNewtonSettings = SETTINGS,
) -> Alignment:
    return align(
        reference_of(room, levels=coarsest + 1),
        observed_of(room, START @ true, levels=coarsest + 1),
        settings,
        T_observed_reference=np.eye(4),
        prior=prior,
        coarsest=coarsest,
        threads=threads,
    )


def error_of(found: Alignment, true: Array) -> tuple[float, float]:
    error = found.T_observed_reference @ true
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(se3.angle_rad(error)))


@pytest.mark.parametrize("seed", range(6))
def test_hand_held_motions_are_recovered(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = motion(seed, metres=float(rng.uniform(0.01, 0.03)), degrees=float(rng.uniform(1.0, 3.0)))
    found = aligned(SmoothRoom(seed=seed), true)
    metres, degrees = error_of(found, true)
    assert found.solved
    assert metres < 0.0005
    assert degrees < 0.02
    assert np.linalg.eigvalsh(found.information).min() > 0


@pytest.mark.parametrize(("color_weight", "depth_weight"), [(1.0, 0.0), (1.0, 1.0)])
def test_each_term_is_enough_where_it_sees_the_motion(color_weight: float, depth_weight: float) -> None:
    true = motion(11, metres=0.02, degrees=1.5)
    settings = replace(SETTINGS, color_weight=color_weight, depth_weight=depth_weight)
    metres, degrees = error_of(aligned(SmoothRoom(seed=7), true, settings=settings), true)
    assert metres < 0.002
    assert degrees < 0.05


def test_alignment_does_not_depend_on_threads() -> None:
    true = motion(12, metres=0.02, degrees=2.0)
    one, four = aligned(SmoothRoom(seed=8), true), aligned(SmoothRoom(seed=8), true, threads=4)
    assert one.T_observed_reference.tobytes() == four.T_observed_reference.tobytes()
    assert one.information.tobytes() == four.information.tobytes()


@pytest.mark.parametrize("information", [1e-6, 1e12])
def test_a_prior_pulls_as_its_information_says(information: float) -> None:
    room, true = SmoothRoom(seed=9), motion(13, metres=0.02, degrees=1.5)
    wrong = motion(14, metres=0.03, degrees=1.0)
    found = aligned(room, true, prior=(wrong, information * np.eye(6)))
    if information < 1.0:
        free = aligned(room, true)
        np.testing.assert_allclose(found.T_observed_reference, free.T_observed_reference, atol=1e-6)
    else:
        np.testing.assert_allclose(found.T_observed_reference, wrong, atol=1e-6)
    assert found.solved


def test_a_prior_on_one_direction_leaves_the_others_free() -> None:
    room, true = SmoothRoom(seed=9), motion(13, metres=0.02, degrees=1.5)
    free = aligned(room, true).T_observed_reference
    offset = np.array([0.01, 0, 0, 0, 0, 0])
    information = np.zeros((6, 6))
    information[0, 0] = 1e10
    found = aligned(room, true, prior=(se3.exp(offset) @ free, information)).T_observed_reference
    error = se3.log(found @ se3.inverse(se3.exp(offset) @ free))
    assert abs(error[0]) < 1e-5
    assert np.linalg.norm(error[1:]) > 1e-4


def test_a_prior_between_two_estimates_lands_between_them() -> None:
    room, true = SmoothRoom(seed=9), motion(13, metres=0.02, degrees=1.5)
    free = aligned(room, true)
    offset = np.array([0.002, -0.001, 0.0015, 0.0005, 0.001, -0.0005])
    # As sure as the images, and 2 mm away: the answer lies half way.
    prior = (se3.exp(offset) @ free.T_observed_reference, free.information)
    found = aligned(room, true, prior=prior).T_observed_reference
    half = se3.log(found @ se3.inverse(free.T_observed_reference))
    assert half == pytest.approx(0.5 * offset, abs=0.15 * float(np.abs(offset).max()))


def test_too_few_measurements_are_called_unsolved_and_keep_the_guess() -> None:
    room = SmoothRoom()
    reference = reference_of(room)
    mask = np.zeros_like(reference.levels[0].mask)
    mask[20, 20:30] = 1
    few = replace(with_mask(reference, mask), points=reference.points[:10])
    guess = motion(1, metres=0.001, degrees=0.1)
    found = align(few, observed_of(room, START), SETTINGS, T_observed_reference=guess, coarsest=0)
    assert not found.solved
    np.testing.assert_array_equal(found.T_observed_reference, guess)


def test_a_flat_grey_wall_does_not_break_the_solver() -> None:
    rgb, depth_m = np.full((48, 64, 3), 0.5, np.float32), np.full((48, 64), 2.0, np.float32)
    reference = reference_view(
        Rendering(rgb=rgb, depth_m=depth_m, alpha=np.ones_like(depth_m), saved=None),
        CAMERA,
        np.eye(4),
        surface=np.concatenate([CAMERA.back_projected(depth_m), normals_from_depth(depth_m, CAMERA)], -1).reshape(
            -1, 6
        ),
        levels=1,
        silhouette_threshold=0.9,
    )
    observed = observed_frame(rgb, depth_m - np.float32(0.01), CAMERA, 1)
    found = align(reference, observed, SETTINGS, T_observed_reference=np.eye(4), coarsest=0)
    assert np.isfinite(found.T_observed_reference).all()
    np.testing.assert_allclose(found.T_observed_reference[:3, 3], [0, 0, -0.01], atol=1e-4)


def test_pyramids_halve_images_and_camera_and_drop_uncertain_pixels() -> None:
    rng = np.random.default_rng(0)
    camera = small_camera(13, 9)
    rgb = rng.random((9, 13, 3)).astype(np.float32)
    depth_m = np.full((9, 13), 2.0, np.float32)
    depth_m[0, 0] = 0.0  # a hole
    depth_m[2:4, 2] = 3.0  # a step
    alpha = np.ones((9, 13), np.float32)
    alpha[4, 4] = 0.2
    observed = observed_frame(rgb, depth_m, camera, 2)
    np.testing.assert_array_equal(observed.depth_m, depth_m)
    coarse = observed.levels[1]
    assert (coarse.camera.width, coarse.camera.height, coarse.packed.shape) == (6, 4, (4, 6, 10))
    assert (coarse.camera.fx, coarse.camera.cy) == (camera.fx / 2, camera.cy / 2)
    np.testing.assert_allclose(coarse.packed[1, 2, :3], rgb[2:4, 4:6].mean(axis=(0, 1)), rtol=1e-6)
    expected = np.full((4, 6), 2.0)
    expected[0, 0], expected[1, 1] = 0.0, 0.0
    np.testing.assert_array_equal(coarse.packed[..., 9], expected)
    fine, half = levels_of(rgb * alpha[..., None], depth_m * alpha, alpha, levels=2).levels
    assert fine.mask[4, 4] == 0
    assert fine.mask.sum() == 9 * 13 - 1
    assert half.mask[2, 2] == 0
    assert half.mask.sum() == 23


def levels_of(
    rgb: npt.NDArray[np.float32], depth_m: npt.NDArray[np.float32], alpha: npt.NDArray[np.float32], *, levels: int
) -> Reference:
    return reference_view(
        Rendering(rgb=rgb, depth_m=depth_m, alpha=alpha, saved=None),
        small_camera(alpha.shape[1], alpha.shape[0]),
        np.eye(4),
        surface=np.zeros((0, 6), np.float32),
        levels=levels,
        silhouette_threshold=0.5,
    )


def test_a_half_covered_view_is_divided_by_its_silhouette() -> None:
    rgb, depth_m = np.full((9, 13, 3), 0.6, np.float32), np.full((9, 13), 2.0, np.float32)
    alpha = np.full((9, 13), 0.8, np.float32)
    level = levels_of(rgb * alpha[..., None], depth_m * alpha, alpha, levels=1).levels[0]
    np.testing.assert_allclose(level.rgb, rgb, rtol=1e-6)
    np.testing.assert_allclose(level.depth_m, depth_m, rtol=1e-6)


def test_image_gradients_are_per_pixel() -> None:
    v, u = np.mgrid[0:9, 0:13].astype(np.float32)
    rgb = np.stack([0.01 * u, 0.02 * v, 0.03 * u - 0.01 * v], axis=-1)
    observed = observed_frame(rgb, np.ones((9, 13), np.float32), small_camera(13, 9), 1)
    packed = observed.levels[0].packed[1:-1, 1:-1]
    np.testing.assert_allclose(packed[..., 3:6], np.broadcast_to([0.01, 0.0, 0.03], (7, 11, 3)), atol=1e-6)
    np.testing.assert_allclose(packed[..., 6:9], np.broadcast_to([0.0, 0.02, -0.01], (7, 11, 3)), atol=1e-6)

"""Dense alignment: the motions it recovers, what a prior does, and what a view and a frame are made into for it."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.aligned_room import CAMERA, START, Array, motion, observed_of, reference_of, with_mask
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.geometry import se3
from vtslam.common.optim.alignment import Alignment, Reference, align, observed_frame, reference_view
from vtslam.common.optim.surface import normals_from_depth
from vtslam.common.settings import GaussNewtonSettings
from vtslam.common.splat.engine import Rendering

INTRINSICS = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
SETTINGS = GaussNewtonSettings(
    levels=3, iterations=10, color_sigma=0.03, depth_sigma_base_m=0.002, depth_sigma_per_m=0.0015
)


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
    finest: int = 0,
    settings: GaussNewtonSettings = SETTINGS,
) -> Alignment:
    return align(
        reference_of(room, levels=coarsest + 1),
        observed_of(room, START @ true, levels=coarsest + 1),
        settings,
        T_observed_reference=np.eye(4),
        prior=prior,
        coarsest=coarsest,
        finest=finest,
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


def test_alignment_ends_at_the_finest_level_asked_for() -> None:
    room, true = SmoothRoom(seed=7), motion(11, metres=0.02, degrees=2.0)
    found = {finest: aligned(room, true, finest=finest) for finest in (0, 1, 2, 5)}
    assert found[2].T_observed_reference.tobytes() == found[5].T_observed_reference.tobytes()
    assert len({alignment.T_observed_reference.tobytes() for alignment in found.values()}) == 3
    assert error_of(found[0], true)[0] < error_of(found[2], true)[0] < 0.02


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

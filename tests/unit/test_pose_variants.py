"""Ways to estimate a pose that the bench compares: each finds a known pose, and its parts are what they say."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pytest
from helpers.aligned_room import CAMERA, START, motion, observed_of, reference_of
from helpers.small_map import mapped_section, pose_error, room_frame, room_pose, room_section, small_mapper
from helpers.smooth_room import SmoothRoom

from vtslam.common.geometry import se3
from vtslam.common.optim.alignment import linearised, observed_frame
from vtslam.common.settings import GaussNewtonSettings, MapperSettings, TrackerSettings
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.services.bench.pose_variants.gaussian_pyramid import GaussianPyramids, merged_splats
from vtslam.services.bench.pose_variants.gicp import Distributions, depth_distributions, gicp_system
from vtslam.services.bench.pose_variants.inverse import FixedColors, FixedPlanes
from vtslam.services.bench.pose_variants.product import OpenCvOfView
from vtslam.services.bench.pose_variants.rounds import damped_step, left_step
from vtslam.services.bench.pose_variants.table import Variant, pose_variants
from vtslam.services.bench.pose_variants.task import PoseTask
from vtslam.services.bench.pose_variants.through_splat import splat_system

SETTINGS = GaussNewtonSettings()
STEP = motion(5, metres=0.02, degrees=1.0)
ROOM = SmoothRoom(seed=3)
# Rendered depth leans towards the camera on slanted surfaces, and colours alone need sharp ones: these are tried on
# what the map shows from the true pose.
ON_RENDERED_FRAME = ("color_only", "splat", "splat_pyramid", "adam_40", "adam_200")


def pose(step: float) -> npt.NDArray[np.float64]:
    return se3.exp(step * np.array([0.015, -0.01, 0.012, 0.01, 0.02, -0.008]))


@lru_cache(maxsize=1)
def seen_by_sensor() -> PoseTask:
    frames = [ROOM.frame(pose(k), CAMERA, frame_id=k) for k in range(4)]
    mapper = small_mapper(MapperSettings(iterations_head=6, iterations_regular=2, initial_opacity=0.9))
    section = mapper.map_head(frames[0], pose(0), section_id=0, neighbours=[])[0].section
    return PoseTask(
        frame=frames[3],
        rgb=frames[3].rgb_float(),
        mask=(frames[3].depth > 0).astype(np.uint8),
        section=section,
        previous=frames[2],
        T_section_previous=pose(2),
    )


@lru_cache(maxsize=2)
def seen_by_map(divided: bool) -> PoseTask:
    """The same frame as the map shows it from its true pose, where it is covered; divided by the silhouette or not."""
    task = seen_by_sensor()
    view = NativeEngine(threads=1).render(task.section.splats, CAMERA, se3.inverse(pose(3)))
    factor = 1.0 / np.maximum(view.alpha, 0.5) if divided else np.ones_like(view.alpha)
    units = np.rint(view.depth_m * factor / task.frame.depth_scale_m).astype(np.uint16)
    depth = np.where(view.alpha > 0.99, units, np.uint16(0))
    return replace(
        task,
        frame=replace(task.frame, depth=depth),
        rgb=(view.rgb * factor[..., None]).astype(np.float32),
        mask=(depth > 0).astype(np.uint8),
    )


def variants() -> list[Variant]:
    return pose_variants(NativeEngine(threads=1), TrackerSettings(gauss_newton=SETTINGS), threads=1)


@pytest.mark.parametrize("name", [variant.name for variant in variants() if variant.name != "opencv_view"])
def test_each_finds_a_known_pose(name: str) -> None:
    variant = next(v for v in variants() if v.name == name)
    task = seen_by_map(not name.startswith("adam")) if name in ON_RENDERED_FRAME else seen_by_sensor()
    found = variant.solver.solve(task, STEP @ se3.inverse(pose(3)))
    metres, degrees = pose_error(se3.inverse(found.T_camera_section), pose(3))
    assert metres < 0.008  # of 0.02 m and 1 degree; the map is of three small frames
    assert degrees < 0.4
    assert found.full_size_renders <= found.renders


def test_odometry_of_a_view_turns_it_to_the_frame() -> None:
    frame, section = room_frame(3), room_section(0, 3)  # it needs sharper edges than the smooth room's
    true = section.T_section_camera(room_pose(3))
    sharp = replace(seen_by_sensor(), frame=frame, rgb=frame.rgb_float(), section=section)
    found = OpenCvOfView(engine=NativeEngine(threads=1)).solve(sharp, STEP @ se3.inverse(true))
    metres, degrees = pose_error(se3.inverse(found.T_camera_section), true)
    assert metres < 0.018  # of 0.020: rendered depth leans by that much in so small an image
    assert degrees < 0.2  # of 1.0
    nothing = replace(sharp, frame=replace(frame, depth=np.zeros_like(frame.depth)))
    kept = OpenCvOfView(engine=NativeEngine(threads=1)).solve(nothing, STEP)
    np.testing.assert_array_equal(kept.T_camera_section, STEP)


def test_only_a_guess_that_matters_is_used() -> None:
    for variant in variants():
        if variant.name in ("forward", "opencv_previous"):
            guesses = [error @ se3.inverse(pose(3)) for error in (STEP, np.eye(4))]
            poses = [variant.solver.solve(seen_by_sensor(), guess).T_camera_section for guess in guesses]
            assert (poses[0].tobytes() == poses[1].tobytes()) is not variant.uses_guess


def test_inverse_and_forward_measure_the_same_and_step_towards_each_other() -> None:
    room, T = SmoothRoom(seed=4), motion(2, metres=0.004, degrees=0.2)
    reference, observed = reference_of(room, margin=3), observed_of(room, START)
    forward_color = linearised(
        reference, reference.points, observed, 0, T, replace(SETTINGS, depth_weight=0.0), None, 1
    )
    forward_depth = linearised(
        reference, reference.points, observed, 0, T, replace(SETTINGS, color_weight=0.0), None, 1
    )
    color = FixedColors(reference.levels[0], SETTINGS).system(observed.levels[0], T, 0)
    depth = FixedPlanes(reference.points, SETTINGS).system(observed, T, 0)
    assert depth.measured == forward_depth.measured
    assert depth.mean_cost == pytest.approx(forward_depth.mean_cost, rel=1e-3)
    assert 0.8 * forward_color.measured < color.measured <= forward_color.measured
    for inverse, forward in ((color, forward_color), (depth, forward_depth)):
        # The frame's motion, as a left twist: the inverse step is taken on the other side, and backwards.
        backwards = np.asarray(np.linalg.solve(inverse.H, inverse.g), np.float64)
        step = se3.log(T @ se3.exp(backwards) @ se3.inverse(T))
        expected = np.asarray(-np.linalg.solve(forward.H, forward.g), np.float64)
        assert step @ expected > 0.95 * np.linalg.norm(step) * np.linalg.norm(expected)
        assert np.linalg.norm(step) == pytest.approx(np.linalg.norm(expected), rel=0.2)


def test_the_gradient_through_the_splat_is_that_of_the_cost() -> None:
    engine, section = NativeEngine(threads=1), seen_by_sensor().section
    depth_m = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    depth_m[8:-8, 8:-8] = seen_by_sensor().frame.depth_m()[8:-8, 8:-8]  # far from where the map ends
    observed = observed_frame(seen_by_sensor().rgb, depth_m, CAMERA, 1)
    # Quadratic within these sigmas and without gates: the same pixels count on both sides.
    wide = replace(SETTINGS, color_sigma=10.0, color_weight=100.0, depth_sigma_base_m=1.0, silhouette_threshold=0.5)
    T = STEP @ se3.inverse(pose(3))

    def cost(step: npt.NDArray[np.float64]) -> float:
        system = splat_system(engine, section.splats, observed, se3.exp(step) @ T, 0, wide)
        return system.mean_cost * system.measured

    system = splat_system(engine, section.splats, observed, T, 0, wide)
    numeric = np.array([(cost(2e-4 * axis) - cost(-2e-4 * axis)) / 4e-4 for axis in np.eye(6)])
    assert np.linalg.norm(numeric - system.g) < 0.05 * np.linalg.norm(numeric)
    assert np.linalg.eigvalsh(system.H).min() > 0


def test_a_parent_keeps_the_moments_of_its_children() -> None:
    room = SmoothRoom(seed=1)
    section = mapped_section([room.frame(START, CAMERA)], [START])
    merged, g = merged_splats(section, 1), section.gaussians
    assert CAMERA.width * CAMERA.height / 4 <= merged.count < 0.5 * g.count
    depth = -np.log1p(-1.0 / (1.0 + np.exp(-g.opacity_logits.astype(np.float64))))
    mass = depth * np.exp(2.0 * g.log_radii.astype(np.float64))
    parent_depth = -np.log1p(-1.0 / (1.0 + np.exp(-merged.opacity_logits.astype(np.float64))))
    parent_mass = parent_depth * np.exp(2.0 * merged.log_radii.astype(np.float64))
    full = parent_depth < 6.8  # others are as opaque as a Gaussian may be
    assert full.mean() > 0.5
    assert parent_mass.sum() <= mass.sum() * (1 + 1e-5)
    np.testing.assert_allclose(
        (parent_mass[full, None] * merged.colors[full]).sum(0) / parent_mass[full].sum(),
        (mass[:, None] * g.colors).sum(0) / mass.sum(),
        atol=0.05,
    )
    assert np.median(merged.log_radii) > np.median(g.log_radii) + 0.3


def test_a_merged_map_looks_like_the_map_seen_small() -> None:
    engine, section = NativeEngine(threads=1), seen_by_sensor().section
    small = section.camera.resized(section.camera.width // 2, section.camera.height // 2)
    fine, coarse = (
        engine.render(GaussianPyramids().splats(section, level), camera, np.eye(4))
        for level, camera in ((0, section.camera), (1, small))
    )
    mean = fine.rgb.reshape(small.height, 2, small.width, 2, 3).mean(axis=(1, 3))
    assert np.abs(coarse.rgb - mean).mean() < 0.03
    assert (coarse.alpha > 0.9).mean() > 0.9


def test_the_spread_of_depths_around_a_pixel_lies_along_its_surface() -> None:
    rays = CAMERA.pixel_rays()
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    depth_m = (2.0 * normal[2] / (rays @ normal)).astype(np.float32)
    quiet = replace(SETTINGS, depth_sigma_base_m=1e-6, depth_sigma_per_m=0.0)
    found = depth_distributions(depth_m, CAMERA, quiet)
    values, vectors = np.linalg.eigh(found.covariances_m2[10:-10, 10:-10])
    assert np.abs(vectors[..., 0] @ normal).min() > 0.999
    assert (values[..., 0] < 1e-4 * values[..., 1]).all()
    noisy = depth_distributions(depth_m, CAMERA, SETTINGS).covariances_m2 - found.covariances_m2
    ray = rays[24, 32] / np.linalg.norm(rays[24, 32])
    assert ray @ noisy[24, 32] @ ray == pytest.approx((0.008 * np.linalg.norm(rays[24, 32])) ** 2, rel=0.15)


def test_distributions_pull_a_frame_to_the_surface() -> None:
    room, T = SmoothRoom(seed=4), motion(3, metres=0.005, degrees=0.2)
    _, depth_m = room.view(START, CAMERA)
    image = depth_distributions(depth_m, CAMERA, SETTINGS)
    inner = (slice(4, -4), slice(4, -4))
    surface = Distributions(
        means_m=image.means_m[inner].reshape(-1, 3), covariances_m2=image.covariances_m2[inner].reshape(-1, 3, 3)
    )
    at = [gicp_system(surface, image, CAMERA, pose, 0, SETTINGS) for pose in (np.eye(4), T)]
    assert at[0].mean_cost < at[1].mean_cost
    found = T
    for _ in range(8):
        system = gicp_system(surface, image, CAMERA, found, 0, SETTINGS)
        found = left_step(found, damped_step(system))
    assert gicp_system(surface, image, CAMERA, found, 0, SETTINGS).mean_cost < 0.1 * at[1].mean_cost

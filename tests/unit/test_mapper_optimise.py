"""Eq. 2 at work: losses fall, neighbours take part at every step and stay as they are, heads move."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import SMALL_MAPPER, pose_error, room_frame, room_pose, room_section, section_bytes, small_mapper

from vtslam.common.geometry import se3
from vtslam.common.section import Section
from vtslam.common.settings import MapperSettings
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.services.mapper.bundle import HeadBundle
from vtslam.services.mapper.optimise import SectionOptimiser
from vtslam.services.mapper.state import TrainingView

Array = npt.NDArray[np.float64]

VIEW = TrainingView(frame_index=0, frame=room_frame(6))
STILL = replace(SMALL_MAPPER, bundle_rotation_rate=0.0, bundle_translation_rate=0.0)


def fresh_section() -> Section:
    """Section 1 at its head, not optimised yet."""
    mapper = small_mapper(replace(STILL, iterations_head=0))
    return mapper.map_head(VIEW.frame, room_pose(6), section_id=1, neighbours=[])[0].section


def optimiser(settings: MapperSettings, neighbours: list[Section]) -> SectionOptimiser:
    return SectionOptimiser(fresh_section(), neighbours, NativeEngine(threads=1), settings, moments=None)


def test_steps_lower_the_loss() -> None:
    for neighbours in ([], [room_section(3, 3)]):
        run = optimiser(SMALL_MAPPER, neighbours)
        losses = []
        for _ in range(15):
            run.step(VIEW, with_neighbours=True)
            losses.append(run.finished().loss)
        assert losses[-1] < 0.8 * losses[0]


def test_the_last_steps_of_a_section_are_as_small_as_asked() -> None:
    settings = replace(STILL, iterations_seal=3)
    moved = []
    for last in (1.0, 1e-6):
        mapper = small_mapper(replace(settings, seal_rate_first=last, seal_rate_last=last))
        active, _ = mapper.map_head(VIEW.frame, room_pose(6), section_id=1, neighbours=[])
        sealed, renders = mapper.seal(active, neighbours=[])
        assert renders == 3
        moved.append(np.abs(sealed.gaussians.colors - active.section.gaussians.colors).max())
    assert moved[0] > 1e-3
    assert moved[1] < 1e-5


def test_only_colour_radius_and_opacity_are_learned() -> None:
    before = fresh_section()
    run = optimiser(SMALL_MAPPER, [])
    run.step(VIEW, with_neighbours=False)
    after = run.finished().section
    for name in ("colors", "log_radii", "opacity_logits"):
        assert (getattr(after.gaussians, name) != getattr(before.gaussians, name)).mean() > 0.5
    for name in ("frame_index", "pixel", "subpixel", "depth"):
        np.testing.assert_array_equal(getattr(after.gaussians, name), getattr(before.gaussians, name))
    assert after.means_m.tobytes() == before.means_m.tobytes()


def test_neighbours_change_the_gradient_at_every_step() -> None:
    engine, neighbours = NativeEngine(threads=1), [room_section(3, 3)]
    joint = optimiser(STILL, neighbours)
    names = ("colors", "log_radii", "opacity_logits")
    before = {name: np.float32(0) for name in names}
    for _ in range(6):
        # What the section alone would ask for, from the same attributes; the first moment is a tenth of it.
        alone = SectionOptimiser(joint.finished().section, [], engine, STILL, moments=None)
        alone.step(VIEW, with_neighbours=False)
        renders = joint.finished().renders
        joint.step(VIEW, with_neighbours=True)
        assert joint.finished().renders == renders + 2
        assert joint.finished().loss > alone.finished().loss
        for name in names:
            moment = getattr(joint.finished().moments, name).m
            gradient = (moment - 0.9 * before[name]) / 0.1
            own = getattr(alone.finished().moments, name).m / 0.1
            assert np.linalg.norm(gradient - own) > 0.05 * np.linalg.norm(own), name
            before[name] = moment.copy()


def test_without_neighbours_the_weight_does_not_matter() -> None:
    runs = []
    for weight in (0.0, 1.0):
        run = optimiser(replace(SMALL_MAPPER, neighbour_weight=weight), [])
        run.step(VIEW, with_neighbours=True)
        runs.append(section_bytes(run.finished().section))
    assert runs[0] == runs[1]


def test_neighbours_themselves_never_change() -> None:
    neighbour = room_section(3, 3)
    before = section_bytes(neighbour)
    run = optimiser(SMALL_MAPPER, [neighbour])
    for _ in range(3):
        run.step(VIEW, with_neighbours=True)
    assert section_bytes(neighbour) == before
    assert run.finished().section.gaussians.count == fresh_section().gaussians.count


def test_the_joint_loss_makes_the_joint_view_better() -> None:
    engine, neighbour = NativeEngine(threads=1), room_section(3, 3)
    errors = {}
    for weight in (0.0, 1.0):
        run = optimiser(replace(STILL, neighbour_weight=weight), [neighbour])
        for _ in range(15):
            run.step(VIEW, with_neighbours=True)
        judge = SectionOptimiser(
            run.finished().section, [neighbour], engine, replace(STILL, neighbour_weight=1.0), moments=None
        )
        own = SectionOptimiser(run.finished().section, [], engine, STILL, moments=None)
        judge.step(VIEW, with_neighbours=True)
        own.step(VIEW, with_neighbours=False)
        errors[weight] = judge.finished().loss - own.finished().loss
    assert errors[1.0] < errors[0.0]


@pytest.mark.parametrize("keep_moments", [False, True])
def test_moments_are_kept_only_if_asked(keep_moments: bool) -> None:
    settings = replace(SMALL_MAPPER, keep_moments=keep_moments)
    mapper = small_mapper(settings)
    active, _ = mapper.map_head(room_frame(0), room_pose(0), section_id=0, neighbours=[])
    grown, record = mapper.map_regular(room_frame(3), room_pose(3), active, neighbours=[])
    assert active.moments is not None
    assert grown.moments is not None
    assert active.moments.colors.step_count == settings.iterations_head
    expected = settings.iterations_regular + (settings.iterations_head if keep_moments else 0)
    assert grown.moments.colors.step_count == expected
    assert grown.moments.colors.m.shape == (record.gaussians, 3)


def mapped_head(T: Array, *, rate: float, iterations: int = 40) -> Array:
    settings = replace(
        SMALL_MAPPER, iterations_head=iterations, bundle_rotation_rate=rate, bundle_translation_rate=rate
    )
    _, record = small_mapper(settings).map_head(VIEW.frame, T, section_id=1, neighbours=[room_section(0, 6)])
    return record.T_world_camera


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_bundle_adjustment_moves_a_wrong_head_towards_the_truth(sign: float) -> None:
    wrong = room_pose(6) @ se3.exp(sign * np.array([0.02, -0.01, 0.015, 0.004, -0.003, 0.005]))
    moved = mapped_head(wrong, rate=2e-4)
    before, after = pose_error(wrong, room_pose(6)), pose_error(moved, room_pose(6))
    assert after[0] < 0.85 * before[0]
    assert se3.is_rigid(moved, tolerance=1e-9)


def test_bundle_adjustment_stays_still_at_rate_zero_and_without_neighbours() -> None:
    wrong = room_pose(6) @ se3.exp(np.array([0.02, -0.01, 0.015, 0.004, -0.003, 0.005]))
    np.testing.assert_array_equal(mapped_head(wrong, rate=0.0, iterations=3), wrong)
    settings = replace(SMALL_MAPPER, iterations_head=3, bundle_translation_rate=1e-2, bundle_rotation_rate=1e-2)
    _, record = small_mapper(settings).map_head(VIEW.frame, wrong, section_id=0, neighbours=[])
    np.testing.assert_array_equal(record.T_world_camera, wrong)


def test_the_section_follows_its_head() -> None:
    wrong = room_pose(6) @ se3.exp(np.array([0.02, 0, 0, 0, 0, 0]))
    settings = replace(SMALL_MAPPER, bundle_rotation_rate=1e-3, bundle_translation_rate=1e-3)
    active, record = small_mapper(settings).map_head(VIEW.frame, wrong, section_id=1, neighbours=[room_section(0, 6)])
    section = active.section
    assert pose_error(record.T_world_camera, wrong)[0] > 1e-4
    np.testing.assert_allclose(section.T_world_section, record.T_world_camera, atol=1e-12)
    np.testing.assert_array_equal(section.frames[0].T_section_frame, np.eye(4))
    # Positions within the section do not depend on where it stands.
    assert section.means_m.tobytes() == section.retied().means_m.tobytes()


def test_bundle_steps_have_adams_length_and_direction() -> None:
    T = room_pose(6)
    settings = replace(SMALL_MAPPER, bundle_translation_rate=1e-3, bundle_rotation_rate=2e-3)
    gradient = np.array([3.0, -2.0, 1.0, 0.5, -4.0, 2.0])
    bundle = HeadBundle(T, settings)
    moved = bundle.moved(gradient)
    twist = se3.log(se3.inverse(moved) @ T)  # of T_camera_world, on its left
    np.testing.assert_allclose(twist, [-1e-3, 1e-3, -1e-3, -2e-3, 2e-3, -2e-3], atol=1e-9)
    np.testing.assert_array_equal(HeadBundle(T, settings).moved(np.zeros(6)), T)


def test_the_pose_gradient_is_that_of_moving_the_section_against_its_neighbours() -> None:
    # Held against finite differences of the joint loss by the section's anchor.
    settings = replace(SMALL_MAPPER, ssim_share=0.0, neighbour_weight=1.0)
    engine, neighbour = NativeEngine(threads=1), room_section(3, 3)
    section = fresh_section()

    def joint_loss(twist: Array) -> float:
        moved = replace(section, T_world_section=section.T_world_section @ se3.exp(-twist))
        both = SectionOptimiser(moved, [neighbour], engine, settings, moments=None)
        both.step(VIEW, with_neighbours=True)
        return both.finished().loss

    run = SectionOptimiser(section, [neighbour], engine, settings, moments=None)
    gradient = run.step(VIEW, with_neighbours=True)
    numeric = np.array([(joint_loss(s) - joint_loss(-s)) / 4e-4 for s in 2e-4 * np.eye(6)])
    assert np.linalg.norm(gradient - numeric) < 0.25 * np.linalg.norm(numeric)
    cosine = gradient @ numeric / (np.linalg.norm(gradient) * np.linalg.norm(numeric))
    assert cosine > 0.97


def test_rate_term_keeps_attributes_at_their_first_values() -> None:
    shares = []
    for weight in (0.0, 0.3, 1.0):
        section = fresh_section()
        settings = replace(STILL, rate_weight=weight)
        run = SectionOptimiser(section, [], NativeEngine(threads=1), settings, moments=None, views=(VIEW,))
        for _ in range(8):
            run.step(VIEW, with_neighbours=False)
        found, first = run.finished().section.gaussians, section.gaussians
        same = [np.abs(found.colors - first.colors), np.abs(found.log_radii - first.log_radii)[:, None]]
        shares.append(float((np.concatenate(same, axis=1) < 1e-6).mean()))
    assert shares[0] < 0.3 < shares[1] + 0.3 < shares[2] + 0.3
    assert shares[2] > 0.9


def test_rate_term_needs_the_frames_that_gaussians_are_tied_to() -> None:
    with pytest.raises(ValueError, match="expected the views of all frames"):
        optimiser(replace(SMALL_MAPPER, rate_weight=0.1), [])

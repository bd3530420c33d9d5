"""Poses from the tracker on small maps: accuracy, priors, heads, rescue, determinism."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import (
    FixedMap,
    mapped_section,
    pose_error,
    room_frame,
    room_pose,
    room_section,
    section_bytes,
    small_mapper,
)
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.external_pose import ExternalPose
from vtslam.common.geometry import se3
from vtslam.common.section import Section
from vtslam.common.settings import AdamSettings, GaussNewtonSettings, MapperSettings, TrackerSettings
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.common.tracking_facts import TrackingState
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.state import TrackerState

CAMERA = small_camera()
ROOM = SmoothRoom(seed=3)
STEP = np.array([0.015, -0.01, 0.012, 0.01, 0.02, -0.008])
ADAM = AdamSettings(iterations=60, first_section_iterations=60, pretrack_iterations=8, silhouette_threshold=0.9)


def pose(step: float) -> npt.NDArray[np.float64]:
    return se3.exp(step * STEP)


def smooth_section() -> Section:
    """Two frames of the smooth room, with Gaussians as large as the paper has them."""
    mapper = small_mapper(MapperSettings(iterations_head=15, iterations_regular=5))
    active, _ = mapper.map_head(ROOM.frame(pose(0), CAMERA), pose(0), section_id=0, neighbours=[])
    active, _ = mapper.map_regular(ROOM.frame(pose(1), CAMERA, frame_id=1), pose(1), active, neighbours=[])
    return mapper.seal(active, neighbours=[])[0]


def tracker(settings: TrackerSettings | None = None, *, threads: int = 1) -> Tracker:
    settings = settings or TrackerSettings(optimizer="gauss_newton", adam=ADAM)
    return Tracker(settings=settings, engine=NativeEngine(threads=threads), threads=threads)


def test_gauss_newton_reaches_the_true_pose_in_few_renders() -> None:
    section = mapped_section([ROOM.frame(pose(k), CAMERA, frame_id=k) for k in range(3)], [pose(k) for k in range(3)])
    frame = ROOM.frame(pose(3), CAMERA, frame_id=3)
    result = tracker().track(frame, FixedMap.of(section), TrackerState(), section_id=0, is_head=False, guess=pose(2))
    metres, degrees = pose_error(result.T_world_camera, pose(3))
    assert result.state is TrackingState.OK
    assert result.quality.renders <= 3
    assert metres < 0.004
    assert degrees < 0.15
    assert se3.is_rigid(result.T_world_camera, tolerance=1e-9)
    np.testing.assert_allclose(result.covariance, result.covariance.T, rtol=1e-9)
    assert np.linalg.eigvalsh(result.covariance).min() > 0
    assert (result.quality.section_id, result.overlap_section_id) == (0, -1)


def test_adam_approaches_the_true_pose() -> None:
    section = smooth_section()
    frame = ROOM.frame(pose(2), CAMERA, frame_id=2)
    # Accumulated depth leans towards the camera, at this size by centimetres: it must not weigh as much as colour.
    settings = TrackerSettings(optimizer="adam", adam=replace(ADAM, depth_weight=0.1))
    result = tracker(settings).track(
        frame, FixedMap.of(section), TrackerState(), section_id=0, is_head=False, guess=pose(1)
    )
    metres, degrees = pose_error(result.T_world_camera, pose(2))
    assert result.state is TrackingState.OK
    assert result.quality.renders == 60
    assert metres < 0.01  # of 0.022
    assert degrees < 0.3  # of 1.4


def test_adam_keeps_the_best_pose_it_saw() -> None:
    section, frame = FixedMap.of(smooth_section()), ROOM.frame(pose(2), CAMERA, frame_id=2)
    losses = []
    for iterations in (1, 4, 16, 40):
        adam = replace(ADAM, first_section_iterations=iterations)
        settings = TrackerSettings(optimizer="adam", adam=adam)
        result = tracker(settings).track(frame, section, TrackerState(), section_id=0, is_head=False, guess=pose(1))
        losses.append(adam.color_weight * result.quality.color_loss + adam.depth_weight * result.quality.depth_loss_m)
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < losses[0]


def test_adam_does_not_keep_a_pose_that_is_worse_than_its_guess() -> None:
    section, frame = FixedMap.of(smooth_section()), ROOM.frame(pose(1), CAMERA, frame_id=1)
    losses = []
    for iterations in (1, 3):
        adam = replace(ADAM, first_section_iterations=iterations, learning_rate_translation=0.3)
        result = tracker(TrackerSettings(optimizer="adam", adam=adam)).track(
            frame, section, TrackerState(), section_id=0, is_head=False, guess=pose(1)
        )
        losses.append((result.quality.color_loss, result.quality.depth_loss_m))
        assert pose_error(result.T_world_camera, pose(1))[0] < 1e-9
    assert losses[0] == losses[1]


def test_section_zero_has_its_own_number_of_iterations() -> None:
    frame, guess = ROOM.frame(pose(2), CAMERA, frame_id=2), pose(2)
    section = smooth_section()
    settings = TrackerSettings(optimizer="adam", adam=replace(ADAM, iterations=3, first_section_iterations=5))
    for section_id, renders in ((0, 5), (1, 3)):
        fixed = FixedMap.of(replace(section, section_id=section_id))
        result = tracker(settings).track(
            frame, fixed, TrackerState(), section_id=section_id, is_head=False, guess=guess
        )
        assert result.quality.renders == renders


@pytest.mark.parametrize("index", [3, 4, 5])
def test_room_frames_are_tracked_from_the_frame_before(index: int) -> None:
    result = tracker().track(
        room_frame(index),
        FixedMap.of(room_section(0, 3)),
        TrackerState(),
        section_id=0,
        is_head=False,
        guess=room_pose(index - 1),
    )
    metres, degrees = pose_error(result.T_world_camera, room_pose(index))
    assert result.state is TrackingState.OK
    assert metres < 0.008
    assert degrees < 0.25


def test_constant_velocity_is_the_guess_unless_one_is_given() -> None:
    state = TrackerState(committed_poses=(room_pose(1), room_pose(2)))
    fixed = FixedMap.of(room_section(0, 3))
    free = tracker().track(room_frame(3), fixed, state, section_id=0, is_head=False)
    given = tracker().track(
        room_frame(3), fixed, state, section_id=0, is_head=False, guess=state.constant_velocity_guess()
    )
    assert free.T_world_camera.tobytes() == given.T_world_camera.tobytes()


def test_a_head_is_tracked_against_an_overlapping_section() -> None:
    state = TrackerState(committed_poses=(room_pose(4), room_pose(5)), previous_frame=room_frame(5))
    result = tracker().track(room_frame(6), FixedMap.of(room_section(0, 6)), state, section_id=1, is_head=True)
    metres, degrees = pose_error(result.T_world_camera, room_pose(6))
    assert result.state is TrackingState.OK
    assert (result.overlap_section_id, result.quality.section_id) == (0, 0)
    assert metres < 0.01
    assert degrees < 0.3


@pytest.mark.parametrize("optimizer", ["gauss_newton", "adam"])
def test_a_head_takes_the_section_that_fits_best(optimizer: str) -> None:
    # All three saw the place alike, but the colours of two are wrong.
    good = room_section(0, 3)
    g = good.gaussians
    wrong = g.with_attributes(
        colors=np.ascontiguousarray(1 - g.colors), log_radii=g.log_radii, opacity_logits=g.opacity_logits
    )
    bad = replace(good, gaussians=wrong)
    sections = FixedMap.of(bad, replace(good, section_id=1), replace(bad, section_id=2))
    settings = TrackerSettings(
        optimizer="adam" if optimizer == "adam" else "gauss_newton", adam=replace(ADAM, iterations=5)
    )
    state = TrackerState(committed_poses=(room_pose(1), room_pose(2)))
    result = tracker(settings).track(room_frame(3), sections, state, section_id=3, is_head=True)
    assert result.overlap_section_id == 1
    assert result.quality.renders > (5 if optimizer == "adam" else 3)  # those of all that were tried


def test_a_sure_prior_decides_and_an_unsure_one_does_not() -> None:
    fixed = FixedMap.of(room_section(0, 3))

    def tracked(prior: ExternalPose | None) -> npt.NDArray[np.float64]:
        result = tracker().track(
            room_frame(3), fixed, TrackerState(), section_id=0, is_head=False, guess=room_pose(2), prior=prior
        )
        return result.T_world_camera

    other = room_pose(3) @ se3.exp(np.array([0.02, 0.01, -0.01, 0.005, 0.0, 0.01]))
    sure = tracked(ExternalPose(T_world_camera=other, covariance=1e-14 * np.eye(6)))
    assert pose_error(sure, other)[0] < 1e-5
    unsure = tracked(ExternalPose(T_world_camera=other, covariance=1e8 * np.eye(6)))
    np.testing.assert_allclose(unsure, tracked(None), atol=1e-6)


def test_a_prior_holds_in_a_moved_section() -> None:
    lift = se3.exp(np.array([10.0, -5.0, 2.0, 0.3, 0.2, -0.9]))
    section = room_section(0, 3)
    moved = FixedMap.of(replace(section, T_world_section=lift @ section.T_world_section))
    prior = ExternalPose(T_world_camera=lift @ room_pose(3), covariance=1e-10 * np.eye(6))
    result = tracker().track(
        room_frame(3), moved, TrackerState(), section_id=0, is_head=False, guess=lift @ room_pose(2), prior=prior
    )
    assert pose_error(result.T_world_camera, lift @ room_pose(3))[0] < 1e-3


@pytest.mark.parametrize("optimizer", ["gauss_newton", "adam"])
def test_threads_do_not_change_a_byte(optimizer: str) -> None:
    settings = TrackerSettings(
        optimizer="adam" if optimizer == "adam" else "gauss_newton", adam=replace(ADAM, iterations=6)
    )
    found = [
        tracker(settings, threads=threads).track(
            room_frame(6),
            FixedMap.of(room_section(0, 6)),
            TrackerState(committed_poses=(room_pose(4), room_pose(5))),
            section_id=1,
            is_head=True,
        )
        for threads in (1, 2, 4)
    ]
    for other in found[1:]:
        assert other.T_world_camera.tobytes() == found[0].T_world_camera.tobytes()
        assert other.covariance.tobytes() == found[0].covariance.tobytes()
        assert other.quality == found[0].quality


def test_tracking_changes_neither_map_nor_state() -> None:
    section = room_section(0, 3)
    before = section_bytes(section)
    poses = (room_pose(1).copy(), room_pose(2).copy())
    state = TrackerState(committed_poses=poses, previous_frame=room_frame(2), losses=((0.1, 0.1),) * 6)
    tracker().track(room_frame(3), FixedMap.of(section), state, section_id=0, is_head=False)
    assert section_bytes(section) == before
    np.testing.assert_array_equal(poses[1], room_pose(2))
    assert state.losses == ((0.1, 0.1),) * 6


def test_fewer_measurements_are_less_certain() -> None:
    fixed = FixedMap.of(room_section(0, 3))
    frame = room_frame(3)
    depth = frame.depth.copy()
    depth[:, 20:] = 0
    traces = [
        float(
            np.trace(
                tracker().track(f, fixed, TrackerState(), section_id=0, is_head=False, guess=room_pose(3)).covariance
            )
        )
        for f in (frame, replace(frame, depth=depth))
    ]
    assert traces[1] > 1.5 * traces[0]


def jump_state(num_losses: int, loss: float) -> TrackerState:
    """Committed poses whose constant velocity points 17 degrees aside of where the camera goes."""
    aside = se3.exp(np.array([0.1, 0, 0, 0, 0.3, 0]))
    return TrackerState(
        committed_poses=(room_pose(1) @ aside, room_pose(1)),
        previous_frame=room_frame(1),
        losses=((loss, loss),) * num_losses,
    )


RESCUE = TrackerSettings(
    optimizer="gauss_newton",
    rescue_factor=2.0,
    lost_loss_factor=1e6,
    gauss_newton=GaussNewtonSettings(renders=2, levels=1, iterations=4),
)


def test_odometry_rescues_a_sudden_jump() -> None:
    fixed = FixedMap.of(room_section(0, 3))
    rescued = tracker(RESCUE).track(room_frame(3), fixed, jump_state(6, 0.02), section_id=0, is_head=False)
    alone = tracker(RESCUE).track(room_frame(3), fixed, jump_state(4, 0.02), section_id=0, is_head=False)
    assert rescued.quality.rescued
    assert not alone.quality.rescued  # too few frames to know what is usual
    found, lost = pose_error(rescued.T_world_camera, room_pose(3)), pose_error(alone.T_world_camera, room_pose(3))
    assert found[0] < 0.01
    assert found[1] < 0.3
    assert lost[1] > 10 * found[1]


def test_odometry_is_not_asked_while_losses_are_usual() -> None:
    fixed = FixedMap.of(room_section(0, 3))
    state = TrackerState(
        committed_poses=(room_pose(1), room_pose(2)), previous_frame=room_frame(2), losses=((0.2, 0.1),) * 6
    )
    result = tracker(replace(RESCUE, rescue_factor=50.0)).track(
        room_frame(3), fixed, state, section_id=0, is_head=False
    )
    assert not result.quality.rescued
    assert result.state is TrackingState.OK

"""What the tracker carries from frame to frame."""

from dataclasses import replace

import numpy as np
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.external_pose import ExternalPose
from vtslam.common.geometry import se3
from vtslam.common.tracking_facts import TrackingQuality, TrackingState
from vtslam.services.tracker.state import TrackerState, TrackResult

STEP = se3.exp(np.array([0.02, -0.01, 0.03, 0.01, 0.04, -0.02]))
START = se3.exp(np.array([1.0, 2.0, -1.0, 0.3, -0.5, 1.2]))
FRAME = SmoothRoom().frame(np.eye(4), small_camera(16, 12))


def result(state: TrackingState, loss: float = 0.1) -> TrackResult:
    quality = TrackingQuality(
        color_loss=loss, depth_loss_m=loss / 10, covered_share=0.9, renders=3, section_id=0, rescued=False
    )
    return TrackResult(
        T_world_camera=np.eye(4), covariance=np.eye(6), quality=quality, state=state, overlap_section_id=-1
    )


def test_the_guess_goes_on_at_constant_velocity() -> None:
    assert (TrackerState().constant_velocity_guess() == np.eye(4)).all()
    first = TrackerState().after(FRAME, START, None, 2.0)
    np.testing.assert_array_equal(first.constant_velocity_guess(), START)
    second = first.after(FRAME, START @ STEP, result(TrackingState.OK), 2.0)
    np.testing.assert_allclose(second.constant_velocity_guess(), START @ STEP @ STEP, atol=1e-12)
    third = second.after(FRAME, START @ STEP @ STEP, result(TrackingState.OK), 2.0)
    np.testing.assert_allclose(third.constant_velocity_guess(), START @ STEP @ STEP @ STEP, atol=1e-12)
    assert len(third.committed_poses) == 2


def test_only_trusted_frames_say_what_loss_is_usual() -> None:
    state = TrackerState().after(FRAME, START, None, 2.0)
    assert state.losses == ()
    for verdict in (TrackingState.OK, TrackingState.WEAK, TrackingState.LOST, TrackingState.OK):
        state = state.after(FRAME, START, result(verdict, 0.1 if verdict is TrackingState.OK else 9.0), 2.0)
    np.testing.assert_allclose(state.losses, [[0.1, 0.01]] * 2)


def test_memory_is_bounded_on_endless_streams() -> None:
    state = TrackerState()
    for step in range(1000):
        state = state.after(FRAME, START, result(TrackingState.OK, float(step)), 1.0 + step)
    assert len(state.losses) < 500
    assert state.losses[-1][0] == 999.0
    assert len(state.largest_mean_depths_m) == 30
    assert state.largest_mean_depths_m == tuple(1000.0 - k for k in range(30))


def test_a_frame_without_depth_leaves_the_far_filter_alone() -> None:
    state = TrackerState().after(FRAME, START, None, 2.0)
    assert state.after(FRAME, START, result(TrackingState.LOST), 0.0).largest_mean_depths_m == (2.0,)


def test_the_next_state_is_a_new_one() -> None:
    state = TrackerState().after(FRAME, START, None, 2.0)
    state.after(FRAME, START @ STEP, result(TrackingState.OK), 3.0)
    assert len(state.committed_poses) == 1
    assert state.largest_mean_depths_m == (2.0,)
    assert state.previous_frame is FRAME


def test_priors_count_if_the_first_frame_has_one_also_after_a_restart() -> None:
    given = replace(FRAME, pose_prior=ExternalPose(T_world_camera=START, covariance=np.eye(6)))
    for first, counts in ((FRAME, False), (given, True)):
        state = TrackerState().after(first, START, None, 2.0).after(given, START, result(TrackingState.OK), 2.0)
        again = TrackerState.resumed(state.committed_poses, given, state.history(), state.exposure)
        for each in (state, again, again.after(FRAME, START, None, 2.0)):
            assert (each.prior_of(given) is not None) == counts
    assert TrackerState().prior_of(given) is given.pose_prior

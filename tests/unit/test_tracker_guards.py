"""The tracker on bad input: it never raises, says how far to trust a pose, and keeps its guess where it must."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import FixedMap, room_frame, room_pose, room_section, without_depth

from vtslam.common.frame import Frame
from vtslam.common.gaussians import ViewTiedGaussians
from vtslam.common.geometry import se3
from vtslam.common.section import Section
from vtslam.common.settings import AdamSettings, TrackerSettings
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.common.tracking_facts import TrackingState
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.state import TrackerState, TrackResult

Array = npt.NDArray[np.float64]

OPTIMISERS = ("gauss_newton", "adam")
STATE = TrackerState(committed_poses=(room_pose(1), room_pose(2)), previous_frame=room_frame(2))
AWAY = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))


def settings_for(optimizer: str) -> TrackerSettings:
    adam = AdamSettings(iterations=4, first_section_iterations=4, pretrack_iterations=2, silhouette_threshold=0.9)
    return TrackerSettings(optimizer="adam" if optimizer == "adam" else "gauss_newton", adam=adam)


def tracked(
    optimizer: str,
    frame: Frame,
    fixed: FixedMap,
    state: TrackerState = STATE,
    *,
    section_id: int = 0,
    is_head: bool = False,
    guess: Array | None = None,
) -> TrackResult:
    tracker = Tracker(settings=settings_for(optimizer), engine=NativeEngine(threads=1))
    return tracker.track(frame, fixed, state, section_id=section_id, is_head=is_head, guess=guess)


def empty_section(section_id: int) -> Section:
    section = room_section(0)
    bare = replace(section.frames[0], view_depth=np.zeros_like(room_frame(0).depth))
    return replace(section, section_id=section_id, frames=(bare,), gaussians=ViewTiedGaussians.empty()).retied()


def assert_lost_at(result: TrackResult, guess: Array) -> None:
    assert result.state is TrackingState.LOST
    np.testing.assert_array_equal(result.T_world_camera, guess)
    assert np.diag(result.covariance).min() >= 1e3
    assert np.isfinite(result.covariance).all()
    assert result.quality.covered_share == 0.0


@pytest.mark.parametrize("optimizer", OPTIMISERS)
@pytest.mark.parametrize("is_head", [False, True])
def test_a_frame_without_depth_is_lost_at_its_guess(optimizer: str, is_head: bool) -> None:
    section_id = int(is_head)
    result = tracked(
        optimizer, without_depth(room_frame(3)), FixedMap.of(room_section(0, 3)), section_id=section_id, is_head=is_head
    )
    assert_lost_at(result, STATE.constant_velocity_guess())
    assert not result.quality.rescued


@pytest.mark.parametrize("optimizer", OPTIMISERS)
@pytest.mark.parametrize(("before", "now"), [(False, True), (True, False), (True, True)])
def test_rescue_survives_frames_without_depth(optimizer: str, before: bool, now: bool) -> None:
    # Losses near zero: odometry is asked for every frame.
    previous, frame = room_frame(2), room_frame(3)
    state = replace(STATE, previous_frame=without_depth(previous) if before else previous, losses=((1e-9, 1e-9),) * 6)
    result = tracked(optimizer, without_depth(frame) if now else frame, FixedMap.of(room_section(0, 3)), state)
    assert not result.quality.rescued
    assert np.isfinite(result.T_world_camera).all()
    if now:
        assert_lost_at(result, state.constant_velocity_guess())


@pytest.mark.parametrize("optimizer", OPTIMISERS)
def test_a_head_without_any_view_to_compare_is_lost(optimizer: str) -> None:
    result = tracked(optimizer, room_frame(3), FixedMap(), section_id=1, is_head=True)
    assert_lost_at(result, STATE.constant_velocity_guess())
    assert (result.quality.section_id, result.overlap_section_id, result.quality.renders) == (-1, -1, 0)


@pytest.mark.parametrize("optimizer", OPTIMISERS)
def test_a_head_that_overlaps_with_nothing_tries_the_latest_section(optimizer: str) -> None:
    sections = FixedMap.of(room_section(0, 3), room_section(3, 3, section_id=1))
    result = tracked(optimizer, room_frame(3), sections, section_id=2, is_head=True, guess=AWAY)
    assert_lost_at(result, AWAY)
    assert result.overlap_section_id == 1


@pytest.mark.parametrize("optimizer", OPTIMISERS)
@pytest.mark.parametrize("is_head", [False, True])
def test_an_empty_map_loses_the_frame(optimizer: str, is_head: bool) -> None:
    fixed = FixedMap.of(empty_section(0))
    result = tracked(optimizer, room_frame(3), fixed, section_id=int(is_head), is_head=is_head)
    assert_lost_at(result, STATE.constant_velocity_guess())


@pytest.mark.parametrize("optimizer", OPTIMISERS)
def test_after_a_head_without_depth_the_section_before_is_used(optimizer: str) -> None:
    fixed = FixedMap.of(room_section(0, 3), empty_section(1))
    result = tracked(optimizer, room_frame(3), fixed, section_id=1)
    assert result.quality.section_id == 0
    assert result.state is TrackingState.OK


@pytest.mark.parametrize("optimizer", OPTIMISERS)
def test_section_one_is_tracked_against_section_zero(optimizer: str) -> None:
    result = tracked(optimizer, room_frame(3), FixedMap.of(room_section(0, 3)), section_id=1, is_head=True)
    assert result.overlap_section_id == 0
    assert result.state is TrackingState.OK


@pytest.mark.parametrize("optimizer", OPTIMISERS)
def test_a_map_behind_the_camera_loses_the_frame(optimizer: str) -> None:
    result = tracked(optimizer, room_frame(3), FixedMap.of(room_section(0, 3)), guess=AWAY)
    assert_lost_at(result, AWAY)


@pytest.mark.parametrize(
    ("share", "expected"), [(1.0, TrackingState.OK), (0.05, TrackingState.WEAK), (0.005, TrackingState.LOST)]
)
def test_states_follow_the_share_of_usable_pixels(share: float, expected: TrackingState) -> None:
    frame = room_frame(3)
    depth = frame.depth.copy().reshape(-1)
    # A few whole rows in the middle, so that what is left is one surface.
    keep = round(share * depth.size)
    start = (depth.size - keep) // 2
    depth[:start], depth[start + keep :] = 0, 0
    partial = replace(frame, depth=depth.reshape(frame.depth.shape))
    result = tracked("gauss_newton", partial, FixedMap.of(room_section(0, 3)), guess=room_pose(3))
    assert result.state is expected
    assert result.quality.covered_share == pytest.approx(share, rel=0.2)
    if expected is TrackingState.LOST:
        np.testing.assert_array_equal(result.T_world_camera, room_pose(3))


def test_a_loss_far_above_the_usual_one_is_lost() -> None:
    fixed = FixedMap.of(room_section(0, 3))
    frame = room_frame(3)
    black = replace(frame, rgb=np.zeros_like(frame.rgb))
    first = tracked("gauss_newton", frame, fixed, guess=room_pose(3))
    usual = (first.quality.color_loss / 8, 1.0)
    assert first.state is TrackingState.OK
    state = replace(STATE, losses=(usual,) * 6)
    assert tracked("gauss_newton", frame, fixed, state, guess=room_pose(3)).state is TrackingState.OK
    assert tracked("gauss_newton", black, fixed, state, guess=room_pose(3)).state is TrackingState.LOST
    # Too few frames to know what is usual.
    early = replace(STATE, losses=(usual,) * 4)
    assert tracked("gauss_newton", black, fixed, early, guess=room_pose(3)).state is TrackingState.OK


def test_the_far_filter_leaves_out_distant_pixels() -> None:
    fixed = FixedMap.of(room_section(0, 3))
    near = replace(STATE, largest_mean_depths_m=(0.01,) * 29)
    usual = tracked("gauss_newton", room_frame(3), fixed, guess=room_pose(3))
    filtered = tracked("gauss_newton", room_frame(3), fixed, near, guess=room_pose(3))
    assert filtered.quality.covered_share < 0.2 * usual.quality.covered_share
    settings = replace(settings_for("gauss_newton"), far_factor=0.0)
    off = Tracker(settings=settings, engine=NativeEngine(threads=1)).track(
        room_frame(3), fixed, near, section_id=0, is_head=False, guess=room_pose(3)
    )
    assert off.quality.covered_share >= usual.quality.covered_share


def test_heads_count_only_what_the_section_saw_if_asked() -> None:
    fixed = FixedMap.of(room_section(0, 3))
    shares = []
    for visibility in (False, True):
        settings = replace(settings_for("gauss_newton"), visibility=visibility)
        tracker = Tracker(settings=settings, engine=NativeEngine(threads=1))
        result = tracker.track(room_frame(5), fixed, STATE, section_id=1, is_head=True, guess=room_pose(5))
        shares.append(result.quality.covered_share)
    assert 0.1 < shares[1] < shares[0]

"""Which sections a head is compared with."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.overlap.selection import (
    CandidateView,
    largest_overlap,
    overlap_shares,
    sections_to_pretrack,
    seen_by_view,
)
from vtslam.common.settings import OverlapSettings

CAMERA = small_camera()
SETTINGS = OverlapSettings(gamma=0.26, gamma_decay=0.8, gamma_floor=0.01, max_sections=3)


def view(section_id: int, frame_id: int = 0, *, frame: Frame | None = None, angle_rad: float = 0.0) -> CandidateView:
    T = se3.exp(np.array([0, 0, 0, 0, angle_rad, 0]))
    frame = frame or SmoothRoom().frame(T, CAMERA)
    return CandidateView(
        section_id=section_id,
        frame_id=frame_id,
        is_head=True,
        T_world_camera=T,
        depth=frame.depth,
        depth_scale_m=frame.depth_scale_m,
        camera=CAMERA,
    )


def chosen(shares: dict[int, float], *, head: int, settings: OverlapSettings = SETTINGS) -> list[int]:
    """The choice among one view of each section with these shares."""
    views = [view(section_id) for section_id in shares]
    return sections_to_pretrack(np.array(list(shares.values())), views, head_section_id=head, settings=settings)


def points_of(frame: Frame) -> npt.NDArray[np.float64]:
    return CAMERA.back_projected(frame.depth_m()).reshape(-1, 3).astype(np.float64)


def test_the_earliest_three_that_see_enough() -> None:
    assert chosen({0: 0.3, 1: 0.1, 2: 0.4, 3: 0.9, 4: 0.8}, head=5) == [0, 2, 3]


def test_one_section_for_the_first_two_heads_after_the_start() -> None:
    assert chosen({0: 0.9}, head=1) == [0]
    assert chosen({0: 0.3, 1: 0.9}, head=2) == [0]
    assert chosen({0: 0.3, 1: 0.9, 2: 0.5}, head=3) == [0, 1, 2]


def test_a_section_counts_once_however_many_of_its_views_pass() -> None:
    views = [view(0), view(0, 5), view(1), view(1, 5), view(2), view(3)]
    shares = np.array([0.3, 0.9, 0.1, 0.8, 0.5, 0.7])
    assert sections_to_pretrack(shares, views, head_section_id=4, settings=SETTINGS) == [0, 1, 2]


def test_gamma_decays_only_until_enough_pass() -> None:
    # 0.26 * 0.8 = 0.208 lets section 1 in; that is the third, so section 0 stays out.
    assert chosen({0: 0.2, 1: 0.22, 2: 0.5, 3: 0.6}, head=4) == [1, 2, 3]
    # One more round, 0.166, is needed when one of them is missing.
    assert chosen({0: 0.2, 1: 0.22, 2: 0.5}, head=4) == [0, 1, 2]


def test_gamma_never_falls_below_its_floor() -> None:
    floor = replace(SETTINGS, gamma_floor=0.15)
    assert chosen({0: 0.16, 1: 0.18, 2: 0.5}, head=3, settings=floor) == [1, 2]


def test_no_more_decay_than_there_are_sections() -> None:
    # Both sections pass at once: waiting for a third that does not exist would only admit noise.
    views = [view(0), view(0, 5), view(1)]
    assert sections_to_pretrack(np.array([0.02, 0.5, 0.5]), views, head_section_id=3, settings=SETTINGS) == [0, 1]


def test_when_nothing_overlaps_the_latest_section_is_tried() -> None:
    assert chosen({0: 0.0, 1: 0.0, 2: 0.0}, head=3) == [2]
    assert chosen({0: 0.0}, head=1) == [0]


def test_without_views_there_is_nothing_to_try() -> None:
    assert sections_to_pretrack(np.zeros(0), [], head_section_id=1, settings=SETTINGS) == []


def test_fewer_sections_if_the_settings_say_so() -> None:
    assert chosen({0: 0.5, 1: 0.5, 2: 0.5, 3: 0.5}, head=4, settings=replace(SETTINGS, max_sections=2)) == [0, 1]


def test_largest_overlap_leaves_the_previous_section_out() -> None:
    views = [view(0), view(1), view(2)]
    shares = np.array([0.2, 0.3, 0.9])
    assert largest_overlap(shares, views, excluded_section_id=2) == 1
    assert largest_overlap(shares, views, excluded_section_id=1) == 2
    assert largest_overlap(np.array([0.0, 0.0, 0.9]), views, excluded_section_id=2) is None
    assert largest_overlap(np.zeros(0), [], excluded_section_id=0) is None


def test_equal_overlap_goes_to_the_earlier_section() -> None:
    assert largest_overlap(np.array([0.4, 0.4]), [view(0), view(1)], excluded_section_id=2) == 0


def test_a_view_sees_its_own_points_but_those_in_the_border() -> None:
    frame = SmoothRoom().frame(np.eye(4), CAMERA)
    shares = overlap_shares(points_of(frame), [view(0)], replace(SETTINGS, border_share=0.0))
    assert shares[0] == pytest.approx(1.0)
    border = 6
    inner = (CAMERA.width - 2 * border) * (CAMERA.height - 2 * border) / (CAMERA.width * CAMERA.height)
    bordered = overlap_shares(points_of(frame), [view(0)], replace(SETTINGS, border_share=border / CAMERA.width))
    assert bordered[0] == pytest.approx(inner, abs=1e-9)


def test_overlap_falls_as_views_turn_away() -> None:
    points = points_of(SmoothRoom().frame(np.eye(4), CAMERA))
    views = [view(k, angle_rad=0.2 * k) for k in range(4)] + [view(4, angle_rad=np.pi)]
    shares = overlap_shares(points, views, SETTINGS)
    assert (np.diff(shares) < 0).all()
    assert shares[-1] == 0.0


def test_occluded_points_and_holes_are_not_seen() -> None:
    frame = SmoothRoom().frame(np.eye(4), CAMERA)
    depth = frame.depth.copy()
    depth[10:20, 10:20] //= 2  # something stood in front of the view
    depth[30:40, 30:40] = 0
    seen = seen_by_view(
        points_of(frame),
        T_world_view=np.eye(4),
        view_depth=depth,
        depth_scale_m=frame.depth_scale_m,
        camera=CAMERA,
        tolerance=0.01,
        border_px=0.0,
    ).reshape(frame.depth.shape)
    assert not seen[10:20, 10:20].any()
    assert not seen[30:40, 30:40].any()
    assert seen[:9].all()
    assert seen[42:].all()


def test_no_points_overlap_with_nothing() -> None:
    np.testing.assert_array_equal(overlap_shares(np.zeros((0, 3)), [view(0), view(1)], SETTINGS), [0.0, 0.0])
    assert overlap_shares(np.ones((4, 3)), [], SETTINGS).shape == (0,)


def test_more_points_than_one_image_row_are_sampled_alike() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-1, -1, 1], [1, 1, 3], (3000, 3))
    frame = SmoothRoom().frame(np.eye(4), CAMERA)

    def seen(some: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        return seen_by_view(
            some,
            T_world_view=np.eye(4),
            view_depth=frame.depth,
            depth_scale_m=frame.depth_scale_m,
            camera=CAMERA,
            tolerance=0.3,
            border_px=1.0,
        )

    whole = seen(points)
    assert 100 < whole.sum() < 2900
    np.testing.assert_array_equal(whole, np.concatenate([seen(part) for part in np.array_split(points, 7)]))

"""The fixed parts of the tracking mask."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import mapped_section, without_depth
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.overlap.selection import world_points_m
from vtslam.services.tracker.masks import mean_depth_m, near_and_valid, visible_in_section

CAMERA = small_camera()
ROOM = SmoothRoom()


def turned(angle_rad: float) -> npt.NDArray[np.float64]:
    return se3.exp(np.array([0, 0, 0, 0, angle_rad, 0]))


def with_depth(depth_m: npt.NDArray[np.float64]) -> Frame:
    frame = ROOM.frame(np.eye(4), CAMERA)
    return replace(frame, depth=np.rint(depth_m / frame.depth_scale_m).astype(np.uint16))


def test_mean_depth_is_of_valid_pixels() -> None:
    depth_m = np.zeros((48, 64))
    depth_m[:10], depth_m[10:20] = 2.0, 4.0
    assert mean_depth_m(with_depth(depth_m)) == pytest.approx(3.0)
    assert mean_depth_m(with_depth(np.zeros((48, 64)))) == 0.0


def test_far_filter_leaves_out_what_is_beyond_the_usual_depth() -> None:
    depth_m = np.full((48, 64), 2.0)
    depth_m[:5], depth_m[5:10] = 0.0, 5.0
    frame = with_depth(depth_m)
    near = near_and_valid(frame, far_factor=1.5, largest_mean_depths_m=(3.0, 2.0))
    np.testing.assert_array_equal(near, depth_m == 2.0)
    # No factor, or nothing seen yet: every valid pixel.
    np.testing.assert_array_equal(near_and_valid(frame, far_factor=0.0, largest_mean_depths_m=(1.0,)), depth_m > 0)
    np.testing.assert_array_equal(near_and_valid(frame, far_factor=1.5, largest_mean_depths_m=()), depth_m > 0)


def test_points_keep_the_order_of_the_masks_pixels() -> None:
    frame = ROOM.frame(turned(0.3), CAMERA)
    mask = np.zeros(frame.depth.shape, np.bool_)
    mask[3, 4], mask[20, 30] = True, True
    points = world_points_m(frame, turned(0.3), mask)
    local = points @ turned(0.3)[:3, :3]
    np.testing.assert_allclose(CAMERA.projected(local), [[4.5, 3.5], [30.5, 20.5]], atol=1e-5)


def test_a_pixel_is_visible_if_the_first_middle_or_last_frame_saw_it() -> None:
    angles = [0.0, 0.0, 0.0, 0.35, 0.7, 0.7]  # rows 0, 3 (middle) and 5 (last) decide
    poses = [turned(a) for a in angles]
    section = mapped_section([ROOM.frame(T, CAMERA, frame_id=i) for i, T in enumerate(poses)], poses)
    assert [f.view_depth is not None for f in section.frames] == [True, False, False, True, False, True]

    def share(angle_rad: float) -> float:
        frame = ROOM.frame(turned(angle_rad), CAMERA)
        return float(visible_in_section(frame, turned(angle_rad), section, tolerance=0.01).mean())

    assert share(0.0) > 0.95
    assert share(0.35) > 0.95
    assert share(0.7) > 0.95
    assert 0.2 < share(1.1) < 0.8  # the last frame saw part of it
    assert share(np.pi) == 0.0
    only_first = replace(section, frames=tuple(replace(f, view_depth=None) for f in section.frames[1:]))
    only_first = replace(section, frames=(section.frames[0], *only_first.frames))
    frame = ROOM.frame(turned(0.7), CAMERA)
    assert visible_in_section(frame, turned(0.7), only_first, tolerance=0.01).mean() < 0.5


def test_what_stands_before_the_surface_is_not_visible() -> None:
    section = mapped_section([ROOM.frame(np.eye(4), CAMERA)], [np.eye(4)])
    frame = ROOM.frame(np.eye(4), CAMERA)
    depth = frame.depth.copy()
    depth[10:20, 10:30] -= 1000
    depth[40:, :] = 0
    visible = visible_in_section(replace(frame, depth=depth), np.eye(4), section, tolerance=0.01)
    expected = depth == frame.depth
    np.testing.assert_array_equal(visible[1:-1, 1:-1], expected[1:-1, 1:-1])
    assert not visible_in_section(without_depth(frame), np.eye(4), section, tolerance=0.01).any()

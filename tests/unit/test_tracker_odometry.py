"""RGB-D odometry, the rescue when the guess is far off."""

import numpy as np
import pytest
from helpers.small_map import pose_error, room_frame, room_pose, without_depth

from vtslam.common.geometry import se3
from vtslam.services.tracker.odometry import rgbd_odometry


@pytest.mark.parametrize("later", [1, 3])
def test_motion_between_two_frames(later: int) -> None:
    true = room_pose(later)
    found = rgbd_odometry(room_frame(0), room_frame(later))
    assert found is not None
    assert se3.is_rigid(found, tolerance=1e-9)
    metres, degrees = pose_error(found, true)
    assert metres < 0.2 * pose_error(np.eye(4), true)[0]
    assert degrees < 0.2 * pose_error(np.eye(4), true)[1]


def test_frames_without_depth_have_no_odometry() -> None:
    empty = without_depth(room_frame(0))
    assert rgbd_odometry(empty, room_frame(1)) is None
    assert rgbd_odometry(room_frame(1), empty) is None
    assert rgbd_odometry(empty, empty) is None


def test_the_frames_stay_as_they_were() -> None:
    before, after = room_frame(0), room_frame(1)
    copies = (before.rgb.copy(), before.depth.copy(), after.rgb.copy(), after.depth.copy())
    rgbd_odometry(before, after)
    for array, copy in zip((before.rgb, before.depth, after.rgb, after.depth), copies, strict=True):
        np.testing.assert_array_equal(array, copy)

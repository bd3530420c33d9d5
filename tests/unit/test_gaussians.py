"""View-tied Gaussians: where they lie, how large they are, and what moves them."""

from dataclasses import fields, replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.frame import Frame
from vtslam.common.gaussians import ViewTiedGaussians, edge_mask, tied_to_frame
from vtslam.common.geometry import se3

CAMERA = small_camera(20, 14)
FACTOR = 1.005


def frame_with_holes() -> Frame:
    frame = SmoothRoom().frame(se3.exp(np.array([0.1, -0.2, 0.3, 0.2, 0.4, -0.1])), CAMERA)
    depth = frame.depth.copy()
    depth[2:4, 5:9] = 0
    return replace(frame, depth=depth)


def tied(
    frame: Frame, *, edges: npt.NDArray[np.bool_] | None = None, frame_index: int = 0, radius_factor: float = 1.0
) -> ViewTiedGaussians:
    return tied_to_frame(
        frame,
        np.ones(frame.depth.shape, np.bool_),
        frame_index=frame_index,
        depth_factor=FACTOR,
        opacity=0.5,
        radius_factor=radius_factor,
        edges=edges,
    )


def test_one_gaussian_per_pixel_with_depth_in_row_order() -> None:
    frame = frame_with_holes()
    gaussians = tied(frame)
    assert gaussians.count == np.count_nonzero(frame.depth) == CAMERA.width * CAMERA.height - 8
    np.testing.assert_array_equal(gaussians.pixel, np.flatnonzero(frame.depth))
    np.testing.assert_array_equal(gaussians.depth, frame.depth[frame.depth > 0])
    np.testing.assert_array_equal(gaussians.colors, frame.rgb_float()[frame.depth > 0])
    assert not gaussians.subpixel.any()


def test_the_mask_decides_where_gaussians_are_wanted() -> None:
    frame = frame_with_holes()
    mask = np.zeros(frame.depth.shape, np.bool_)
    mask[2, :] = True
    gaussians = tied_to_frame(frame, mask, frame_index=0, depth_factor=1.0, opacity=0.5)
    np.testing.assert_array_equal(gaussians.pixel, np.flatnonzero(mask & (frame.depth > 0)))
    assert gaussians.count == CAMERA.width - 4


def test_positions_project_back_to_the_centre_of_their_pixel() -> None:
    frame = frame_with_holes()
    gaussians = tied(frame)
    points = gaussians.points_frame_m(CAMERA, depth_unit_m=frame.depth_scale_m * FACTOR)
    rows, columns = np.nonzero(frame.depth)
    np.testing.assert_allclose(CAMERA.projected(points), np.stack([columns + 0.5, rows + 0.5], axis=1), atol=1e-12)
    np.testing.assert_allclose(points[:, 2], frame.depth[rows, columns] * frame.depth_scale_m * FACTOR, rtol=1e-15)


def test_edge_supplement_adds_four_half_size_gaussians_at_quarter_pixels() -> None:
    frame = frame_with_holes()
    edges = np.zeros(frame.depth.shape, np.bool_)
    edges[2, 4:6] = True  # the second of the two has no depth
    edges[9, 11] = True
    base, gaussians = tied(frame), tied(frame, edges=edges)
    assert gaussians.count == base.count + 8
    added = slice(base.count, None)
    points = gaussians.points_frame_m(CAMERA, depth_unit_m=frame.depth_scale_m)
    offsets = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
    expected = np.concatenate([np.array([4, 2]) + offsets, np.array([11, 9]) + offsets])
    np.testing.assert_allclose(CAMERA.projected(points[added]), expected, atol=1e-12)
    own = [int(np.flatnonzero(base.pixel == p)[0]) for p in (2 * CAMERA.width + 4, 9 * CAMERA.width + 11)]
    np.testing.assert_allclose(
        np.exp(gaussians.log_radii[added]), np.repeat(0.5 * np.exp(base.log_radii[own]), 4), rtol=1e-6
    )
    np.testing.assert_array_equal(gaussians.colors[added], np.repeat(base.colors[own], 4, axis=0))
    for field in fields(base):
        np.testing.assert_array_equal(getattr(gaussians, field.name)[: base.count], getattr(base, field.name))


@pytest.mark.parametrize("radius_factor", [1.0, 0.5])
def test_sigma_is_depth_over_focal_length(radius_factor: float) -> None:
    frame = frame_with_holes()
    gaussians = tied(frame, radius_factor=radius_factor)
    sigma_m = radius_factor * FACTOR * frame.depth_m()[frame.depth > 0] / (0.5 * (CAMERA.fx + CAMERA.fy))
    np.testing.assert_allclose(np.exp(gaussians.log_radii), sigma_m, rtol=1e-6)


def test_opacity_is_stored_as_a_logit() -> None:
    frame = frame_with_holes()
    for opacity in (0.5, 0.95):
        gaussians = tied_to_frame(frame, frame.depth > 0, frame_index=0, depth_factor=1.0, opacity=opacity)
        np.testing.assert_allclose(1.0 / (1.0 + np.exp(-gaussians.opacity_logits)), opacity, rtol=1e-6)


def test_a_frames_pose_moves_its_gaussians_and_no_others() -> None:
    frame = frame_with_holes()
    gaussians = tied(frame).appended(tied(frame, frame_index=1)).appended(tied(frame, frame_index=2))
    poses = np.stack([np.eye(4), se3.exp(np.array([0.1, 0, 0, 0, 0.2, 0])), se3.exp(np.array([0, 0.3, 0, 0.1, 0, 0]))])
    before = gaussians.means_m(CAMERA, poses, depth_unit_m=frame.depth_scale_m)
    moved = poses.copy()
    motion = se3.exp(np.array([0.02, -0.01, 0.03, 0.01, 0.02, 0.03]))
    moved[1] = motion @ poses[1]
    after = gaussians.means_m(CAMERA, moved, depth_unit_m=frame.depth_scale_m)
    own = gaussians.frame_index == 1
    np.testing.assert_array_equal(after[~own], before[~own])
    np.testing.assert_allclose(after[own], before[own] @ motion[:3, :3].T + motion[:3, 3], atol=1e-6)


def test_appended_rows_keep_their_index() -> None:
    first, second = tied(frame_with_holes()), tied(frame_with_holes(), frame_index=3)
    both = first.appended(second)
    assert both.count == first.count + second.count
    for field in fields(both):
        column = getattr(both, field.name)
        assert column.dtype == getattr(first, field.name).dtype
        np.testing.assert_array_equal(column[: first.count], getattr(first, field.name))
        np.testing.assert_array_equal(column[first.count :], getattr(second, field.name))
    unchanged = ViewTiedGaussians.empty().appended(first)
    assert all(
        getattr(unchanged, f.name).tobytes() == getattr(first, f.name).tobytes()
        and getattr(unchanged, f.name).dtype == getattr(first, f.name).dtype
        for f in fields(first)
    )


def test_empty_has_no_positions() -> None:
    empty = ViewTiedGaussians.empty()
    assert empty.count == 0
    assert empty.means_m(CAMERA, np.zeros((0, 4, 4)), depth_unit_m=1.0).shape == (0, 3)


def test_a_tie_to_what_is_not_there_is_refused() -> None:
    gaussians = tied(frame_with_holes(), frame_index=2)
    with pytest.raises(IndexError, match="not there"):
        gaussians.means_m(CAMERA, np.stack([np.eye(4)] * 2), depth_unit_m=0.001)
    with pytest.raises(IndexError, match="not there"):
        replace(gaussians, subpixel=np.full_like(gaussians.subpixel, 5)).means_m(
            CAMERA, np.stack([np.eye(4)] * 3), depth_unit_m=0.001
        )
    with pytest.raises(ValueError, match="different lengths"):
        replace(gaussians, depth=gaussians.depth[1:]).means_m(CAMERA, np.stack([np.eye(4)] * 3), depth_unit_m=0.001)


def test_other_attributes_keep_the_ties() -> None:
    gaussians = tied(frame_with_holes())
    other = gaussians.with_attributes(
        colors=gaussians.colors + 1, log_radii=gaussians.log_radii - 1, opacity_logits=gaussians.opacity_logits + 2
    )
    for name in ("frame_index", "pixel", "subpixel", "depth"):
        assert getattr(other, name) is getattr(gaussians, name)
    np.testing.assert_array_equal(other.colors, gaussians.colors + 1)
    np.testing.assert_array_equal(other.log_radii, gaussians.log_radii - 1)
    np.testing.assert_array_equal(other.opacity_logits, gaussians.opacity_logits + 2)


def test_edges_are_found_at_a_step_and_nowhere_on_a_plain_image() -> None:
    rgb = np.full((30, 40, 3), 90, np.uint8)
    assert not edge_mask(rgb, low=50, high=200).any()
    rgb[:, 20:] = 200
    mask = edge_mask(rgb, low=50, high=200)
    assert mask[5:25, 19:21].all()
    assert not mask[:, :17].any()
    assert not mask[:, 23:].any()

"""A section: positions follow its frames, and several sections join in the coordinates of one."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.smooth_room import SmoothRoom, small_camera

from vtslam.common.gaussians import ViewTiedGaussians, tied_to_frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.optim.surface import measured_surface
from vtslam.common.rows import GrowingRows
from vtslam.common.section import Section, SectionFrame, joined_splats
from vtslam.common.splat.native_engine import NativeEngine

CAMERA = small_camera(24, 18)
START = se3.exp(np.array([0.2, 0.1, -0.3, 0.1, -0.4, 0.2]))
STEP = se3.exp(np.array([0.03, -0.02, 0.01, 0.02, 0.05, -0.01]))


def small_section(section_id: int = 0, T_world_section: npt.NDArray[np.float64] = START) -> Section:
    frames, gaussians = [], None
    for row in range(2):
        T_section_frame = np.linalg.matrix_power(STEP, row)
        frame = SmoothRoom().frame(T_world_section @ T_section_frame, CAMERA, frame_id=row)
        new = tied_to_frame(frame, frame.depth > 0, frame_index=row, depth_factor=1.01, opacity=0.9)
        gaussians = new if gaussians is None else gaussians.appended(new)
        frames.append(
            SectionFrame(
                frame_id=row,
                capture_time_ns=row,
                T_section_frame=T_section_frame,
                view_depth=None if row else frame.depth,
            )
        )
    assert gaussians is not None
    return Section(
        section_id=section_id,
        T_world_section=T_world_section,
        camera=CAMERA,
        depth_scale_m=frame.depth_scale_m,
        depth_factor=1.01,
        frames=tuple(frames),
        gaussians=gaussians,
        means_m=np.zeros((0, 3), np.float32),
        surface=np.zeros((0, 6), np.float32),
    ).retied()


def third_frame() -> tuple[SectionFrame, ViewTiedGaussians]:
    """What a small section grows by; the frame keeps its depth."""
    frame = SmoothRoom().frame(START @ STEP @ STEP, CAMERA, frame_id=2)
    new = tied_to_frame(frame, frame.depth > 0, frame_index=2, depth_factor=1.01, opacity=0.9)
    return SectionFrame(frame_id=2, capture_time_ns=2, T_section_frame=STEP @ STEP, view_depth=frame.depth), new


def test_positions_are_recomputed_from_the_frame_table() -> None:
    section = small_section()
    assert section.depth_unit_m == section.depth_scale_m * 1.01
    half = section.gaussians.count // 2
    points = section.gaussians.points_frame_m(CAMERA, depth_unit_m=section.depth_unit_m)
    np.testing.assert_allclose(section.means_m[:half], points[:half], atol=1e-6)
    np.testing.assert_allclose(section.means_m[half:], points[half:] @ STEP[:3, :3].T + STEP[:3, 3], atol=1e-6)
    moved = replace(section.frames[1], T_section_frame=STEP @ STEP)
    after = replace(section, frames=(section.frames[0], moved)).retied()
    np.testing.assert_array_equal(after.means_m[:half], section.means_m[:half])
    assert np.abs(after.means_m[half:] - section.means_m[half:]).max() > 0.01


def test_growing_gives_the_same_as_tying_anew() -> None:
    section = small_section()
    row, new = third_frame()
    grown = section.grown(row, new)
    own = section.gaussians.count
    assert grown.gaussians.count == own + new.count
    assert [f.frame_id for f in grown.frames] == [0, 1, 2]
    assert grown.means_m[:own].tobytes() == section.means_m.tobytes()
    again = grown.retied()
    assert again.means_m.tobytes() == grown.means_m.tobytes()
    assert again.surface.tobytes() == grown.surface.tobytes()
    assert len(grown.surface) > len(section.surface) > 0


@pytest.mark.parametrize("knew_its_depth", [False, True])
def test_a_finished_section_is_as_it_will_be_read_back(knew_its_depth: bool) -> None:
    section = small_section()
    depth = SmoothRoom().frame(START @ STEP, CAMERA, frame_id=1).depth
    last = replace(section.frames[1], view_depth=depth if knew_its_depth else None)
    grown = replace(section, frames=(section.frames[0], last)).retied()
    finished = grown.finished(1, depth)
    anew = replace(finished, means_m=np.zeros((0, 3), np.float32)).retied()
    assert finished.surface.tobytes() == anew.surface.tobytes()
    assert len(finished.surface) > len(section.surface)
    assert finished.means_m.tobytes() == anew.means_m.tobytes()


def test_what_is_known_of_a_former_state_gives_the_same_as_tying_anew() -> None:
    section = small_section()
    row, new = third_frame()
    grown = section.grown(row, new)
    bare = replace(grown, means_m=np.zeros((0, 3), np.float32), surface=np.zeros((0, 6), np.float32))
    for later in (bare.continued(section, GrowingRows(section.means_m)), bare.retied(section), bare.retied(grown)):
        assert later.means_m.tobytes() == grown.means_m.tobytes()
        assert later.surface.tobytes() == grown.surface.tobytes()
    # The last frame may keep its depth only when the section is finished.
    open_end = replace(grown, frames=(*grown.frames[:2], replace(row, view_depth=None))).retied()
    assert row.view_depth is not None
    finished = open_end.finished(2, row.view_depth)
    assert finished.retied(open_end).surface.tobytes() == finished.surface.tobytes() == grown.surface.tobytes()


def test_the_surface_is_what_the_views_with_depth_measured() -> None:
    section = small_section()
    points, normals = section.surface[:, :3], section.surface[:, 3:]
    assert len(section.surface) > 50
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
    room = SmoothRoom()
    world = points @ START[:3, :3].T + START[:3, 3]
    np.testing.assert_allclose(np.square(world / room.radii_m).sum(axis=1), 1.0, atol=1e-3)
    # The image is small: estimates that look at several pixels see the surface bend.
    assert np.abs((room.normals(world) @ START[:3, :3] * normals).sum(axis=1)).min() > 0.9
    blind = replace(section, frames=tuple(replace(f, view_depth=None) for f in section.frames)).retied()
    assert blind.surface.shape == (0, 6)
    assert blind.means_m.tobytes() == section.means_m.tobytes()


def test_the_anchor_moves_the_world_pose_of_every_frame_but_no_position() -> None:
    section = small_section()
    lifted = replace(section, T_world_section=STEP @ START).retied()
    assert lifted.means_m.tobytes() == section.means_m.tobytes()
    np.testing.assert_allclose(lifted.T_world_frame(1), STEP @ START @ STEP, atol=1e-12)
    np.testing.assert_allclose(section.T_world_frame(0), START, atol=1e-12)
    assert section.head is section.frames[0]


def test_world_and_section_poses_are_inverse_to_each_other() -> None:
    section = small_section()
    np.testing.assert_allclose(section.T_section_camera(section.T_world_frame(1)), STEP, atol=1e-12)


def test_joined_sections_keep_their_world_positions_and_order() -> None:
    first, second = small_section(), small_section(1, STEP @ START)
    joined = joined_splats([second, first], into=second)
    assert joined.count == first.gaussians.count + second.gaussians.count
    own = second.gaussians.count
    np.testing.assert_allclose(joined.means_m[:own], second.means_m, atol=1e-6)
    np.testing.assert_array_equal(joined.colors[own:], first.gaussians.colors)
    np.testing.assert_array_equal(joined.log_radii[own:], first.gaussians.log_radii)
    np.testing.assert_array_equal(joined.opacity_logits[own:], first.gaussians.opacity_logits)
    T = se3.inverse(second.T_world_section) @ first.T_world_section
    np.testing.assert_allclose(joined.means_m[own:], first.means_m @ T[:3, :3].T + T[:3, 3], atol=1e-5)


def test_a_section_far_from_the_worlds_origin_renders_the_same() -> None:
    far = np.eye(4)
    far[:3, 3] = [1e5, -2e5, 3e3]
    engine = NativeEngine(threads=1)
    images = []
    for offset in (np.eye(4), far):
        first = small_section()
        sections = [replace(first, T_world_section=offset @ first.T_world_section)]
        second = small_section(1, STEP @ START)
        sections.append(replace(second, T_world_section=offset @ second.T_world_section))
        joined = joined_splats(sections, into=sections[1])
        images.append(engine.render(joined, CAMERA, np.eye(4)).rgb)
    np.testing.assert_allclose(images[1], images[0], atol=2e-4)


def test_wider_images_have_no_more_surface_points() -> None:
    counts = []
    for width in (320, 640, 1280):
        camera = Camera(width=width, height=width * 3 // 4, fx=width, fy=width, cx=width / 2, cy=width * 3 / 8)
        wall = np.full((camera.height, camera.width), 2000, np.uint16)
        counts.append(len(measured_surface(wall, camera, np.eye(4), depth_scale_m=0.001)))
    assert counts[0] > 0.9 * 160 * 120
    assert max(counts) < 1.05 * min(counts)

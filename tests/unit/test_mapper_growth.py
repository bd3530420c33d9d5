"""Where the mapper adds Gaussians, what it records, and what it leaves alone."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import (
    SMALL_MAPPER,
    pose_error,
    room_frame,
    room_pose,
    room_section,
    section_bytes,
    small_mapper,
    without_depth,
)

from vtslam.common.frame import Frame
from vtslam.common.gaussians import edge_mask
from vtslam.common.geometry import se3
from vtslam.common.settings import MapperSettings
from vtslam.services.mapper.core import Mapper
from vtslam.services.mapper.state import ActiveSection, CommitRecord

NO_STEPS = replace(SMALL_MAPPER, iterations_head=0, iterations_regular=0, iterations_seal=0)


def opened(settings: MapperSettings, *, frame: Frame | None = None) -> tuple[Mapper, ActiveSection, CommitRecord]:
    mapper = small_mapper(settings)
    active, record = mapper.map_head(frame or room_frame(0), room_pose(0), section_id=0, neighbours=[])
    return mapper, active, record


def with_hole(frame: Frame) -> Frame:
    depth = frame.depth.copy()
    depth[10:20, 30:50] = 0
    return replace(frame, depth=depth)


def active_bytes(active: ActiveSection) -> bytes:
    moments = active.moments
    states = [] if moments is None else [moments.colors, moments.log_radii, moments.opacity_logits]
    arrays = [array for state in states for array in (state.m, state.v)]
    counts = repr([state.step_count for state in states])
    views = repr([(view.frame_index, view.frame.frame_id) for view in active.views])
    return section_bytes(active.section) + b"".join(a.tobytes() for a in arrays) + (counts + views).encode()


def test_a_head_gets_a_gaussian_at_every_pixel_with_depth() -> None:
    frame = with_hole(room_frame(0))
    _, active, record = opened(NO_STEPS, frame=frame)
    valid = np.count_nonzero(frame.depth)
    assert valid == 80 * 60 - 200
    assert record.gaussians_added == record.gaussians == active.section.gaussians.count == valid
    np.testing.assert_array_equal(active.section.gaussians.pixel, np.flatnonzero(frame.depth))
    assert not active.section.gaussians.frame_index.any()
    assert active.section.means_m.shape == (valid, 3)


def test_the_edge_supplement_adds_four_on_edges() -> None:
    settings = replace(NO_STEPS, edge_supplement=True)
    frame = with_hole(room_frame(0))
    _, active, record = opened(settings, frame=frame)
    edges = edge_mask(frame.rgb, low=settings.edge_low, high=settings.edge_high) & (frame.depth > 0)
    assert 50 < np.count_nonzero(edges) < frame.depth.size
    assert record.gaussians == np.count_nonzero(frame.depth) + 4 * np.count_nonzero(edges)
    extra = active.section.gaussians.subpixel > 0
    np.testing.assert_array_equal(np.unique(active.section.gaussians.pixel[extra]), np.flatnonzero(edges))


def test_gaussians_that_others_cover_in_their_own_frame_are_dropped() -> None:
    settings = replace(SMALL_MAPPER, edge_supplement=True, initial_opacity=0.95, iterations_head=1)
    _, every, _ = opened(settings)
    _, active, record = opened(replace(settings, least_weight=0.02))
    assert record.gaussians_added == record.gaussians == active.section.gaussians.count
    assert active.section.means_m.shape == (record.gaussians, 3)
    assert record.gaussians < 0.9 * every.section.gaussians.count
    engine, camera = small_mapper(settings).engine, room_frame(0).camera
    full = engine.render(every.section.splats, camera, np.eye(4))
    thinned = engine.render(active.section.splats, camera, np.eye(4))
    assert np.abs(full.rgb - thinned.rgb).mean() < 0.005
    kept = {row.tobytes() for row in every.section.gaussians.colors}
    assert all(row.tobytes() in kept for row in active.section.gaussians.colors)


def test_only_the_new_frames_gaussians_can_be_dropped_and_their_moments_follow() -> None:
    settings = replace(
        SMALL_MAPPER, keep_moments=True, least_weight=0.1, iterations_head=2, edge_supplement=True, initial_opacity=0.95
    )
    mapper, active, _ = opened(settings)
    before = active.section.gaussians.count
    grown, record = mapper.map_regular(room_frame(4), room_pose(4), active, neighbours=[])
    gaussians = grown.section.gaussians
    assert np.count_nonzero(gaussians.frame_index == 0) == before
    assert 0 < record.gaussians_added == gaussians.count - before
    free, unpruned = small_mapper(replace(settings, least_weight=0.0)).map_regular(
        room_frame(4), room_pose(4), active, neighbours=[]
    )
    assert unpruned.gaussians_added > record.gaussians_added
    assert free.section.gaussians.count == before + unpruned.gaussians_added
    assert grown.moments is not None
    assert grown.moments.colors.m.shape == (gaussians.count, 3)


def test_a_regular_frame_adds_where_the_section_shows_nothing() -> None:
    mapper, active, _ = opened(NO_STEPS)
    pose = room_pose(4)
    rendering = mapper.engine.render(active.section.splats, room_frame(0).camera, se3.inverse(pose))
    uncovered = rendering.alpha < mapper.settings.uncovered_silhouette
    assert 50 < np.count_nonzero(uncovered) < 2000
    plain = replace(NO_STEPS, uncovered_depth_factor=0.0)
    grown, record = small_mapper(plain).map_regular(room_frame(4), pose, active, neighbours=[])
    new = grown.section.gaussians.frame_index == 1
    np.testing.assert_array_equal(grown.section.gaussians.pixel[new], np.flatnonzero(uncovered))
    assert record.gaussians_added == np.count_nonzero(new) == np.count_nonzero(uncovered)
    assert record.gaussians == active.section.gaussians.count + record.gaussians_added


def test_the_same_view_again_adds_nothing() -> None:
    mapper, active, _ = opened(SMALL_MAPPER)
    _, record = mapper.map_regular(room_frame(0), room_pose(0), active, neighbours=[])
    assert record.gaussians_added == 0


def test_something_new_in_front_of_the_map_is_added_by_its_depth() -> None:
    mapper, active, _ = opened(replace(NO_STEPS, uncovered_depth_factor=10.0))
    frame = room_frame(0)
    depth = frame.depth.copy()
    depth[20:30, 20:30] = depth[20:30, 20:30] // 3
    in_front = replace(frame, depth=depth)
    grown, record = mapper.map_regular(in_front, room_pose(0), active, neighbours=[])
    assert record.gaussians_added > 90
    box = np.zeros(depth.shape, np.bool_)
    box[20:30, 20:30] = True
    added = grown.section.gaussians.pixel[grown.section.gaussians.frame_index == 1]
    assert box.reshape(-1)[added].all()
    never = small_mapper(replace(NO_STEPS, uncovered_depth_factor=0.0))
    assert never.map_regular(in_front, room_pose(0), active, neighbours=[])[1].gaussians_added == 0


def test_what_lies_behind_the_map_is_not_added() -> None:
    mapper, active, _ = opened(replace(NO_STEPS, uncovered_depth_factor=10.0))
    frame = room_frame(0)
    depth = frame.depth.copy()
    depth[20:30, 20:30] *= 2
    _, record = mapper.map_regular(replace(frame, depth=depth), room_pose(0), active, neighbours=[])
    assert record.gaussians_added == 0


def test_rows_of_older_frames_keep_their_ties_and_places() -> None:
    mapper, active, _ = opened(SMALL_MAPPER)
    grown, _ = mapper.map_regular(room_frame(3), room_pose(3), active, neighbours=[])
    old, count = active.section, active.section.gaussians.count
    for name in ("frame_index", "pixel", "subpixel", "depth"):
        np.testing.assert_array_equal(getattr(grown.section.gaussians, name)[:count], getattr(old.gaussians, name))
    assert grown.section.means_m[:count].tobytes() == old.means_m.tobytes()


def test_poses_are_committed_as_tracked() -> None:
    mapper, active, record = opened(SMALL_MAPPER)
    np.testing.assert_allclose(record.T_world_camera, room_pose(0), atol=1e-12)
    grown, record = mapper.map_regular(room_frame(2), room_pose(2), active, neighbours=[])
    assert pose_error(record.T_world_camera, room_pose(2))[0] < 1e-9
    assert (record.frame_id, record.section_id, record.frame_index, record.held_out) == (2, 0, 1, False)
    assert [f.frame_id for f in grown.section.frames] == [0, 2]
    assert record.renders >= record.iterations == SMALL_MAPPER.iterations_regular


def test_held_out_frames_teach_nothing() -> None:
    mapper, active, _ = opened(SMALL_MAPPER)
    frame = room_frame(4)
    grown, record = mapper.map_regular(frame, room_pose(4), active, neighbours=[], held_out=True)
    assert record.held_out
    assert record.gaussians_added == 0
    assert [view.frame.frame_id for view in grown.views] == [0]
    assert [f.frame_id for f in grown.section.frames] == [0, 4]
    # Its images make no difference at all.
    noise = replace(frame, rgb=255 - frame.rgb, depth=frame.depth // 2)
    other, _ = mapper.map_regular(noise, room_pose(4), active, neighbours=[], held_out=True)
    assert active_bytes(replace(other, section=replace(other.section, frames=()))) == active_bytes(
        replace(grown, section=replace(grown.section, frames=()))
    )


@pytest.mark.parametrize("keep_moments", [False, True])
def test_inputs_are_not_changed(keep_moments: bool) -> None:
    settings = replace(SMALL_MAPPER, keep_moments=keep_moments, iterations_seal=3)
    neighbour = room_section(3, 3, section_id=0)
    mapper = small_mapper(settings)
    frames = [room_frame(6), room_frame(7)]
    images = [(f.rgb.copy(), f.depth.copy()) for f in frames]
    before_neighbour = section_bytes(neighbour)
    active, _ = mapper.map_head(frames[0], room_pose(6), section_id=1, neighbours=[neighbour])
    before = active_bytes(active)
    grown, _ = mapper.map_regular(frames[1], room_pose(7), active, neighbours=[neighbour])
    assert active_bytes(active) == before
    before_grown = active_bytes(grown)
    mapper.seal(grown, neighbours=[neighbour])
    assert active_bytes(grown) == before_grown
    assert section_bytes(neighbour) == before_neighbour
    for frame, (rgb, depth) in zip(frames, images, strict=True):
        np.testing.assert_array_equal(frame.rgb, rgb)
        np.testing.assert_array_equal(frame.depth, depth)


def test_sealing_keeps_rows_and_gives_the_last_view_its_depth() -> None:
    settings = replace(SMALL_MAPPER, iterations_seal=5)
    mapper, active, _ = opened(settings)
    for index in range(1, 6):
        active, _ = mapper.map_regular(room_frame(index), room_pose(index), active, neighbours=[])
    section, renders = mapper.seal(active, neighbours=[])
    for name in ("frame_index", "pixel", "subpixel", "depth"):
        np.testing.assert_array_equal(getattr(section.gaussians, name), getattr(active.section.gaussians, name))
    assert section.means_m.tobytes() == active.section.means_m.tobytes()
    assert renders >= 5
    assert (section.gaussians.colors != active.section.gaussians.colors).any()
    # Heads and every third frame answer overlap questions; first, middle and last frame answer visibility.
    assert [f.view_depth is not None for f in section.frames] == [True, False, False, True, False, True]
    np.testing.assert_array_equal(section.frames[5].view_depth, room_frame(5).depth)


def test_sealing_drops_what_none_of_the_frames_shows() -> None:
    settings = replace(SMALL_MAPPER, edge_supplement=True, initial_opacity=0.95, iterations_seal=6)
    mapper, active, _ = opened(settings)
    for index in (1, 2):
        active, _ = mapper.map_regular(room_frame(index), room_pose(index), active, neighbours=[])
    every, _ = mapper.seal(active, neighbours=[])
    seen, renders = small_mapper(replace(settings, least_weight_sealed=0.05)).seal(active, neighbours=[])
    assert renders == settings.iterations_seal
    assert 0.5 * every.gaussians.count < seen.gaussians.count < 0.95 * every.gaussians.count
    assert seen.means_m.shape == (seen.gaussians.count, 3)
    kept = {row.tobytes() for row in every.means_m}
    assert all(row.tobytes() in kept for row in seen.means_m)
    for view in active.views:
        T_camera_section = se3.inverse(every.frames[view.frame_index].T_section_frame)
        full = mapper.engine.render(every.splats, view.frame.camera, T_camera_section)
        thinned = mapper.engine.render(seen.splats, view.frame.camera, T_camera_section)
        assert np.abs(full.rgb - thinned.rgb).mean() < 0.005


def test_sealing_without_steps_changes_no_attribute() -> None:
    mapper, active, _ = opened(SMALL_MAPPER)
    section, renders = mapper.seal(active, neighbours=[])
    assert renders == 0
    assert section.gaussians.colors.tobytes() == active.section.gaussians.colors.tobytes()


def test_frames_without_depth_pass_through() -> None:
    settings = replace(SMALL_MAPPER, iterations_seal=2, edge_supplement=True)
    empty = without_depth(room_frame(0))
    mapper, active, record = opened(settings, frame=empty)
    assert (record.gaussians, record.renders, record.loss) == (0, 0, 0.0)
    active, record = mapper.map_regular(without_depth(room_frame(1)), room_pose(1), active, neighbours=[])
    assert record.gaussians == 0
    # The first frame with depth fills the section.
    active, record = mapper.map_regular(room_frame(2), room_pose(2), active, neighbours=[])
    assert record.gaussians_added >= 80 * 60
    active, record = mapper.map_regular(without_depth(room_frame(3)), room_pose(3), active, neighbours=[])
    assert record.gaussians_added == 0
    assert np.isfinite(record.loss)
    section, _ = mapper.seal(active, neighbours=[])
    assert len(section.frames) == 4
    assert np.isfinite(section.gaussians.log_radii).all()


def test_an_empty_section_can_be_sealed() -> None:
    mapper, active, _ = opened(replace(SMALL_MAPPER, iterations_seal=4), frame=without_depth(room_frame(0)))
    section, renders = mapper.seal(active, neighbours=[])
    assert (section.gaussians.count, renders) == (0, 0)


def test_depth_factor_moves_gaussians_along_their_rays() -> None:
    _, near, _ = opened(NO_STEPS)
    _, far, _ = opened(replace(NO_STEPS, depth_factor=1.005))
    np.testing.assert_allclose(far.section.means_m, near.section.means_m * 1.005, rtol=1e-6)
    assert far.section.depth_factor == 1.005


def chosen_views(mapper: Mapper, frame_id: int) -> npt.NDArray[np.int64]:
    return mapper._random_views(frame_id, 5, 200)


def test_random_views_are_keyed_by_seed_and_frame() -> None:
    mapper = small_mapper()
    first = chosen_views(mapper, 7)
    np.testing.assert_array_equal(first, chosen_views(small_mapper(), 7))
    assert (first != chosen_views(mapper, 8)).any()
    assert (first != chosen_views(small_mapper(seed=3), 7)).any()
    # Uniform, the newest frame included.
    counts = np.bincount(first, minlength=5)
    assert counts.min() > 15
    assert counts.max() < 70


@pytest.mark.parametrize("threads", [1, 3])
def test_mapping_repeats_byte_for_byte_on_any_number_of_threads(threads: int) -> None:
    neighbour = room_section(3, 3, section_id=0)
    results = []
    for run_threads in (1, threads):
        mapper = small_mapper(threads=run_threads)
        active, _ = mapper.map_head(room_frame(6), room_pose(6), section_id=1, neighbours=[neighbour])
        active, _ = mapper.map_regular(room_frame(7), room_pose(7), active, neighbours=[neighbour])
        results.append(active_bytes(active))
    assert results[0] == results[1]


def test_the_seed_changes_the_views_and_so_the_map() -> None:
    results = []
    for seed in (2, 3):
        mapper = small_mapper(seed=seed)
        active, _ = mapper.map_head(room_frame(0), room_pose(0), section_id=0, neighbours=[])
        for index in (2, 4):
            active, _ = mapper.map_regular(room_frame(index), room_pose(index), active, neighbours=[])
        results.append(active_bytes(active))
    assert results[0] != results[1]

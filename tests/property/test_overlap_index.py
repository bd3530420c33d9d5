"""The index of candidate views chooses what an exhaustive search chooses, and bounds what it finds."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from helpers.smooth_room import SmoothRoom, small_camera
from helpers.view_index import index_of
from hypothesis import given, settings
from hypothesis import strategies as st

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.overlap.blocks import PointBlocks
from vtslam.common.overlap.coarse import BLOCK_PX, CoarseDepth
from vtslam.common.overlap.search import OverlapSearch
from vtslam.common.overlap.selection import (
    CandidateView,
    largest_overlap,
    overlap_shares,
    sections_to_pretrack,
    world_points_m,
)
from vtslam.common.settings import OverlapSettings

VIEWS = 14
seeds = st.integers(0, 2**32 - 1)


def seen(
    rng: np.random.Generator, rooms: list[SmoothRoom], places: list[npt.NDArray[np.float64]], cameras: list[Camera]
) -> tuple[npt.NDArray[np.float64], Frame]:
    """A frame with holes in one of the rooms, from anywhere around its middle, and its pose in the world."""
    which = int(rng.integers(len(rooms)))
    twist = np.concatenate([rng.uniform(-0.4, 0.4, 3), rng.uniform(-1.0, 1.0, 3) * rng.uniform(0.0, 2.0)])
    T = se3.exp(twist)
    frame = rooms[which].frame(T, cameras[int(rng.integers(len(cameras)))])
    holes = rng.random(frame.depth.shape) < rng.choice([0.0, 0.1, 0.9, 1.0], p=[0.5, 0.3, 0.15, 0.05])
    T_world = T.copy()
    T_world[:3, 3] += places[which]
    return T_world, replace(frame, depth=np.where(holes, 0, frame.depth).astype(np.uint16))


def scene(rng: np.random.Generator) -> tuple[list[CandidateView], Frame, npt.NDArray[np.float64]]:
    """Views in or beside rooms that may be far from each other and from the origin, and a frame of one of them."""
    rooms = [SmoothRoom(seed=i, radii_m=tuple(rng.uniform(1.2, 6.0, 3))) for i in range(2)]
    places = [np.zeros(3), rng.uniform(-1, 1, 3) * 10.0 ** rng.uniform(0, 4)]
    cameras = [small_camera(), small_camera(int(rng.integers(9, 90)), int(rng.integers(9, 70)))]
    views, section_id, is_head = [], 0, True
    for number in range(VIEWS):
        T, frame = seen(rng, rooms, places, cameras)
        views.append(
            CandidateView(
                section_id=section_id,
                frame_id=number,
                is_head=is_head,
                T_world_camera=T,
                depth=frame.depth,
                depth_scale_m=frame.depth_scale_m,
                camera=frame.camera,
            )
        )
        is_head = rng.random() < 0.4
        section_id += int(is_head)
    T, frame = seen(rng, rooms, places, cameras)
    return views, frame, T


@settings(max_examples=60)
@given(seed=seeds)
def test_the_choice_is_that_of_an_exhaustive_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    views, frame, T = scene(rng)
    overlap = OverlapSettings(
        gamma=float(rng.uniform(0.05, 0.9)),
        depth_consistency=float(10.0 ** rng.uniform(-3.0, 0.0)),
        border_share=float(rng.uniform(0.0, 0.3)),
        max_sections=int(rng.integers(1, 5)),
    )
    index, head = index_of(views), int(rng.integers(1, 9))
    last = views[-1].section_id
    for only_head_of in (None, last):
        counting = [view for view in views if view.section_id != only_head_of or view.is_head]
        shares = overlap_shares(world_points_m(frame, T, frame.depth > 0), counting, overlap)
        search = OverlapSearch(index, frame, T, overlap, only_head_of=only_head_of)
        assert search.sections_to_pretrack(head_section_id=head) == sections_to_pretrack(
            shares, counting, head_section_id=head, settings=overlap
        )
        assert search.largest_overlap(excluded_section_id=last) == largest_overlap(
            shares, counting, excluded_section_id=last
        )
        found = {view.frame_id: share for view, share in zip(counting, shares, strict=True) if share > 0}
        assert {views[number].frame_id: share for number, share in search.shares().items()} == found


@given(seed=seeds)
def test_coarse_depth_bounds_every_bilinear_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = (int(size) for size in rng.integers(1, 40, 2))
    depth = np.asarray(rng.integers(0, 65536, (height, width)) * (rng.random((height, width)) < 0.8), np.uint16)
    coarse = CoarseDepth.of(depth)
    padded = np.pad(depth, 2).astype(np.float64)
    u, v = rng.uniform(0, width, 200), rng.uniform(0, height, 200)
    x, y = u - 0.5 + 2, v - 0.5 + 2
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    a, b = y - i, x - j
    top = (1 - b) * padded[i, j] + b * padded[i, j + 1]
    bottom = (1 - b) * padded[i + 1, j] + b * padded[i + 1, j + 1]
    sample, block = (1 - a) * top + a * bottom, (v.astype(int) // BLOCK_PX, u.astype(int) // BLOCK_PX)
    assert (coarse.nearest[block] <= sample + 1e-6).all()
    assert (sample <= coarse.farthest[block] + 1e-6).all()
    again = CoarseDepth.unpacked(coarse.packed(), width=width, height=height)
    assert again.packed() == coarse.packed()


@given(seed=seeds)
def test_every_point_is_in_the_ball_of_its_block(seed: int) -> None:
    _, frame, T = scene(np.random.default_rng(seed))
    blocks, points = PointBlocks.of(frame, T), world_points_m(frame, T, frame.depth > 0)
    assert sorted(blocks.rows.tolist()) == list(range(len(points)))
    of_block = np.repeat(np.arange(len(blocks.counts)), blocks.counts)
    distances = np.linalg.norm(points[blocks.rows] - blocks.centers_m[of_block], axis=1)
    assert (distances <= blocks.radii_m[of_block]).all()
    if len(points):
        center, radius = blocks.bounding_sphere()
        assert (np.linalg.norm(points - center, axis=1) <= radius).all()

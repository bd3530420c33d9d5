"""Small section records for tests; that of `small_section` is the same on every machine, to the bit."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vtslam.common.geometry.camera import Camera
from vtslam.storage.catalog_rows import FrameRow
from vtslam.storage.section_record import SectionRecord

WIDTH, HEIGHT, NUM_FRAMES = 6, 4, 3


def small_section(*, section_id: int = 7, num_gaussians: int = 20, num_views: int = 2) -> SectionRecord:
    """A section of 3 frames of 6x4 pixels; equal arguments give equal records."""
    rows = np.arange(num_gaussians)
    poses = np.tile(np.eye(4), (NUM_FRAMES, 1, 1))
    poses[1, :3, :3] = [[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]
    poses[1:, :3, 3] = [[0.125, -0.25, 0.5], [0.25, -0.5, 1.0]]
    T_world_section = np.eye(4)
    T_world_section[:3, 3] = [1000.5, -2.0, 3.25]
    return SectionRecord(
        section_id=section_id,
        camera=Camera(width=WIDTH, height=HEIGHT, fx=5.5, fy=5.25, cx=3.0, cy=2.0),
        depth_scale_m=0.0002,
        depth_factor=1.005,
        T_world_section=T_world_section,
        frame_ids=np.array([30, 31, 33], np.int64),
        capture_times_ns=np.array([1_000_000_000, 1_033_333_333, 1_100_000_000], np.int64),
        T_section_frame=poses,
        exposure_gain=(1.0 + np.arange(3 * NUM_FRAMES).reshape(-1, 3) / 32.0).astype(np.float32),
        exposure_offset=(np.arange(3 * NUM_FRAMES).reshape(-1, 3) / 128.0 - 0.03125).astype(np.float32),
        frame_index=(rows % NUM_FRAMES).astype(np.uint16),
        pixel=(rows * 7 % (WIDTH * HEIGHT)).astype(np.int32),
        subpixel=(rows % 5).astype(np.uint8),
        depth=(rows * 997 % 60000 + 1).astype(np.uint16),
        color=(np.arange(3 * num_gaussians).reshape(-1, 3) / 64.0 - 0.125).astype(np.float32),
        log_radius=(-4.0 - rows / 128.0).astype(np.float32),
        opacity_logit=(rows / 8.0 - 1.0).astype(np.float32),
        view_index=np.arange(num_views, dtype=np.uint16),
        view_depth=(np.arange(num_views * HEIGHT * WIDTH) * 37).reshape(-1, HEIGHT, WIDTH).astype(np.uint16),
    )


def surface_section(*, frames: int = 4, width: int = 24, height: int = 16, seed: int = 3) -> SectionRecord:
    """A section of a smooth textured surface with edges, holes and noise, in the order that the mapper keeps."""
    random = np.random.Generator(np.random.Philox(seed))
    row, column = np.mgrid[:height, :width]
    parts = []
    for frame in range(frames):
        depth = (4000 + 9 * row + 5 * column + 40 * frame + random.integers(0, 3, (height, width))).astype(np.uint16)
        depth[(row + column + frame) % 11 == 0] = 0
        mask = (depth > 0) & ((frame == 0) | (random.random((height, width)) < 0.2))
        whole = np.flatnonzero(mask)
        edge = np.flatnonzero(mask & (column % 8 == 0))
        pixel = np.concatenate([whole, np.repeat(edge, 4)])
        subpixel = np.concatenate([np.zeros(whole.size, np.uint8), np.tile(np.arange(1, 5, dtype=np.uint8), edge.size)])
        kept = random.random(pixel.size) < 0.8
        parts.append((np.full(pixel.size, frame)[kept], pixel[kept], subpixel[kept], depth.reshape(-1)[pixel[kept]]))
    frame_index, pixel, subpixel, depth = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    count = pixel.size
    shade = 0.5 + 0.01 * (pixel % width) + 0.1 * (pixel // width % 2)
    width_m = depth * 0.001 / (0.9 * width) * np.where(subpixel > 0, 0.5, 1.0)
    view = np.zeros((2, height, width), np.uint16)
    view[0].reshape(-1)[pixel[frame_index == 0]] = depth[frame_index == 0]
    view[1].reshape(-1)[pixel[frame_index == 2]] = depth[frame_index == 2]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(frames)
    return SectionRecord(
        section_id=5,
        camera=Camera(width=width, height=height, fx=0.9 * width, fy=0.9 * width, cx=0.5 * width, cy=0.5 * height),
        depth_scale_m=0.001,
        depth_factor=1.0,
        T_world_section=np.eye(4),
        frame_ids=np.arange(frames, dtype=np.int64),
        capture_times_ns=33_000_000 * np.arange(frames, dtype=np.int64),
        T_section_frame=poses,
        exposure_gain=np.ones((frames, 3), np.float32),
        exposure_offset=np.zeros((frames, 3), np.float32),
        frame_index=frame_index.astype(np.uint16),
        pixel=pixel.astype(np.int32),
        subpixel=subpixel.astype(np.uint8),
        depth=depth.astype(np.uint16),
        color=(shade[:, None] * [1.0, 0.8, 0.6] + random.normal(0, 0.02, (count, 3))).astype(np.float32),
        log_radius=(np.log(0.55 * width_m) + random.normal(0, 0.2, count)).astype(np.float32),
        opacity_logit=random.normal(2.0, 2.0, count).astype(np.float32),
        view_index=np.array([0, 2], np.uint16),
        view_depth=view,
    )


def frames_of(record: SectionRecord, facts: Sequence[Mapping[str, Any]] = ()) -> list[FrameRow]:
    """The rows of its frames, at the poses of the record."""
    return [
        FrameRow(
            frame_id=int(frame_id),
            capture_time_ns=int(record.capture_times_ns[row]),
            T_world_camera=record.T_world_section @ record.T_section_frame[row],
            facts=facts[row] if facts else {"frame_id": int(frame_id), "state": "ok"},
        )
        for row, frame_id in enumerate(record.frame_ids)
    ]


def assert_same_section(found: SectionRecord, expected: SectionRecord) -> None:
    """Equality bit by bit, also of types."""
    assert found.header() == expected.header()
    for name, array in expected.columns().items():
        other = getattr(found, name)
        assert (other.dtype, other.shape, other.tobytes()) == (array.dtype, array.shape, array.tobytes()), name

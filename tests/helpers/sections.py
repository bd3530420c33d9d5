"""Small section records for tests, the same on every machine (no trigonometry, no random floats of a library)."""

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

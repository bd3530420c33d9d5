"""Section records are checked when they are made, and again when they are read."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.sections import small_section

from vtslam.common.geometry.camera import Camera
from vtslam.storage.errors import MalformedSection
from vtslam.storage.section_file import read_section, write_columns


def test_record_counts() -> None:
    record = small_section()
    assert (record.num_frames, record.num_gaussians, record.num_views) == (3, 20, 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"color": np.zeros((20, 3))}, r"color: expected float32 \(20, 3\), found float64 \(20, 3\)"),
        ({"pixel": np.zeros(19, np.int32)}, r"pixel: expected int32 \(20,\), found int32 \(19,\)"),
        ({"depth": np.ones((20, 1), np.uint16)}, r"depth: expected uint16 \(20,\), found uint16 \(20, 1\)"),
        ({"section_id": np.int64(3)}, "section_id: expected an integer"),
        ({"depth_scale_m": float("nan")}, "depth_scale_m: expected a positive number, found nan"),
        ({"camera": Camera(width=5, height=4, fx=5.5, fy=5.5, cx=2.5, cy=2.0)}, "expected uint16"),
    ],
)
def test_records_are_checked_when_made(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(small_section(), **change)


def test_record_without_frames() -> None:
    none = np.zeros(0, np.int64)
    nothing = np.zeros((0, 3), np.float32)
    with pytest.raises(ValueError, match="frame_ids: expected 1 to 65536 frames, found 0"):
        replace(
            small_section(),
            frame_ids=none,
            capture_times_ns=none,
            T_section_frame=np.zeros((0, 4, 4)),
            exposure_gain=nothing,
            exposure_offset=nothing,
        )


def test_missing_column(tmp_path: Path) -> None:
    path, record = tmp_path / "000007.vts", small_section()
    columns = record.columns()
    del columns["subpixel"]
    write_columns(path, record.header(), columns)
    with pytest.raises(MalformedSection, match=r"columns: expected .*'subpixel'.*, found"):
        read_section(path)

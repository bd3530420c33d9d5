"""The rows of the catalogue as plain records, and how their fields are stored."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.storage.section_record import SectionRecord

Pose = npt.NDArray[np.float64]

STORED, MISSING = "stored", "missing"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionRow:
    """A section that is on disk, or was.

    Attributes:
        section_id, first_frame_id, num_frames, num_gaussians: What is in it.
        camera, depth_scale_m: Of all its frames.
        num_bytes, sha256, codec: Of its file.
        state: "stored", or "missing" once its file was set aside.
        next_sha256: Of a file that was about to take its file's place; None if there is none.
    """

    section_id: int
    first_frame_id: int
    num_frames: int
    num_gaussians: int
    camera: Camera
    depth_scale_m: float
    num_bytes: int
    sha256: bytes
    codec: str
    state: str = STORED
    next_sha256: bytes | None = None

    @property
    def end_frame_id(self) -> int:
        """The frame after its last one."""
        return self.first_frame_id + self.num_frames


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRow:
    """A frame of a section on disk.

    Attributes:
        frame_id: Its place in the stream.
        capture_time_ns: Capture time.
        T_world_camera: float64 [4,4], as it was committed.
        facts: Quality and times, by name; numbers that are not finite are kept as None.
    """

    frame_id: int
    capture_time_ns: int
    T_world_camera: Pose
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something that happened to a run: Unix time, a word, and what there is to say."""

    time_ns: int
    kind: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """Sums over a run: frames, sections, their Gaussians and bytes, and frames by state of tracking."""

    frames: int
    sections: int
    gaussians: int
    num_bytes: int
    states: Mapping[str, int]


def packed_pose(T: Pose) -> bytes:
    """A pose as the catalogue keeps it, exactly."""
    return np.asarray(T, "<f8", order="C").tobytes()


def unpacked_pose(data: bytes) -> Pose:
    """The pose of :func:`packed_pose`; ValueError if it is none."""
    return np.frombuffer(data, "<f8").reshape(4, 4).astype(np.float64)


def packed_facts(facts: Mapping[str, Any]) -> str:
    """Facts as JSON: numpy scalars become numbers, and numbers that are not finite null; TypeError if that fails."""
    return json.dumps(_plain(facts), allow_nan=False, ensure_ascii=False)


def packed_views(record: SectionRecord) -> list[tuple[int, int, bytes]]:
    """The rows of the table ``views`` for a section."""
    rows = []
    for index, row in enumerate(record.view_index):
        depth = record.view_depth[index]
        rows.append((int(record.frame_ids[row]), int(depth.max()), CoarseDepth.of(depth).packed()))
    return rows


def _plain(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value

"""Where things lie in the files of an active section (docs/protocol-shm.md, section 5)."""

import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.gaussians import ViewTiedGaussians
from vtslam.common.section import Section
from vtslam.common.shm.blocks import aligned, column
from vtslam.common.shm.errors import DamagedBlock
from vtslam.common.shm.growing_file import ColumnLayout, ColumnTypes
from vtslam.common.shm.records import MAX_FACTS_BYTES, MAX_NEIGHBOURS, ActiveSpec
from vtslam.common.shm.section_columns import (
    CAMERA_FIELDS,
    LEARNED_COLUMNS,
    ROW,
    TIE_COLUMNS,
    ImageLayout,
    camera_fields,
    camera_of,
    frames_of_rows,
    untied_section,
)

CONTROL, APPENDED = "control", "appended"
LEARNED_NAME = re.compile(r"learned-(\d+)")
DESCRIPTION = np.dtype(
    [
        *CAMERA_FIELDS,
        ("depth_factor", "<f8"),
        ("max_frames", "<u4"),
        ("max_gaussians", "<u8"),
        ("with_moments", "<u1"),
        ("kept", "<u1"),
    ]
)
RECORD = np.dtype(
    [
        ("crc32", "<u4"),  # of the rest of the record and the caller's bytes
        ("num_frames", "<u4"),
        ("num_gaussians", "<u8"),
        ("generation", "<u8"),
        ("T_world_section", "<f8", (4, 4)),
        ("step_counts", "<u8", (3,)),
        ("moments_file", "<i4"),  # -1: none
        ("num_neighbours", "<u4"),
        ("neighbour_ids", "<i8", (MAX_NEIGHBOURS,)),
        ("facts_bytes", "<u4"),
    ]
)
RECORD_BYTES = 64 * 1024
assert RECORD.itemsize + MAX_FACTS_BYTES <= RECORD_BYTES

MOMENT_COLUMNS: ColumnTypes = tuple(
    (f"{moment}_{name}", dtype, values) for moment in ("m", "v") for name, dtype, values in LEARNED_COLUMNS
)


def learned_name(buffer: int) -> str:
    """File of a generation buffer."""
    return f"learned-{buffer}"


def moments_name(number: int) -> str:
    """File of optimiser state, 0 or 1."""
    return f"moments-{number}"


def description_of(spec: ActiveSpec) -> npt.NDArray[Any]:
    """What the control page says of an active section."""
    camera = camera_fields(spec.section_id, spec.camera, spec.depth_scale_m)
    rest = (spec.depth_factor, spec.max_frames, spec.max_gaussians, spec.with_moments, spec.kept_generations)
    return np.array([(*camera, *rest)], DESCRIPTION)


class ActiveLayout:
    """Places in the files of one active section.

    Attributes:
        description: Record of `DESCRIPTION`.
        images: Layout of one frame's images.
        kept: Newest generations that stay, pinned or not.
        appended, learned, moments: Layouts of the files.
    """

    def __init__(self, description: Any) -> None:  # noqa: ANN401
        self.description = description
        self.camera = camera_of(description)
        self.images = ImageLayout(self.camera)
        self.max_frames, self.max_gaussians = int(description["max_frames"]), int(description["max_gaussians"])
        self.kept = int(description["kept"])
        self.table_bytes = aligned(self.max_frames * ROW.itemsize)
        head = self.table_bytes + self.max_frames * self.images.frame_bytes
        self.appended = ColumnLayout(TIE_COLUMNS, self.max_gaussians, head_bytes=head)
        self.learned = ColumnLayout(LEARNED_COLUMNS, self.max_gaussians, head_bytes=RECORD_BYTES)
        self.moments = ColumnLayout(MOMENT_COLUMNS, self.max_gaussians, head_bytes=0)

    def rows(self, appended: npt.NDArray[np.uint8], count: int) -> npt.NDArray[Any]:
        """The first rows of the frame table."""
        return column(appended, 0, ROW, (count,))

    def image_offset(self, row: int) -> int:
        """Where the images of a row start in `appended`."""
        return self.table_bytes + row * self.images.frame_bytes

    def section(
        self, appended: npt.NDArray[np.uint8], learned: npt.NDArray[np.uint8], record: npt.NDArray[Any]
    ) -> Section:
        """The section of a commit record, its arrays those of the mapped files; without positions and surface."""
        count = int(record["num_gaussians"])
        ties = {name: self.appended.column(appended, name, count) for name, _, _ in TIE_COLUMNS}
        values = {name: self.learned.column(learned, name, count) for name, _, _ in LEARNED_COLUMNS}
        rows = self.rows(appended, int(record["num_frames"]))
        return untied_section(
            self.description,
            T_world_section=record["T_world_section"],
            frames=frames_of_rows(rows, lambda row: self.images.depth(appended, self.image_offset(row))),
            gaussians=ViewTiedGaussians(**ties, **values),
        )


def write_record(learned: npt.NDArray[np.uint8], record: npt.NDArray[Any], facts: bytes) -> None:
    """Put a commit record [1] and the caller's bytes at the start of a buffer, checksum filled in."""
    record["facts_bytes"] = len(facts)
    record["crc32"] = zlib.crc32(facts, zlib.crc32(record.tobytes()[4:]))
    packed = record.tobytes() + facts
    learned[: len(packed)] = np.frombuffer(packed, np.uint8)


def read_record(path: Path, learned: npt.NDArray[np.uint8]) -> tuple[npt.NDArray[Any], bytes]:
    """A copy of the commit record and the caller's bytes; raises DamagedBlock if the checksum does not fit."""
    record = learned[: RECORD.itemsize].copy().view(RECORD)[0]
    size = min(int(record["facts_bytes"]), MAX_FACTS_BYTES)
    facts = learned[RECORD.itemsize : RECORD.itemsize + size].tobytes()
    if record["crc32"] != zlib.crc32(facts, zlib.crc32(record.tobytes()[4:])):
        raise DamagedBlock(f"{path}: the checksum of the commit record does not fit")
    return record, facts

"""Finished sections and last commits: immutable files of exact size (docs/protocol-shm.md, section 6)."""

import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common import failpoints
from vtslam.common.frame import Frame
from vtslam.common.gaussians import ViewTiedGaussians
from vtslam.common.geometry.camera import Camera
from vtslam.common.section import Section
from vtslam.common.shm.blocks import (
    CONTROL_BYTES,
    ControlPage,
    Kind,
    aligned,
    column,
    make_file,
    mapped,
    open_file,
    reserve,
)
from vtslam.common.shm.errors import DamagedBlock, SectionNotResident
from vtslam.common.shm.growing_file import Admission
from vtslam.common.shm.pins import Pin
from vtslam.common.shm.records import LastCommit
from vtslam.common.shm.section_columns import (
    CAMERA_FIELDS,
    LEARNED_COLUMNS,
    ROW,
    TIE_COLUMNS,
    ImageLayout,
    camera_fields,
    camera_of,
    frames_of_rows,
    packed_rows,
    untied_section,
)

_SEALED = np.dtype(
    [
        *CAMERA_FIELDS,
        ("depth_factor", "<f8"),
        ("T_world_section", "<f8", (4, 4)),
        ("frames", "<u4"),
        ("views", "<u4"),
        ("gaussians", "<u8"),
        ("crc32", "<u4"),
    ]
)
_TAIL = np.dtype(
    [
        *CAMERA_FIELDS,
        ("frame_index", "<u4"),
        ("facts_bytes", "<u4"),
        ("frame_id", "<i8"),
        ("capture_time_ns", "<i8"),
        ("crc32", "<u4"),
    ]
)


def _columns(counts: Any) -> tuple[dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]], int]:  # noqa: ANN401
    """Place, type and shape of every column after the control page, and the bytes of all."""
    frames, views, gaussians = int(counts["frames"]), int(counts["views"]), int(counts["gaussians"])
    size = (int(counts["height"]), int(counts["width"]))
    wanted: list[tuple[str, np.dtype[Any], tuple[int, ...]]] = [("frames", ROW, (frames,))]
    wanted += [(name, np.dtype(dtype), (gaussians, *values)) for name, dtype, values in TIE_COLUMNS + LEARNED_COLUMNS]
    wanted += [("view_index", np.dtype("<u2"), (views,)), ("view_depth", np.dtype("<u2"), (views, *size))]
    places, end = {}, 0
    for name, dtype, shape in wanted:
        start = aligned(end, 64)
        places[name] = (start, dtype, shape)
        end = start + dtype.itemsize * int(np.prod(shape, dtype=np.int64))
    return places, max(end, 1)


def sealed_bytes(section: Section) -> int:
    """Bytes that a section takes once it is sealed."""
    views = sum(frame.view_depth is not None for frame in section.frames)
    return sealed_bytes_of(section.camera, frames=len(section.frames), views=views, gaussians=section.gaussians.count)


def sealed_bytes_of(camera: Camera, *, frames: int, views: int, gaussians: int) -> int:
    """Bytes that a sealed section takes with so many frames, views that keep their depth, and Gaussians."""
    counts = {"frames": frames, "views": views, "gaussians": gaussians, "width": camera.width, "height": camera.height}
    return CONTROL_BYTES + _columns(counts)[1]


def _sealed_description(section: Section) -> npt.NDArray[Any]:
    views = sum(frame.view_depth is not None for frame in section.frames)
    camera = camera_fields(section.section_id, section.camera, section.depth_scale_m)
    counts = (len(section.frames), views, section.gaussians.count, 0)
    return np.array([(*camera, section.depth_factor, section.T_world_section, *counts)], _SEALED)


def write_sealed(path: Path, section: Section, admit: Admission, *, pins: int) -> None:
    """Write a finished section to a new file; raises MapStoreFull or SharedMemoryFull."""
    description = _sealed_description(section)
    places, data_bytes = _columns(description[0])
    views = [(row, f.view_depth) for row, f in enumerate(section.frames) if f.view_depth is not None]
    fd = _reserved_file(path, CONTROL_BYTES + data_bytes, admit)
    try:
        failpoints.reach("shm.sealed.after_reserve")
        data = mapped(fd, data_bytes, offset=CONTROL_BYTES, writable=True)
        into = {name: column(data, *place) for name, place in places.items()}
        into["frames"][:] = packed_rows(section.frames, lambda row: False)
        for name, _, _ in TIE_COLUMNS + LEARNED_COLUMNS:
            into[name][:] = getattr(section.gaussians, name)
        for index, (row, depth) in enumerate(views):
            into["view_index"][index] = row
            into["view_depth"][index] = depth
        failpoints.reach("shm.sealed.after_columns")
        description["crc32"] = zlib.crc32(data.data)
        size = CONTROL_BYTES + data_bytes
        ControlPage.write(path, fd, Kind.SEALED, file_bytes=size, pins=pins, description=description)
    finally:
        os.close(fd)


class PinnedSealed:
    """A finished section in place, its arrays read-only; the pin keeps it resident until :meth:`release`.

    Args:
        path: The block.
        verify: Check the checksum of the columns.

    Attributes:
        section: Without positions and surface: `Section.retied` computes them.

    Raises:
        SectionNotResident: It is not there.
        NoFreePin: Too many readers.
        DamagedBlock: It is something else, or its checksum does not fit.
    """

    def __init__(self, path: Path, *, verify: bool = False) -> None:
        try:
            fd = open_file(path, writable=True)
        except FileNotFoundError as error:
            raise SectionNotResident(f"{path}: not in the map store") from error
        try:
            control = ControlPage.open(path, fd, Kind.SEALED)
            description = control.description(_SEALED)
            data = mapped(fd, control.file_bytes - CONTROL_BYTES, offset=CONTROL_BYTES, writable=False)
            os.utime(fd)  # tells when it was used last
        finally:
            os.close(fd)
        if verify and zlib.crc32(data.data) != description["crc32"]:
            raise DamagedBlock(f"{path}: the checksum of the columns does not fit")
        self._pin = Pin(control.pins, control.pins.claim())
        control.pins.pin(self._pin.entry, control.state.word)
        self.section = _sealed_section(description, data)

    def release(self) -> None:
        """Allow the section to leave memory; the arrays must not be used any more."""
        self._pin.release()


def read_sealed(path: Path) -> Section:
    """A copy of a finished section without positions and surface; takes no pin, and does not count as use.

    The payload never changes, and a block that leaves memory meanwhile is unlinked only: what is mapped stays.

    Raises:
        SectionNotResident, DamagedBlock: As `PinnedSealed`.
    """
    try:
        fd = open_file(path, writable=True)
    except FileNotFoundError as error:
        raise SectionNotResident(f"{path}: not in the map store") from error
    try:
        control = ControlPage.open(path, fd, Kind.SEALED)
        data = mapped(fd, control.file_bytes - CONTROL_BYTES, offset=CONTROL_BYTES, writable=False).copy()
    finally:
        os.close(fd)
    return _sealed_section(control.description(_SEALED), data)


def sealed_pin_holders(path: Path) -> list[int]:
    """Pids of living processes that have a sealed section pinned; none if it is not there."""
    try:
        fd = open_file(path, writable=True)
    except FileNotFoundError:
        return []
    try:
        pins = ControlPage.open(path, fd, Kind.SEALED).pins
    finally:
        os.close(fd)
    if pins.values():
        pins.reap()
    return pins.holder_pids()


def _sealed_section(description: Any, data: npt.NDArray[np.uint8]) -> Section:  # noqa: ANN401
    places, _ = _columns(description)
    columns = {name: column(data, *place) for name, place in places.items()}
    index_of_row = {int(row): index for index, row in enumerate(columns["view_index"])}
    names = [name for name, _, _ in TIE_COLUMNS + LEARNED_COLUMNS]
    return untied_section(
        description,
        T_world_section=description["T_world_section"],
        frames=frames_of_rows(columns["frames"], lambda row: columns["view_depth"][index_of_row[row]]),
        gaussians=ViewTiedGaussians(**{name: columns[name] for name in names}),
    )


def write_tail(path: Path, section_id: int, frame_index: int, frame: Frame, facts: bytes, admit: Admission) -> None:
    """Write a last commit to a new file; raises MapStoreFull or SharedMemoryFull."""
    camera = camera_fields(section_id, frame.camera, frame.depth_scale_m)
    rest = (frame_index, len(facts), frame.frame_id, frame.capture_time_ns, 0)
    description = np.array([(*camera, *rest)], _TAIL)
    images = ImageLayout(frame.camera)
    data_bytes = images.frame_bytes + aligned(len(facts))
    fd = _reserved_file(path, CONTROL_BYTES + data_bytes, admit)
    try:
        data = mapped(fd, data_bytes, offset=CONTROL_BYTES, writable=True)
        images.write(data, 0, frame)
        data[images.frame_bytes : images.frame_bytes + len(facts)] = np.frombuffer(facts, np.uint8)
        description["crc32"] = zlib.crc32(data.data)
        size = CONTROL_BYTES + data_bytes
        ControlPage.write(path, fd, Kind.TAIL, file_bytes=size, pins=1, description=description)
    finally:
        os.close(fd)


def read_tail(path: Path) -> LastCommit:
    """A copy of the last commit of a sealed section.

    Raises:
        SectionNotResident: There is none at ``path``.
        DamagedBlock: It is something else, or its checksum does not fit.
    """
    try:
        fd = open_file(path, writable=True)
    except FileNotFoundError as error:
        raise SectionNotResident(f"{path}: not in the map store") from error
    try:
        control = ControlPage.open(path, fd, Kind.TAIL)
        found = control.description(_TAIL)
        data = mapped(fd, control.file_bytes - CONTROL_BYTES, offset=CONTROL_BYTES, writable=False).copy()
    finally:
        os.close(fd)
    if zlib.crc32(data.data) != found["crc32"]:
        raise DamagedBlock(f"{path}: the checksum of the last commit does not fit")
    camera = camera_of(found)
    images = ImageLayout(camera)
    frame = Frame(
        frame_id=int(found["frame_id"]),
        capture_time_ns=int(found["capture_time_ns"]),
        rgb=images.rgb(data, 0),
        depth=images.depth(data, 0),
        depth_scale_m=float(found["depth_scale_m"]),
        camera=camera,
    )
    return LastCommit(
        section_id=int(found["section_id"]),
        frame_index=int(found["frame_index"]),
        frame=frame,
        facts=data[images.frame_bytes : images.frame_bytes + int(found["facts_bytes"])].tobytes(),
        is_sealed=True,
    )


def _reserved_file(path: Path, size: int, admit: Admission) -> int:
    """A descriptor of a new file with all its space reserved."""
    admit(str(path), size)
    fd = make_file(path, size)
    try:
        reserve(path, fd, 0, size)
    except BaseException:
        os.close(fd)
        path.unlink()
        raise
    return fd

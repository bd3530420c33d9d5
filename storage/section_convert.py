"""Sections of the map as section files keep them, and back: nothing is lost, positions are computed anew."""

from collections import OrderedDict
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.gaussians import ViewTiedGaussians
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.view_index import ViewFacts
from vtslam.common.section import Section, SectionFrame
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_record import SectionRecord


def record_of(section: Section) -> SectionRecord:
    """The record of a sealed section with at least one frame."""
    views = [row for row, frame in enumerate(section.frames) if frame.view_depth is not None]
    size = (section.camera.height, section.camera.width)
    view_depth = [frame.view_depth for frame in section.frames if frame.view_depth is not None]
    gaussians = section.gaussians
    return SectionRecord(
        section_id=section.section_id,
        camera=section.camera,
        depth_scale_m=section.depth_scale_m,
        depth_factor=section.depth_factor,
        T_world_section=section.T_world_section,
        frame_ids=np.array([frame.frame_id for frame in section.frames], np.int64),
        capture_times_ns=np.array([frame.capture_time_ns for frame in section.frames], np.int64),
        T_section_frame=np.stack([frame.T_section_frame for frame in section.frames]),
        exposure_gain=np.stack([frame.exposure.gain for frame in section.frames]),
        exposure_offset=np.stack([frame.exposure.offset for frame in section.frames]),
        frame_index=gaussians.frame_index,
        pixel=gaussians.pixel,
        subpixel=gaussians.subpixel,
        depth=gaussians.depth,
        color=gaussians.colors,
        log_radius=gaussians.log_radii,
        opacity_logit=gaussians.opacity_logits,
        view_index=np.array(views, np.uint16),
        view_depth=np.stack(view_depth) if view_depth else np.zeros((0, *size), np.uint16),
    )


def section_of(record: SectionRecord) -> Section:
    """The section of a record, its Gaussians' positions computed from its frames' poses."""
    return untied_section_of(record).retied()


def untied_section_of(record: SectionRecord) -> Section:
    """As :func:`section_of`, without positions and surface."""
    row_of_view = {int(row): index for index, row in enumerate(record.view_index)}
    frames = tuple(
        SectionFrame(
            frame_id=int(record.frame_ids[row]),
            capture_time_ns=int(record.capture_times_ns[row]),
            T_section_frame=record.T_section_frame[row],
            exposure=Exposure(gain=record.exposure_gain[row], offset=record.exposure_offset[row]),
            view_depth=record.view_depth[row_of_view[row]] if row in row_of_view else None,
        )
        for row in range(record.num_frames)
    )
    gaussians = ViewTiedGaussians(
        frame_index=record.frame_index,
        pixel=record.pixel,
        subpixel=record.subpixel,
        depth=record.depth,
        colors=record.color,
        log_radii=record.log_radius,
        opacity_logits=record.opacity_logit,
    )
    return Section(
        section_id=record.section_id,
        T_world_section=record.T_world_section,
        camera=record.camera,
        depth_scale_m=record.depth_scale_m,
        depth_factor=record.depth_factor,
        frames=frames,
        gaussians=gaussians,
        means_m=np.zeros((0, 3), np.float32),
        surface=np.zeros((0, 6), np.float32),
    )


_VIEW_BYTES = 24 * 10**6  # depth of candidate views kept in memory


class SectionArchive:
    """Sealed sections in a run folder."""

    def __init__(self, run: RunFolder) -> None:
        self._run = run
        self._views: OrderedDict[tuple[int, int], npt.NDArray[np.uint16]] = OrderedDict()
        self._view_bytes = 0

    def write(self, section: Section) -> None:
        """Keep a sealed section, durable and verified; raises StorageError."""
        self.written(section)

    def written(self, section: Section) -> SectionRecord:
        """As :meth:`write`; what was written."""
        record = record_of(section)
        self._run.write_section(record)
        return record

    def read(self, section_id: int) -> Section:
        """A section written before; raises StorageError."""
        return section_of(self._run.read_section(section_id))

    def view_depth(self, section_id: int, section_row: int) -> npt.NDArray[np.uint16]:
        """The depth uint16 [H,W] that a section keeps of a frame; the last ones are at hand. Raises StorageError."""
        key = (section_id, section_row)
        if key not in self._views:
            self._read_views(section_id)
        self._views.move_to_end(key)
        return self._views[key]

    def coarse_depth(self, frame_id: int) -> CoarseDepth | None:
        """The coarse depth of a frame of a section on disk; None if it is not kept. Raises StorageError."""
        return self._run.catalog.coarse_depth(frame_id)

    def known_views(self, first_section_id: int, end_section_id: int) -> Iterable[ViewFacts]:
        """The frames that keep their depth of sections on disk, of a range. Raises StorageError."""
        return self._run.catalog.views(first_section_id, end_section_id)

    def _read_views(self, section_id: int) -> None:
        rows, depth = self._run.read_views(section_id)
        for row, image in zip(rows.tolist(), depth, strict=True):
            if (section_id, row) not in self._views:
                self._views[section_id, row] = image.copy()  # apart from each other, so that one may go
                self._view_bytes += image.nbytes
        while self._view_bytes > _VIEW_BYTES and len(self._views) > len(rows):
            self._view_bytes -= self._views.popitem(last=False)[1].nbytes

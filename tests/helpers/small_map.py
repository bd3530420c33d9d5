"""Small frames of the simulated room, and what tracker, mapper and system need around them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from helpers.view_index import index_of

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.overlap.selection import CandidateView
from vtslam.common.overlap.view_index import ViewIndex
from vtslam.common.section import Section
from vtslam.common.settings import MapperSettings, SectionSettings
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.services.mapper.core import Mapper
from vtslam.services.sensor.sources.sim_room import SimRoom

Pose = npt.NDArray[np.float64]

SIZE = (80, 60)
# Small, dense Gaussians: images this small would else be a blur.
SMALL_MAPPER = MapperSettings(iterations_head=12, iterations_regular=4, initial_radius=0.5, initial_opacity=0.95)


@lru_cache(maxsize=4)
def _room(frames: int, size: tuple[int, int]) -> SimRoom:
    return SimRoom(frames=frames, size=size)


@lru_cache(maxsize=64)
def room_frame(index: int, frames: int = 24, size: tuple[int, int] = SIZE) -> Frame:
    """Frame ``index`` of a closed path of ``frames`` frames."""
    return _room(frames, size).frame(index)


def room_pose(index: int, frames: int = 24, size: tuple[int, int] = SIZE) -> Pose:
    """Its true pose ``T_world_camera`` [4,4], in a world whose origin is frame 0."""
    poses = _room(frames, size).ground_truth()
    return np.asarray(se3.inverse(poses[0]) @ poses[index], np.float64)


def without_depth(frame: Frame) -> Frame:
    """The frame with every depth missing."""
    return replace(frame, depth=np.zeros_like(frame.depth))


def pose_error(found: Pose, true: Pose) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    error = se3.inverse(true) @ found
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(se3.angle_rad(error)))


def small_mapper(settings: MapperSettings | None = None, *, seed: int = 2, threads: int = 1) -> Mapper:
    """A mapper on the CPU engine; candidate views every 3rd frame, sections of 6."""
    return Mapper(
        settings=settings or SMALL_MAPPER,
        section_settings=SectionSettings(length=6, candidate_interval=3),
        engine=NativeEngine(threads=threads),
        seed=seed,
    )


def mapped_section(frames: Sequence[Frame], poses: Sequence[Pose], *, section_id: int = 0) -> Section:
    """A section mapped from frames at given poses, sealed."""
    mapper = small_mapper()
    active, _ = mapper.map_head(frames[0], poses[0], section_id=section_id, neighbours=[])
    for frame, pose in zip(frames[1:], poses[1:], strict=True):
        active, _ = mapper.map_regular(frame, pose, active, neighbours=[])
    return mapper.seal(active, neighbours=[])[0]


@lru_cache(maxsize=8)
def room_section(first: int, count: int = 1, *, section_id: int = 0, frames: int = 24) -> Section:
    """A sealed section mapped from frames ``first`` to ``first + count - 1`` of the room at their true poses."""
    rows = range(first, first + count)
    return mapped_section(
        [room_frame(i, frames) for i in rows], [room_pose(i, frames) for i in rows], section_id=section_id
    )


def views_of(section: Section) -> list[CandidateView]:
    """The candidate views of a section: its frames that keep their depth."""
    return [
        CandidateView(
            section_id=section.section_id,
            frame_id=frame.frame_id,
            is_head=row == 0,
            T_world_camera=section.T_world_frame(row),
            depth=frame.view_depth,
            depth_scale_m=section.depth_scale_m,
            camera=section.camera,
        )
        for row, frame in enumerate(section.frames)
        if frame.view_depth is not None
    ]


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedMap:
    """A map that does not change: what a tracker may ask for."""

    sections: dict[int, Section] = field(default_factory=dict)
    views: list[CandidateView] = field(default_factory=list)

    @classmethod
    def of(cls, *sections: Section) -> "FixedMap":
        """Sections by their ids, with their candidate views."""
        return cls(
            sections={section.section_id: section for section in sections},
            views=[view for section in sections for view in views_of(section)],
        )

    def section(self, section_id: int) -> Section:
        return self.sections[section_id]

    def candidate_views(self) -> ViewIndex:
        return index_of(self.views)


def section_bytes(section: Section) -> bytes:
    """All that a section is, as bytes."""
    arrays: list[npt.NDArray[Any]] = [section.T_world_section, section.means_m]
    gaussians = section.gaussians
    arrays += [gaussians.frame_index, gaussians.pixel, gaussians.subpixel, gaussians.depth]
    arrays += [gaussians.colors, gaussians.log_radii, gaussians.opacity_logits]
    for frame in section.frames:
        arrays.append(frame.T_section_frame)
        if frame.view_depth is not None:
            arrays.append(frame.view_depth)
    head = repr((section.section_id, section.camera, section.depth_scale_m, section.depth_factor))
    rows = repr([(f.frame_id, f.capture_time_ns, f.view_depth is None) for f in section.frames])
    return head.encode() + rows.encode() + b"".join(array.tobytes() for array in arrays)

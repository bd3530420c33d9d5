"""Small sections for the map store, every value of which follows from (section, frame); imports no engine."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.external_pose import ExternalPose
from vtslam.common.fleet_folder import shared_memory_folder
from vtslam.common.frame import Frame
from vtslam.common.gaussians import ViewTiedGaussians
from vtslam.common.geometry.camera import Camera
from vtslam.common.section import Section, SectionFrame
from vtslam.common.shm.records import (
    ActiveSpec,
    ActiveState,
    AttributeMoments,
    Commit,
    NewFrame,
    SectionMoments,
)

CAMERA = Camera(width=16, height=12, fx=15.0, fy=14.0, cx=8.0, cy=6.0)
SCALE_M = 0.001
MAX_FRAMES = 8
MAX_GAUSSIANS = 30_000


@contextmanager
def shared_folder() -> Iterator[Path]:
    """A folder of this test's own in shared memory, deleted afterwards."""
    path = Path(tempfile.mkdtemp(dir=shared_memory_folder()))
    try:
        yield path
    finally:
        shutil.rmtree(path)


def numbers(*key: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(list(key))))


def frame_of(frame_id: int, camera: Camera = CAMERA) -> Frame:
    """A frame whose images are one pattern: no mixture of two frames looks like one."""
    size = (camera.height, camera.width)
    return Frame(
        frame_id=frame_id,
        capture_time_ns=frame_id * 33_000_000 + 7,
        rgb=np.full((*size, 3), frame_id % 251, np.uint8),
        depth=np.full(size, 1 + frame_id % 60_000, np.uint16),
        depth_scale_m=SCALE_M,
        camera=camera,
    )


def frame_with_prior_of(frame_id: int, camera: Camera = CAMERA) -> Frame:
    """The same with a pose prior that only this frame has; every third has none."""
    if frame_id % 3 == 0:
        return frame_of(frame_id, camera)
    T_world_camera = np.eye(4)
    T_world_camera[:3, 3] = frame_id
    prior = ExternalPose(T_world_camera=T_world_camera, covariance=frame_id * np.eye(6))
    return replace(frame_of(frame_id, camera), pose_prior=prior)


def spec_of(section_id: int, *, with_moments: bool = True, kept_generations: int = 1) -> ActiveSpec:
    return ActiveSpec(
        section_id=section_id,
        camera=CAMERA,
        depth_scale_m=SCALE_M,
        depth_factor=1.0,
        max_frames=MAX_FRAMES,
        max_gaussians=MAX_GAUSSIANS,
        with_moments=with_moments,
        kept_generations=kept_generations,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SmallSection:
    """The section after ``frames`` frames: rows and ties grow, learned columns and moments change with each frame.

    Attributes:
        section_id: Its id.
        rows: Gaussians of each frame.
        with_moments: Whether commits carry optimiser state.
    """

    section_id: int = 0
    rows: int = 50
    with_moments: bool = True

    @lru_cache(maxsize=64)  # noqa: B019
    def section(self, frames: int) -> Section:
        count = frames * self.rows
        learned = numbers(1, self.section_id, frames)
        ties = numbers(2, self.section_id).integers(0, 192, MAX_FRAMES * self.rows)[:count]
        return Section(
            section_id=self.section_id,
            T_world_section=np.eye(4) * (1 + frames),
            camera=CAMERA,
            depth_scale_m=SCALE_M,
            depth_factor=1.0,
            frames=tuple(self._row(row) for row in range(frames)),
            gaussians=ViewTiedGaussians(
                frame_index=np.repeat(np.arange(frames, dtype=np.uint16), self.rows),
                pixel=ties.astype(np.int32),
                subpixel=(ties % 5).astype(np.uint8),
                depth=(1 + ties).astype(np.uint16),
                colors=learned.random((count, 3), np.float32),
                log_radii=learned.random(count, np.float32),
                opacity_logits=learned.random(count, np.float32),
            ),
            means_m=np.zeros((0, 3), np.float32),
            surface=np.zeros((0, 6), np.float32),
        )

    def frame(self, row: int) -> Frame:
        return frame_of(100 * self.section_id + row)

    def facts(self, frames: int) -> bytes:
        return bytes([frames]) * (100 * frames)

    def neighbour_ids(self) -> tuple[int, ...]:
        return (self.section_id - 1,) if self.section_id else ()

    @lru_cache(maxsize=64)  # noqa: B019
    def moments(self, frames: int) -> SectionMoments | None:
        if not self.with_moments:
            return None
        count, random = frames * self.rows, numbers(3, self.section_id, frames)
        shapes: list[tuple[int, ...]] = [(count, 3), (count,), (count,)]
        parts = [
            AttributeMoments(m=random.random(s, np.float32), v=random.random(s, np.float32), step_count=7 * frames + i)
            for i, s in enumerate(shapes)
        ]
        return SectionMoments(colors=parts[0], log_radii=parts[1], opacity_logits=parts[2])

    def commit(self, frames: int) -> Commit:
        """The commit of frame ``frames`` - 1; every third row is held out."""
        return Commit(
            section=self.section(frames),
            new_frames=(NewFrame(frame=self.frame(frames - 1), trained=(frames - 1) % 3 != 2),),
            neighbour_ids=self.neighbour_ids(),
            moments=self.moments(frames),
            facts=self.facts(frames),
        )

    @lru_cache(maxsize=64)  # noqa: B019
    def expected(self, frames: int) -> bytes:
        """:func:`state_bytes` of the state after ``frames`` frames."""
        return state_bytes(
            ActiveState(
                generation=frames,
                section=self.section(frames),
                frames=tuple(self.frame(row) for row in range(frames)),
                trained_rows=tuple(row for row in range(frames) if row % 3 != 2),
                neighbour_ids=self.neighbour_ids(),
                moments=self.moments(frames),
                facts=self.facts(frames),
            )
        )

    def _row(self, row: int) -> SectionFrame:
        random = numbers(4, self.section_id, row)
        return SectionFrame(
            frame_id=100 * self.section_id + row,
            capture_time_ns=self.frame(row).capture_time_ns,
            T_section_frame=random.random((4, 4)),
            exposure=Exposure(gain=random.random(3, np.float32), offset=random.random(3, np.float32)),
            view_depth=self.frame(row).depth if row % 2 == 0 else None,
        )


def sealed_section(small: SmallSection, frames: int) -> Section:
    """What sealing makes of it: the last row keeps its depth."""
    section = small.section(frames)
    last = replace(section.frames[-1], view_depth=small.frame(frames - 1).depth)
    return replace(section, frames=(*section.frames[:-1], last))


def section_bytes(section: Section) -> bytes:
    """All that is stored of a section, as bytes."""
    parts: list[npt.NDArray[np.generic]] = [section.T_world_section]
    for frame in section.frames:
        parts += [frame.T_section_frame, frame.exposure.gain, frame.exposure.offset]
        parts += [] if frame.view_depth is None else [frame.view_depth]
    g = section.gaussians
    parts += [g.frame_index, g.pixel, g.subpixel, g.depth, g.colors, g.log_radii, g.opacity_logits]
    rows = [(f.frame_id, f.capture_time_ns, f.view_depth is None) for f in section.frames]
    head = (section.section_id, section.camera, section.depth_scale_m, section.depth_factor, rows)
    return repr(head).encode() + b"".join(f"{p.dtype}{p.shape}".encode() + p.tobytes() for p in parts)


def frame_bytes(frame: Frame) -> bytes:
    """All that a frame is, as bytes."""
    head = (frame.frame_id, frame.capture_time_ns, frame.depth_scale_m, frame.camera)
    prior = frame.pose_prior
    told = b"" if prior is None else prior.T_world_camera.tobytes() + prior.covariance.tobytes()
    return repr(head).encode() + told + frame.rgb.tobytes() + frame.depth.tobytes()


def state_bytes(state: ActiveState) -> bytes:
    """All that a state of an active section is, as bytes."""
    head = (state.generation, state.trained_rows, state.neighbour_ids, state.facts)
    parts = [repr(head).encode(), section_bytes(state.section), *map(frame_bytes, state.frames)]
    for attribute in () if state.moments is None else state.moments.in_order():
        parts += [str(attribute.step_count).encode(), attribute.m.tobytes(), attribute.v.tobytes()]
    return b"".join(parts)

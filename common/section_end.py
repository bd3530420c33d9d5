"""Where the stream is cut into sections: after so many frames, or so many metres, or when memory is full."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.section import Section
from vtslam.common.settings import Settings
from vtslam.common.shm.capacity import MappingCost


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionEnd:
    """When a section takes no further frame.

    Whoever has the committed poses and the map that frames are tracked against comes to the same answer, to the bit:
    poses are relative to the section, so that neither its place in the world nor a later correction of that matters.

    Attributes:
        frames: After so many frames ...
        metres: ... or so many metres between their cameras, 0 for any ...
        gaussians: ... or when another frame may make it have more Gaussians than these.
        lead: Frames that tracking is ahead of mapping.
    """

    frames: int
    metres: float
    gaussians: int
    lead: int = 0

    @classmethod
    def of(cls, settings: Settings, camera: Camera, *, lead: int = 0) -> "SectionEnd":
        """As the settings say, and as the map store holds.

        One process keeps no map store, but ends sections where a fleet would.
        """
        fitting = _mapping_cost(settings, camera, lead).gaussians_within(settings.fleet.map_budget_mb * 10**6)
        section = settings.section
        return cls(frames=section.length, metres=section.length_m, gaussians=fitting, lead=lead)

    def is_reached_by_poses(self, T_section_frames: Sequence[npt.NDArray[np.float64]]) -> bool:
        """Whether these poses, float64 [4,4] of a section's frames up to now, end it."""
        if len(T_section_frames) >= self.frames:
            return True
        return self.metres > 0.0 and travelled_m(T_section_frames) >= self.metres

    def is_reached_by_gaussians(self, frame_index: npt.NDArray[np.uint16], row: int) -> bool:
        """Whether the Gaussians end the section before the frame in ``row``.

        Those count that are in the map which this frame would be tracked against. It, and those that are tracked before
        it is mapped, may each add as many as the head did, if they show nothing known.

        Args:
            frame_index: uint16 [N], the frames that Gaussians of the section are tied to, in order: those of that map,
                or of a later one. None goes before the section is finished.
            row: At least 1.
        """
        rows = np.array((tracked_against(row, self.lead), 1), frame_index.dtype)  # of another type, all would be cast
        known, head = np.searchsorted(frame_index, rows).tolist()
        return bool(known + (1 + self.lead) * head > self.gaussians)

    def is_reached(self, section: Section) -> bool:
        """Whether a section with these frames takes no further one."""
        poses = poses_in(section)
        return self.is_reached_by_poses(poses) or self.is_reached_by_gaussians(
            section.gaussians.frame_index, len(poses)
        )


def least_budget_mb(settings: Settings, camera: Camera, *, lead: int = 0) -> int:
    """The smallest ``fleet.map_budget_mb`` with which a section has room for a head and a frame beside it."""
    gaussians = (2 + lead) * camera.width * camera.height + 1
    return -(-_mapping_cost(settings, camera, lead).bytes_with(gaussians) // 10**6)


def _mapping_cost(settings: Settings, camera: Camera, lead: int) -> MappingCost:
    section = settings.section
    return MappingCost.of(
        camera,
        frames=section.length,
        views=-(-section.length // section.candidate_interval),
        with_moments=settings.mapper.keep_moments,
        kept_generations=1 + lead,
    )


def tracked_against(row: int, lead: int) -> int:
    """Frames of its section whose map the frame in this row is tracked against, ``lead`` frames ahead of mapping."""
    return min(row, max(row - lead, 1))


def travelled_m(T_section_frames: Sequence[npt.NDArray[np.float64]]) -> float:
    """The length of the way from the first to the last of these poses."""
    way_m = 0.0
    for before, after in pairwise(T_section_frames):
        x, y, z = (after[:3, 3] - before[:3, 3]).tolist()
        way_m += (x * x + y * y + z * z) ** 0.5
    return way_m


def poses_in(section: Section) -> tuple[npt.NDArray[np.float64], ...]:
    """``T_section_frame`` float64 [4,4] of each of its frames."""
    return tuple(frame.T_section_frame for frame in section.frames)

"""A section: N consecutive frames, the Gaussians tied to them, and the views that answer overlap questions."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.gaussians import ViewTiedGaussians
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.optim.surface import measured_surface
from vtslam.common.rows import GrowingRows, thinned
from vtslam.common.splat.engine import Splats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionFrame:
    """A frame of a section.

    Attributes:
        frame_id: Its place in the stream.
        capture_time_ns: Capture time.
        T_section_frame: float64 [4,4], camera coordinates to section coordinates.
        exposure: How the frame shows the map's colours.
        view_depth: uint16 [H,W] if the frame answers overlap or visibility questions, else None.
    """

    frame_id: int
    capture_time_ns: int
    T_section_frame: npt.NDArray[np.float64]
    exposure: Exposure = field(default_factory=Exposure.identity)
    view_depth: npt.NDArray[np.uint16] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Section:
    """A section of the map. Its head frame comes first; the head's pose at creation is the section's frame.

    Attributes:
        section_id: From 0, in order of creation.
        T_world_section: float64 [4,4], the anchor.
        camera: Intrinsics of all its frames.
        depth_scale_m: Metres per unit of frame depth.
        depth_factor: Factor on depth when Gaussians are placed.
        frames: The frame table.
        gaussians: The Gaussians tied to those frames.
        means_m: float32 [N,3], their positions in section coordinates; recomputed from the rest, never stored.
        surface: float32 [M,6], points (m) and normals that its views with depth measured, in section coordinates; what
            frames are aligned to. Recomputed likewise.
    """

    section_id: int
    T_world_section: npt.NDArray[np.float64]
    camera: Camera
    depth_scale_m: float
    depth_factor: float
    frames: tuple[SectionFrame, ...]
    gaussians: ViewTiedGaussians
    means_m: npt.NDArray[np.float32]
    surface: npt.NDArray[np.float32]

    def retied(self, earlier: "Section | None" = None) -> "Section":
        """The section with positions and surface computed from its frames' poses.

        Args:
            earlier: A former state of it, from which the surface is taken as far as that goes.
        """
        bare = earlier or replace(self, surface=np.zeros((0, 6), np.float32), frames=())
        known = {each.frame_id for each in bare.frames if each.view_depth is not None}
        surface = bare._surface_with([each for each in self.frames if each.frame_id not in known])
        return replace(self, means_m=self._means_of(self.gaussians), surface=surface)

    def grown(self, frame: SectionFrame, new: ViewTiedGaussians) -> "Section":
        """The section with one more frame and the Gaussians tied to it."""
        longer = replace(self, frames=(*self.frames, frame))
        return replace(
            longer,
            gaussians=self.gaussians.appended(new),
            means_m=np.concatenate([self.means_m, longer._means_of(new)]),
            surface=self._surface_with([frame]),
        )

    def finished(self, last: int, view_depth: npt.NDArray[np.uint16]) -> "Section":
        """The section as it will be read back, to the bit; frame ``last`` keeps its depth, and none after it does."""
        if self.frames[last].view_depth is not None:
            return self
        frame = replace(self.frames[last], view_depth=view_depth)
        frames = (*self.frames[:last], frame, *self.frames[last + 1 :])
        return replace(self, frames=frames, surface=self._surface_with([frame]))

    def thinned(self, kept: npt.NDArray[np.bool_]) -> "Section":
        """Without those of the last Gaussians that are not ``kept`` (bool [M])."""
        return replace(self, gaussians=self.gaussians.thinned(kept), means_m=thinned(self.means_m, kept))

    def continued(self, earlier: "Section", means_m: GrowingRows[np.float32]) -> "Section":
        """As :meth:`retied`, with the parts that a former state of the section already has taken from there.

        Args:
            earlier: That state.
            means_m: Its positions; those of further Gaussians are added.
        """
        means_m.extend(self._means_of(self.gaussians.rows_from(earlier.gaussians.count)))
        return replace(self, means_m=means_m.values, surface=earlier._surface_with(self.frames[len(earlier.frames) :]))

    def with_surface_of(self, other: "Section") -> "Section":
        """The section with another one's measured surface beside its own; itself if the other one is this one."""
        if other.section_id == self.section_id:
            return self
        T = se3.inverse(self.T_world_section) @ other.T_world_section
        moved = np.empty_like(other.surface)
        moved[:, :3] = other.surface[:, :3].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        moved[:, 3:] = other.surface[:, 3:].astype(np.float64) @ T[:3, :3].T
        return replace(self, surface=np.concatenate([self.surface, moved]))

    def _means_of(self, gaussians: ViewTiedGaussians) -> npt.NDArray[np.float32]:
        poses = np.stack([f.T_section_frame for f in self.frames])
        return gaussians.means_m(self.camera, poses, depth_unit_m=self.depth_unit_m)

    def _surface_with(self, frames: Sequence[SectionFrame]) -> npt.NDArray[np.float32]:
        """The surface, and what further frames measured; the same array if that is nothing, as of most frames."""
        parts = [
            measured_surface(each.view_depth, self.camera, each.T_section_frame, depth_scale_m=self.depth_scale_m)
            for each in frames
            if each.view_depth is not None
        ]
        return np.concatenate([self.surface, *parts]) if parts else self.surface

    @property
    def depth_unit_m(self) -> float:
        """Metres per unit of depth as Gaussians are placed."""
        return self.depth_scale_m * self.depth_factor

    @property
    def splats(self) -> Splats:
        """All Gaussians in section coordinates."""
        return self.gaussians.splats(self.means_m)

    @property
    def head(self) -> SectionFrame:
        """The first frame."""
        return self.frames[0]

    def T_world_frame(self, index: int) -> npt.NDArray[np.float64]:
        """Pose ``T_world_camera`` float64 [4,4] of the frame in row ``index``."""
        return self.T_world_section @ self.frames[index].T_section_frame

    def T_section_camera(self, T_world_camera: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """A world pose as seen from the section."""
        return se3.inverse(self.T_world_section) @ T_world_camera


def joined_splats(sections: list[Section], *, into: Section) -> Splats:
    """Gaussians of several sections in the coordinates of ``into`` (Eq. 2: the current and its neighbours)."""
    means = []
    for section in sections:
        T = se3.inverse(into.T_world_section) @ section.T_world_section
        means.append((section.means_m @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
    return Splats(
        means_m=np.concatenate(means),
        colors=np.concatenate([s.gaussians.colors for s in sections]),
        log_radii=np.concatenate([s.gaussians.log_radii for s in sections]),
        opacity_logits=np.concatenate([s.gaussians.opacity_logits for s in sections]),
    )

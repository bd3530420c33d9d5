"""What the mapper carries from frame to frame of a section, and what it commits."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.frame import Frame
from vtslam.common.optim.adam import Adam
from vtslam.common.section import Section


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingView:
    """A frame of the active section that is rendered against: row in the frame table, images, exposure."""

    frame_index: int
    frame: Frame
    exposure: Exposure = field(default_factory=Exposure.identity)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moments:
    """Adam's state of the three attributes of a section's Gaussians."""

    colors: Adam
    log_radii: Adam
    opacity_logits: Adam


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ActiveSection:
    """The section being mapped, with all that crosses a frame boundary.

    Attributes:
        section: Frame table, Gaussians and anchor.
        views: Frames rendered against (held-out frames are left out).
        neighbour_ids: The previous and the overlapping section of Eq. 2, without repetition; empty for section 0.
        moments: Optimiser state, if it is kept.
    """

    section: Section
    views: tuple[TrainingView, ...]
    neighbour_ids: tuple[int, ...]
    moments: Moments | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommitRecord:
    """What one mapped frame changed.

    Attributes:
        frame_id: The frame.
        section_id: Its section.
        frame_index: Its row in the section's frame table.
        T_world_camera: float64 [4,4], its committed pose.
        exposure: How the frame shows the map's colours.
        gaussians_added: New Gaussians tied to it.
        gaussians: Gaussians of the section afterwards.
        iterations: Optimiser steps spent.
        renders: Renders spent.
        loss: Eq. 2 at the last step; 0 if there was none.
        held_out: Whether the frame was kept out of mapping.
    """

    frame_id: int
    section_id: int
    frame_index: int
    T_world_camera: npt.NDArray[np.float64]
    exposure: Exposure
    gaussians_added: int
    gaussians: int
    iterations: int
    renders: int
    loss: float
    held_out: bool

"""What a way to estimate a pose is given, and what it gives back."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.section import Section

Matrix4 = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseTask:
    """One frame to find in a map.

    Attributes:
        frame: The frame.
        rgb: float32 [H,W,3], its colour in the map's gauge.
        mask: uint8 [H,W], its usable pixels.
        section: The map.
        previous: The frame before it.
        T_section_previous: float64 [4,4], that frame's true pose.
    """

    frame: Frame
    rgb: npt.NDArray[np.float32]
    mask: npt.NDArray[np.uint8]
    section: Section
    previous: Frame
    T_section_previous: Matrix4

    def masked_depth_m(self) -> npt.NDArray[np.float32]:
        """Depth float32 [H,W] (m) at the usable pixels, 0 elsewhere."""
        return np.where(self.mask > 0, self.frame.depth_m(), np.float32(0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundPose:
    """A pose and what it took.

    Attributes:
        T_camera_section: float64 [4,4].
        renders: Renders of any size.
        full_size_renders: The same by pixels: one of half the width counts for a quarter.
    """

    T_camera_section: Matrix4
    renders: int
    full_size_renders: float


class SolvesPose(Protocol):
    """A way to estimate a pose."""

    def solve(self, task: PoseTask, T_guess: Matrix4) -> FoundPose:
        """The pose ``T_camera_section`` float64 [4,4], from a first guess of it."""
        ...

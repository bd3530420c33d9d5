"""Where the stream is cut into sections: after so many frames, or so many metres."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from vtslam.common.section import Section
from vtslam.common.settings import SectionSettings


def section_is_full(T_section_frames: Sequence[npt.NDArray[np.float64]], settings: SectionSettings) -> bool:
    """Whether a section takes no further frame.

    Whoever has the committed poses comes to the same answer, to the bit: poses are relative to the section, so that
    neither its place in the world nor a later correction of that matters.

    Args:
        T_section_frames: float64 [4,4], of its frames up to now.
        settings: How long sections are.
    """
    if len(T_section_frames) >= settings.length:
        return True
    return settings.length_m > 0.0 and travelled_m(T_section_frames) >= settings.length_m


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

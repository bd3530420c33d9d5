"""The fixed parts of the mask W in Eq. 1: valid depth, far filter, visibility from the overlapping section."""

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.overlap.selection import seen_by_view, world_points_m
from vtslam.common.section import Section


def mean_depth_m(frame: Frame) -> float:
    """Mean of the valid depths in metres; 0 if there are none."""
    valid = np.count_nonzero(frame.depth)
    return int(frame.depth.sum(dtype=np.uint64)) / valid * frame.depth_scale_m if valid else 0.0


def near_and_valid(
    frame: Frame, *, far_factor: float, largest_mean_depths_m: tuple[float, ...]
) -> npt.NDArray[np.bool_]:
    """Pixels bool [H,W] with depth, nearer than ``far_factor`` times the mean of the largest mean depths (0: any)."""
    valid = frame.depth > 0
    if far_factor > 0 and largest_mean_depths_m:
        valid &= frame.depth_m() < far_factor * float(np.mean(largest_mean_depths_m))
    return np.asarray(valid)


def visible_in_section(
    frame: Frame, T_world_camera: npt.NDArray[np.float64], section: Section, *, tolerance: float
) -> npt.NDArray[np.bool_]:
    """Pixels bool [H,W] that the section's first, middle or last frame saw (paper, section 3.3: union of three)."""
    valid = frame.depth > 0
    points = world_points_m(frame, T_world_camera, valid)
    seen = np.zeros(points.shape[0], np.bool_)
    middle, last = len(section.frames) // 2, len(section.frames) - 1
    for index in sorted({0, middle, last}):
        view_depth = section.frames[index].view_depth
        if view_depth is None:
            continue
        seen |= seen_by_view(
            points,
            T_world_view=section.T_world_frame(index),
            view_depth=view_depth,
            depth_scale_m=section.depth_scale_m,
            camera=section.camera,
            tolerance=tolerance,
            border_px=0.0,
        )
    out = np.zeros(valid.shape, np.bool_)
    out[valid] = seen
    return out

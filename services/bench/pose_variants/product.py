"""Variants that are the product's own code: the tracker's optimisers with other settings, and OpenCV's odometry."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.settings import TrackerSettings
from vtslam.common.splat.engine import Engine
from vtslam.services.bench.pose_variants.task import FoundPose, Matrix4, PoseTask
from vtslam.services.tracker.odometry import rgbd_odometry
from vtslam.services.tracker.optimisers import make_optimiser

_LEAST_ALPHA = 0.5
_DEPTH_STEPS = 65535


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OfTracker:
    """An optimiser of the tracker (protocol ``SolvesPose``)."""

    engine: Engine
    settings: TrackerSettings
    threads: int

    def solve(self, task: PoseTask, T_guess: Matrix4) -> FoundPose:
        """See ``SolvesPose``."""
        optimiser = make_optimiser(
            task.frame, task.rgb, self.engine, self.settings, in_first_section=True, prior=None, threads=self.threads
        )
        estimate = optimiser.solve(task.section, task.mask, T_guess)
        return FoundPose(
            T_camera_section=estimate.T_camera_section,
            renders=estimate.renders,
            full_size_renders=float(estimate.renders),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpenCvOfView:
    """OpenCV's RGB-D odometry from the view rendered at the guess to the frame (protocol ``SolvesPose``)."""

    engine: Engine

    def solve(self, task: PoseTask, T_guess: Matrix4) -> FoundPose:
        """See ``SolvesPose``; the guess is kept if the odometry does not converge."""
        frame = replace(task.frame, rgb=_eight_bits(task.rgb))  # in the map's gauge, as the view is
        motion = rgbd_odometry(self._rendered(task, T_guess), frame)
        T = T_guess if motion is None else se3.inverse(motion) @ T_guess
        return FoundPose(T_camera_section=T, renders=1, full_size_renders=1.0)

    def _rendered(self, task: PoseTask, T_guess: Matrix4) -> Frame:
        """The map from the guess, as a frame."""
        camera = task.frame.camera
        rendering = self.engine.render(task.section.splats, camera, T_guess)
        covered = rendering.alpha > _LEAST_ALPHA
        inverse = np.where(covered, 1.0 / np.maximum(rendering.alpha, _LEAST_ALPHA), 0.0)
        units = np.clip(rendering.depth_m * inverse / task.frame.depth_scale_m, 0, _DEPTH_STEPS)
        return Frame(
            frame_id=task.previous.frame_id,
            capture_time_ns=task.previous.capture_time_ns,
            rgb=_eight_bits(rendering.rgb * inverse[..., None]),
            depth=np.rint(units).astype(np.uint16),
            depth_scale_m=task.frame.depth_scale_m,
            camera=camera,
        )


class OpenCvOfPrevious:
    """OpenCV's RGB-D odometry from the frame before, at its true pose (protocol ``SolvesPose``)."""

    def solve(self, task: PoseTask, T_guess: Matrix4) -> FoundPose:
        """See ``SolvesPose``; the guess is kept if the odometry does not converge."""
        motion = rgbd_odometry(task.previous, task.frame)
        T = T_guess if motion is None else se3.inverse(task.T_section_previous @ motion)
        return FoundPose(T_camera_section=T, renders=0, full_size_renders=0.0)


def _eight_bits(rgb: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Colours in 0..1 as a sensor gives them."""
    return np.asarray(np.rint(np.clip(rgb, 0.0, 1.0) * 255.0), np.uint8)

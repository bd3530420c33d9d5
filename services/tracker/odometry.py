"""RGB-D odometry between two frames, the rescue when the constant-velocity guess is far off (docs/method.md, 2.5)."""

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3


def rgbd_odometry(previous: Frame, current: Frame) -> npt.NDArray[np.float64] | None:
    """``T_previous_current`` float64 [4,4] by multi-scale RGB-D alignment, or None if it does not converge."""
    camera = previous.camera
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(
        np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]], np.float32)
    )
    settings.setMaxDepth(100.0)
    odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
    frames = []
    for frame in (previous, current):
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        depth = frame.depth_m()
        depth[depth <= 0] = np.nan
        frames.append(cv2.OdometryFrame(depth, gray))
        odometry.prepareFrame(frames[-1])
    found, T_current_previous = odometry.compute(frames[0], frames[1])
    if not found or not se3.is_rigid(np.asarray(T_current_previous, np.float64)):
        return None
    return se3.inverse(se3.orthonormalized(np.asarray(T_current_previous, np.float64)))

"""Surface normals of a depth image."""

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.optim import _align

_MAX_RELATIVE_DEPTH_STEP = 0.05  # neighbours further apart than this share no surface


def normals_from_depth(depth_m: npt.NDArray[np.float32], camera: Camera) -> npt.NDArray[np.float32]:
    """Unit normals float32 [H,W,3] (camera frame) of a depth image [H,W] (m) by central differences.

    Zero at the image border, at pixels without depth (0) and next to depth steps.
    """
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return np.asarray(_align.normals_from_depth(depth_m, intrinsics, _MAX_RELATIVE_DEPTH_STEP))

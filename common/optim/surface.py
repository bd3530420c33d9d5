"""The surface a view measured: points and normals of its depth image, what later frames are aligned to."""

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.optim import _align

_MAX_RELATIVE_DEPTH_STEP = 0.05  # neighbours further apart than this share no surface
_STRIDE_PX = 2  # a plane fit covers 9x9 pixels: denser points say nothing new ...
_STRIDE_WIDTH_PX = 320  # ... at this image width; wider images have more pixels, not more surface


def normals_from_depth(depth_m: npt.NDArray[np.float32], camera: Camera, *, stride: int = 1) -> npt.NDArray[np.float32]:
    """Unit normals float32 [H,W,3] (camera frame) of a depth image [H,W] (m) by plane fits over 9x9 pixels.

    Zero at pixels without depth (0) and where too few neighbours lie on the same surface. With a ``stride`` only those
    of every so-many-th pixel and row.
    """
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return np.asarray(_align.normals_from_depth(depth_m, intrinsics, _MAX_RELATIVE_DEPTH_STEP, stride))


def measured_surface(
    depth: npt.NDArray[np.uint16],
    camera: Camera,
    T_section_frame: npt.NDArray[np.float64],
    *,
    depth_scale_m: float,
) -> npt.NDArray[np.float32]:
    """Points (m) and unit normals of a grid of pixels in section coordinates, float32 [M,6].

    The grid has every other pixel at 320 pixels of width, and is as fine in angle for wider images.

    Args:
        depth: uint16 [H,W], as measured.
        camera: Intrinsics.
        T_section_frame: float64 [4,4], the view's pose in its section.
        depth_scale_m: Metres per unit of depth.
    """
    depth_m = depth.astype(np.float32) * np.float32(depth_scale_m)
    stride = max(_STRIDE_PX, round(_STRIDE_PX * camera.width / _STRIDE_WIDTH_PX))
    normals = normals_from_depth(depth_m, camera, stride=stride).reshape(-1, 3)
    points = (camera.pixel_rays()[::stride, ::stride] * depth_m[::stride, ::stride, None]).reshape(-1, 3)
    known = np.flatnonzero(normals.any(axis=1))
    rotation, translation = T_section_frame[:3, :3], T_section_frame[:3, 3]
    out = np.empty((known.size, 6), np.float32)
    out[:, :3] = points[known].astype(np.float64) @ rotation.T + translation
    out[:, 3:] = normals[known].astype(np.float64) @ rotation.T
    return out

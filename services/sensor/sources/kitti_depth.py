"""Depth of KITTI frames: from a rectified stereo pair, or from the laser scan taken with the image."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources.base import SourceError

Gray = npt.NDArray[np.uint8]
Depth = npt.NDArray[np.float32]

FARTHEST_M = 90.0

_FULL_WIDTH_PX, _FULL_DISPARITIES = 1240, 128  # of KITTI's images; nearer than 3 m nothing is matched
_BLOCK_PX = 5
_MAX_LEFT_RIGHT_PX = 1.0
_SPECKLE_PX, _SPECKLE_STEP = 150, 1
_SCAN_ROW_BYTES = 16  # x, y, z, reflectance as float32
_NEAREST_M = 0.5


def stereo_depth_m(left: Gray, right: Gray, *, focal_px: float, baseline_m: float) -> Depth:
    """Depth float32 [H,W] (m, 0 = none) of the left image by semi-global matching with a left-right check.

    Args:
        left: uint8 [H,W], rectified.
        right: uint8 [H,W], to the right of it.
        focal_px: Focal length.
        baseline_m: Distance of the cameras.
    """
    disparities = max(16, round(_FULL_DISPARITIES * left.shape[1] / _FULL_WIDTH_PX / 16) * 16)
    from_left = _disparity(left, right, disparities)
    from_right = _disparity(right[:, ::-1], left[:, ::-1], disparities)[:, ::-1]
    columns = np.arange(left.shape[1], dtype=np.float32)[None, :] - from_left
    rows = np.broadcast_to(np.arange(left.shape[0], dtype=np.float32)[:, None], columns.shape)
    back = cv2.remap(np.ascontiguousarray(from_right), columns, rows, cv2.INTER_NEAREST, borderValue=-1.0)
    agree = (from_left > 0.0) & (back > 0.0) & (np.abs(back - from_left) <= _MAX_LEFT_RIGHT_PX)
    depth_m = focal_px * baseline_m / np.where(agree, from_left, 1.0)
    return np.where(agree & (depth_m < FARTHEST_M), depth_m, 0.0).astype(np.float32)


def _disparity(left: Gray, right: Gray, disparities: int) -> Depth:
    """Disparity float32 [H,W] in pixels; not positive where there is none."""
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=disparities,
        blockSize=_BLOCK_PX,
        P1=8 * _BLOCK_PX**2,
        P2=32 * _BLOCK_PX**2,
        disp12MaxDiff=-1,  # the check above is with a second matching
        uniquenessRatio=8,
        speckleWindowSize=_SPECKLE_PX,
        speckleRange=_SPECKLE_STEP,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )
    # Padded, or the first columns, as many as there are disparities, would have none.
    wide = [
        cv2.copyMakeBorder(np.ascontiguousarray(x), 0, 0, disparities, 0, cv2.BORDER_CONSTANT) for x in (left, right)
    ]
    return np.asarray(matcher.compute(wide[0], wide[1])[:, disparities:], np.float32) / np.float32(16.0)


def read_scan(path: Path) -> npt.NDArray[np.float32]:
    """Points float32 [N,3] (m) of a velodyne file.

    Raises:
        SourceError: The file is missing, cut, or holds numbers that are not finite.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: expected a laser scan, found {error.strerror}") from error
    if not data or len(data) % _SCAN_ROW_BYTES:
        raise SourceError(
            f"{path}: expected a whole number of points of {_SCAN_ROW_BYTES} bytes, found {len(data)} bytes"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3]
    if not np.isfinite(points).all():
        raise SourceError(f"{path}: expected finite coordinates, found others")
    return np.asarray(points, np.float32)


def projected_scan_m(
    points: npt.NDArray[np.float32],
    T_camera_scan: npt.NDArray[np.float64],
    projection: npt.NDArray[np.float64],
    *,
    width: int,
    height: int,
    densify_px: int,
) -> Depth:
    """Depth float32 [H,W] (m, 0 = none) of a laser scan: the nearest point of each pixel.

    Args:
        points: float32 [N,3], scanner's coordinates (m).
        T_camera_scan: float64 [4,4], to the rectified camera 0.
        projection: float64 [3,4], camera 0 to the image, pixel centres at whole numbers.
        width: Of the image.
        height: Of the image.
        densify_px: Pixels without a point take the nearest depth found so many pixels around; 0 leaves them empty.
    """
    matrix = projection @ T_camera_scan
    projected = points.astype(np.float64) @ matrix[:, :3].T + matrix[:, 3]
    z = projected[:, 2]
    front = (z > _NEAREST_M) & (z < FARTHEST_M)
    projected, z = projected[front], z[front]
    columns = np.floor(projected[:, 0] / z + 0.5).astype(np.int64)
    rows = np.floor(projected[:, 1] / z + 0.5).astype(np.int64)
    inside = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    inverse = np.zeros(height * width, np.float32)
    np.maximum.at(inverse, rows[inside] * width + columns[inside], (1.0 / z[inside]).astype(np.float32))
    grid = inverse.reshape(height, width)
    filled = grid
    for _ in range(densify_px):
        filled = np.where(filled > 0, filled, cv2.dilate(filled, np.ones((3, 3), np.uint8)))
    return np.where(filled > 0, 1.0 / np.maximum(filled, 1e-6), 0.0).astype(np.float32)

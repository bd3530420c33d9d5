"""What the motion of image points says about speed, depth scale and focal lengths.

Corners are followed from one frame to another. With their depth, the motion of the camera explains where they went: how
well it does so tells whether the intrinsics fit, and true poses tell how long it was, hence the scale of depth.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera

Gray = npt.NDArray[np.uint8]
Points = npt.NDArray[np.float64]

_CORNERS = 300
_CORNERS_NEEDED = 30
_BACK_PX = 1.0  # a corner followed back must end this near to where it began
_PARALLAX_NEEDED_PX = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """Corners seen in two frames.

    Attributes:
        first_px, second_px: Continuous image coordinates float64 [K,2].
        followed_share: Share of the first frame's corners that were found again; NaN if there were too few.
    """

    first_px: Points
    second_px: Points
    followed_share: float

    @property
    def flow_px(self) -> float:
        """Median length of the corners' motion; 0 without corners."""
        moved = np.linalg.norm(self.second_px - self.first_px, axis=1)
        return float(np.median(moved)) if len(moved) else 0.0


def tracked_corners(first: Gray, second: Gray) -> Tracks:
    """Follow corners from one image [h,w] to another, and back again to be sure."""
    corners = cv2.goodFeaturesToTrack(first, _CORNERS, 0.01, 7)
    if corners is None or len(corners) < _CORNERS_NEEDED:
        return Tracks(first_px=np.empty((0, 2)), second_px=np.empty((0, 2)), followed_share=float("nan"))
    there, found = _followed(first, second, np.asarray(corners, np.float32))
    back, found_again = _followed(second, first, there)
    near = np.linalg.norm((back - corners).reshape(-1, 2), axis=1) < _BACK_PX
    kept = found & found_again & near
    # OpenCV puts pixel centres at whole numbers.
    first_px, second_px = (points.reshape(-1, 2)[kept].astype(np.float64) + 0.5 for points in (corners, there))
    return Tracks(first_px=first_px, second_px=second_px, followed_share=float(kept.mean()))


def _followed(
    first: Gray, second: Gray, points: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        first, second, points, np.empty_like(points), winSize=(15, 15), maxLevel=4
    )
    return np.asarray(moved, np.float32), status.ravel() > 0


def with_depth(tracks: Tracks, depth_m: npt.NDArray[np.float32]) -> tuple[Points, Points, npt.NDArray[np.float64]]:
    """Those tracks that have depth [h,w] (m) in the first frame: both places [K,2] (px) and depths [K] (m)."""
    columns, rows = np.floor(tracks.first_px).astype(int).T if len(tracks.first_px) else (np.empty(0, int),) * 2
    height, width = depth_m.shape
    z_m = depth_m[rows.clip(0, height - 1), columns.clip(0, width - 1)].astype(np.float64)
    kept = z_m > 0.0
    return tracks.first_px[kept], tracks.second_px[kept], z_m[kept]


def unexplained_px(first_px: Points, second_px: Points, z_m: npt.NDArray[np.float64], camera: Camera) -> float | None:
    """Median distance (px) that no motion of this camera explains; None if there are too few corners to say.

    Args:
        first_px: Corners in the first frame, float64 [K,2].
        second_px: The same in the second, float64 [K,2].
        z_m: Their depth in the first frame, float64 [K].
        camera: Intrinsics to try.
    """
    if len(z_m) < _CORNERS_NEEDED:
        return None
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    points_m = _back_projected(first_px, z_m, camera)
    cv2.setRNGSeed(0)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points_m, second_px, matrix, np.zeros(4), reprojectionError=1.5, iterationsCount=100
    )
    if not found:
        return None
    projected = cv2.projectPoints(points_m, rotation, translation, matrix, np.zeros(4))[0].reshape(-1, 2)
    return float(np.median(np.linalg.norm(projected - second_px, axis=1)))


def focal_lengths_swapped(camera: Camera) -> Camera:
    """The camera with fx and fy exchanged."""
    return replace(camera, fx=camera.fy, fy=camera.fx)


def depth_scale_error(
    first_px: Points,
    second_px: Points,
    z_m: npt.NDArray[np.float64],
    camera: Camera,
    T_second_first: npt.NDArray[np.float64],
) -> float | None:
    """Depth as it is over depth as the true motion ``T_second_first`` [4,4] makes it; None if that hardly shows.

    With depth ``s`` times too large, the camera seems to have moved ``s`` times as far: the corners' second places
    give ``s`` linearly.
    """
    rotated_m = _back_projected(first_px, z_m, camera) @ T_second_first[:3, :3].T
    translation_m = T_second_first[:3, 3]
    focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rays = np.concatenate([(second_px - center) / focal, np.ones((len(z_m), 1))], axis=1)
    by_translation = np.cross(rays, np.broadcast_to(translation_m, rays.shape))
    by_rotation = np.cross(rays, rotated_m)
    turned_px = rotated_m[:, :2] / rotated_m[:, 2:] * focal + center
    parallax_px = np.linalg.norm(second_px - turned_px, axis=1)
    seen = (parallax_px > _PARALLAX_NEEDED_PX) & (np.linalg.norm(by_translation, axis=1) > 0.0)
    if seen.sum() < _CORNERS_NEEDED:
        return None
    squared = (by_translation[seen] ** 2).sum(axis=1)
    return float(np.median(-(by_translation[seen] * by_rotation[seen]).sum(axis=1) / squared))


def _back_projected(places_px: Points, z_m: npt.NDArray[np.float64], camera: Camera) -> Points:
    rays = np.ones((len(z_m), 3))
    rays[:, 0] = (places_px[:, 0] - camera.cx) / camera.fx
    rays[:, 1] = (places_px[:, 1] - camera.cy) / camera.fy
    return rays * z_m[:, None]

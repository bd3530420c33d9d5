"""Where a film is taken from: outside the map and above it, slowly going round."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera

_ELEVATION_RAD, _TURN_RAD = np.deg2rad(50.0), np.deg2rad(50.0)
_FIELD_RAD = np.deg2rad(40.0)  # small: nearly parallel
_SEEN_SHARE = 0.96  # of Gaussians and path, which count alike, in the picture


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Onlooker:
    """A camera that goes round a point.

    Attributes:
        camera: Its intrinsics.
        target_m: float64 [3], what it looks at.
        radius_m: Of what is to be seen around that.
        axes: float64 [3,3], rows: ahead and right on the ground, and up.
    """

    camera: Camera
    target_m: npt.NDArray[np.float64]
    radius_m: float
    axes: npt.NDArray[np.float64]

    def T_camera_map(self, turn: float) -> npt.NDArray[np.float64]:
        """Its pose float64 [4,4] after a share ``turn`` (0 to 1) of its way."""
        ahead, right, up = self.axes
        angle = _TURN_RAD * (turn - 0.5)
        ground = np.cos(angle) * ahead + np.sin(angle) * right
        z = np.cos(_ELEVATION_RAD) * ground - np.sin(_ELEVATION_RAD) * up
        x = np.cross(z, up) / np.linalg.norm(np.cross(z, up))
        rotation = np.stack([x, np.cross(z, x), z])
        distance_m = self.radius_m / np.tan(0.5 * _FIELD_RAD)
        T = np.eye(4)
        T[:3, :3] = rotation
        T[:3, 3] = -rotation @ (self.target_m - distance_m * z)
        return T


def onlooker(
    means_m: npt.NDArray[np.float32],
    poses: npt.NDArray[np.float64],
    center_m: npt.NDArray[np.float64],
    size: tuple[int, int],
) -> Onlooker:
    """The camera for a map; upright as the cameras of the run were on average.

    Args:
        means_m: float32 [N,3], its Gaussians relative to ``center_m``.
        poses: float64 [F,4,4], ``T_world_camera``.
        center_m: float64 [3], in the world.
        size: Width and height of the picture.
    """
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    ahead = poses[0, :3, 2] - (poses[0, :3, 2] @ up) * up
    ahead /= np.linalg.norm(ahead)
    shown_m = np.concatenate(
        [means_m, np.repeat(poses[:, :3, 3] - center_m, max(len(means_m) // len(poses), 1), axis=0)]
    )
    low_m, high_m = np.quantile(shown_m, ((1 - _SEEN_SHARE) / 2, (1 + _SEEN_SHARE) / 2), axis=0)
    target_m = 0.5 * (low_m + high_m)
    radius_m = float(np.quantile(np.linalg.norm(shown_m - target_m, axis=1), _SEEN_SHARE))
    width, height = size
    focal = 0.5 * height / np.tan(0.5 * _FIELD_RAD)
    camera = Camera(width=width, height=height, fx=focal, fy=focal, cx=0.5 * width, cy=0.5 * height)
    return Onlooker(
        camera=camera, target_m=target_m, radius_m=radius_m, axes=np.stack([ahead, np.cross(ahead, up), up])
    )


def project_px(
    points_m: npt.NDArray[np.float64], camera: Camera, T_camera_map: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Image points [N,2] of points [N,3] in front of a camera."""
    x, y, z = (points_m @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]).T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)

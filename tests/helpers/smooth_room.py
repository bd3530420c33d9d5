"""An analytic scene: the inside of an ellipsoid with a smooth texture, seen exactly from any pose."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.splat.engine import Rendering

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

DEPTH_SCALE_M = 0.0002


def small_camera(width: int = 64, height: int = 48) -> Camera:
    """A camera with a horizontal field of view of about 63 degrees and its principal point off the middle."""
    return Camera(
        width=width, height=height, fx=0.82 * width, fy=0.84 * width, cx=0.5 * width + 0.7, cy=0.5 * height - 0.4
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothRoom:
    """The ellipsoid with half axes ``radii_m`` about the world's origin, coloured by seeded waves in space."""

    seed: int = 0
    radii_m: tuple[float, float, float] = (2.6, 2.0, 3.1)

    def view(self, T_world_camera: Array, camera: Camera) -> tuple[Image, Image]:
        """Colour float32 [H,W,3] in 0..1 and depth float32 [H,W] (m) at the pixel centres."""
        rays = camera.pixel_rays().astype(np.float64)
        inverse_radii = 1.0 / np.array(self.radii_m)
        ahead = (rays @ T_world_camera[:3, :3].T) * inverse_radii
        origin = T_world_camera[:3, 3] * inverse_radii
        a, b, c = (ahead**2).sum(-1), ahead @ origin, float(origin @ origin) - 1.0
        assert c < 0, "the camera must be inside"
        z = (-b + np.sqrt(b * b - a * c)) / a
        points = (rays * z[..., None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        return self._color(points).astype(np.float32), z.astype(np.float32)

    def normals(self, points_world_m: Array) -> Array:
        """Outward unit normals [...,3] at points of the surface [...,3], world."""
        gradient = points_world_m / np.square(self.radii_m)
        return np.asarray(gradient / np.linalg.norm(gradient, axis=-1, keepdims=True))

    def rendering(self, T_world_camera: Array, camera: Camera) -> Rendering:
        """The view as a rasteriser would give it, fully covered."""
        rgb, depth_m = self.view(T_world_camera, camera)
        return Rendering(rgb=rgb, depth_m=depth_m, alpha=np.ones_like(depth_m), saved=None)

    def frame(self, T_world_camera: Array, camera: Camera, *, frame_id: int = 0) -> Frame:
        """The view as a sensor gives it: 8-bit colour, depth in steps of 0.2 mm."""
        rgb, depth_m = self.view(T_world_camera, camera)
        return Frame(
            frame_id=frame_id,
            capture_time_ns=frame_id * 33_333_333,
            rgb=np.rint(rgb * 255.0).astype(np.uint8),
            depth=np.rint(depth_m / DEPTH_SCALE_M).astype(np.uint16),
            depth_scale_m=DEPTH_SCALE_M,
            camera=camera,
        )

    def _color(self, points_m: Array) -> Array:
        rng = np.random.default_rng(self.seed)
        directions = rng.normal(size=(3, 4, 3))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        waves_per_m = 2.0 * np.pi / rng.uniform(0.8, 1.6, size=(3, 4))
        phases = rng.uniform(0.0, 2.0 * np.pi, size=(3, 4))
        angle = np.einsum("hwk,cnk->hwcn", points_m, directions * waves_per_m[..., None]) + phases
        return np.asarray(0.5 + 0.11 * np.sin(angle).sum(-1))

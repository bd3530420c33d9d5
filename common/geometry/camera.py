"""The pinhole camera, and the one function that says what resizing does to it.

Image coordinates are continuous: pixel (column u, row v) covers [u, u+1) x [v, v+1) and has its centre at
(u + 0.5, v + 0.5). Recordings that put centres at whole numbers are read with :meth:`Camera.from_integer_centred`.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Pinhole intrinsics: image size in pixels, focal lengths and principal point in pixels (see module text).

    Raises:
        ValueError: A size or focal length is not positive, or a value is not finite.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy)
        if self.width < 1 or self.height < 1 or not np.isfinite(values).all() or self.fx <= 0 or self.fy <= 0:
            raise ValueError(f"not a camera: size {self.width}x{self.height}, fx fy cx cy {values}")

    @classmethod
    def from_integer_centred(cls, *, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> "Camera":
        """A camera whose principal point is given with pixel centres at whole numbers (most data sets)."""
        return cls(width=width, height=height, fx=fx, fy=fy, cx=cx + 0.5, cy=cy + 0.5)

    @property
    def mean_focal_px(self) -> float:
        """(fx + fy) / 2, the f of Eq. 3."""
        return 0.5 * (self.fx + self.fy)

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of the image scaled to ``width`` x ``height``.

        With centres at half-integers every intrinsic scales by its ratio. For centres at whole numbers the same rule
        reads ``cx' = (cx + 0.5) * s - 0.5``: the half-pixel term that plain scaling forgets.
        """
        sx, sy = width / self.width, height / self.height
        return Camera(width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def pixel_rays(self) -> npt.NDArray[np.float32]:
        """Rays (x, y, 1) through all pixel centres, float32 [H,W,3], camera frame (x right, y down, z forward)."""
        rays = np.ones((self.height, self.width, 3), np.float32)
        rays[..., 0] = ((np.arange(self.width) + 0.5 - self.cx) / self.fx)[None, :]
        rays[..., 1] = ((np.arange(self.height) + 0.5 - self.cy) / self.fy)[:, None]
        return rays

    def back_projected(self, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Points [H,W,3] (m, camera frame) of a depth image [H,W] (m along z); depth 0 gives the origin."""
        return self.pixel_rays() * depth_m[..., None]

    def projected(self, points_m: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Continuous image coordinates [...,2] of camera-frame points [...,3] (m, z > 0)."""
        z = points_m[..., 2]
        u = self.fx * points_m[..., 0] / z + self.cx
        v = self.fy * points_m[..., 1] / z + self.cy
        return np.stack([u, v], axis=-1).astype(np.float64)

    def as_dict(self) -> dict[str, float]:
        """The fields as plain numbers, for files and messages."""
        return {
            "width": self.width,
            "height": self.height,
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx,
            "cy": self.cy,
        }

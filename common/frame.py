"""One RGB-D frame as the sensor gave it."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.external_pose import ExternalPose
from vtslam.common.geometry.camera import Camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """An RGB-D frame; depth stays uint16 from the source on, so that stores, files and replay are exact.

    Attributes:
        frame_id: Place in the stream, from 0.
        capture_time_ns: Capture time, integer nanoseconds.
        rgb: uint8 [H,W,3], red first.
        depth: uint16 [H,W], in units of ``depth_scale_m`` along the optical axis; 0 means no depth.
        depth_scale_m: Metres per depth unit.
        camera: Intrinsics of both images (they are registered).
        pose_prior: Where something else than the tracker says the camera was; None if nothing does.

    Raises:
        ValueError: An array has another shape or type than stated, or the scale is not positive.
    """

    frame_id: int
    capture_time_ns: int
    rgb: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.uint16]
    depth_scale_m: float
    camera: Camera
    pose_prior: ExternalPose | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        if self.rgb.shape != (*size, 3) or self.rgb.dtype != np.uint8:
            raise ValueError(f"rgb must be uint8 {(*size, 3)}, got {self.rgb.dtype} {self.rgb.shape}")
        if self.depth.shape != size or self.depth.dtype != np.uint16:
            raise ValueError(f"depth must be uint16 {size}, got {self.depth.dtype} {self.depth.shape}")
        if not self.depth_scale_m > 0.0:
            raise ValueError(f"depth_scale_m must be positive, got {self.depth_scale_m}")

    def depth_m(self) -> npt.NDArray[np.float32]:
        """Depth in metres, float32 [H,W]; 0 where there is none."""
        return self.depth.astype(np.float32) * np.float32(self.depth_scale_m)

    def rgb_float(self) -> npt.NDArray[np.float32]:
        """Colour in 0..1, float32 [H,W,3]."""
        return self.rgb.astype(np.float32) * np.float32(1.0 / 255.0)

    def resized(self, width: int, height: int) -> "Frame":
        """The frame scaled to ``width`` x ``height``: colour by area, depth by nearest, camera to match."""
        if (width, height) == (self.camera.width, self.camera.height):
            return self
        rgb = cv2.resize(self.rgb, (width, height), interpolation=cv2.INTER_AREA)
        depth = cv2.resize(self.depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        return replace(
            self,
            rgb=np.asarray(rgb, np.uint8),
            depth=np.asarray(depth, np.uint16),
            camera=self.camera.resized(width, height),
        )

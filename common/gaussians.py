"""View-tied Gaussians: one small sphere per depth pixel, placed by pixel, depth and pose (paper, section 3.2).

Only colour, radius and opacity are learned. A position is never stored: it follows from the frame the Gaussian is tied
to, its pixel, that pixel's depth and the frame's pose, so moving a frame moves its Gaussians.
"""

from dataclasses import dataclass, fields

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.frame import Frame
from vtslam.common.geometry import _points
from vtslam.common.geometry.camera import Camera
from vtslam.common.rows import thinned
from vtslam.common.splat.engine import Splats

# Offset of a Gaussian from its pixel's centre in pixels, by ``subpixel``: 0 is the pixel itself, 1 to 4 the four
# half-size entries of the edge supplement (the pixel centres of the image at twice the resolution).
SUBPIXEL_OFFSETS_PX = np.array([[0, 0], [-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]], np.float32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewTiedGaussians:
    """Struct of arrays over N Gaussians of one section.

    Attributes:
        frame_index: uint16 [N], row of the section's frame table.
        pixel: int32 [N], ``row * width + column``.
        subpixel: uint8 [N], 0 to 4 (``SUBPIXEL_OFFSETS_PX``).
        depth: uint16 [N], the frame's depth at the pixel, in its own units.
        colors: float32 [N,3], not clamped.
        log_radii: float32 [N], natural logarithm of sigma in metres.
        opacity_logits: float32 [N].
    """

    frame_index: npt.NDArray[np.uint16]
    pixel: npt.NDArray[np.int32]
    subpixel: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.uint16]
    colors: npt.NDArray[np.float32]
    log_radii: npt.NDArray[np.float32]
    opacity_logits: npt.NDArray[np.float32]

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.pixel.shape[0])

    @classmethod
    def empty(cls) -> "ViewTiedGaussians":
        """No Gaussians."""
        return cls(
            frame_index=np.zeros(0, np.uint16),
            pixel=np.zeros(0, np.int32),
            subpixel=np.zeros(0, np.uint8),
            depth=np.zeros(0, np.uint16),
            colors=np.zeros((0, 3), np.float32),
            log_radii=np.zeros(0, np.float32),
            opacity_logits=np.zeros(0, np.float32),
        )

    def appended(self, other: "ViewTiedGaussians") -> "ViewTiedGaussians":
        """These Gaussians followed by ``other``'s; rows already here keep their index."""
        return ViewTiedGaussians(
            **{f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)}
        )

    def thinned(self, kept: npt.NDArray[np.bool_]) -> "ViewTiedGaussians":
        """Without those of the last rows that are not ``kept`` (bool [M])."""
        return ViewTiedGaussians(**{f.name: thinned(getattr(self, f.name), kept) for f in fields(self)})

    def rows_from(self, first: int) -> "ViewTiedGaussians":
        """The Gaussians from row ``first`` on."""
        return ViewTiedGaussians(**{f.name: getattr(self, f.name)[first:] for f in fields(self)})

    def copied(self) -> "ViewTiedGaussians":
        """The same in memory of its own."""
        return ViewTiedGaussians(**{f.name: getattr(self, f.name).copy() for f in fields(self)})

    def with_attributes(
        self,
        *,
        colors: npt.NDArray[np.float32],
        log_radii: npt.NDArray[np.float32],
        opacity_logits: npt.NDArray[np.float32],
    ) -> "ViewTiedGaussians":
        """The same ties with other learned attributes."""
        return ViewTiedGaussians(
            frame_index=self.frame_index,
            pixel=self.pixel,
            subpixel=self.subpixel,
            depth=self.depth,
            colors=colors,
            log_radii=log_radii,
            opacity_logits=opacity_logits,
        )

    def points_frame_m(self, camera: Camera, *, depth_unit_m: float) -> npt.NDArray[np.float64]:
        """Positions float64 [N,3] (m), each in the camera frame it is tied to.

        ``depth_unit_m`` is metres per depth unit, the map's depth factor included.
        """
        offset = SUBPIXEL_OFFSETS_PX[self.subpixel]
        u = self.pixel % camera.width + 0.5 + offset[:, 0].astype(np.float64)
        v = self.pixel // camera.width + 0.5 + offset[:, 1].astype(np.float64)
        z = self.depth * depth_unit_m
        return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)

    def means_m(
        self, camera: Camera, T_section_frames: npt.NDArray[np.float64], *, depth_unit_m: float
    ) -> npt.NDArray[np.float32]:
        """Positions float32 [N,3] (m) in the section's frame, given its frames' poses float64 [F,4,4].

        Those of a Gaussian do not depend on the others, to the bit. Raises IndexError for a frame without a pose.
        """
        return np.asarray(
            _points.tied_points(
                np.ascontiguousarray(self.frame_index),
                np.ascontiguousarray(self.pixel),
                np.ascontiguousarray(self.subpixel),
                np.ascontiguousarray(self.depth),
                np.ascontiguousarray(T_section_frames, np.float64),
                SUBPIXEL_OFFSETS_PX,
                camera.width,
                (camera.fx, camera.fy, camera.cx, camera.cy),
                depth_unit_m,
            )
        )

    def splats(self, means_m: npt.NDArray[np.float32]) -> Splats:
        """The Gaussians as a renderer takes them, with their positions already computed."""
        return Splats(means_m=means_m, colors=self.colors, log_radii=self.log_radii, opacity_logits=self.opacity_logits)


def edge_mask(rgb: npt.NDArray[np.uint8], *, low: float, high: float) -> npt.NDArray[np.bool_]:
    """Edge pixels bool [H,W] of an image uint8 [H,W,3]: Canny with L2 gradient, dilated by 3x3 once."""
    edges = cv2.Canny(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), low, high, apertureSize=3, L2gradient=True)
    return np.asarray(cv2.dilate(edges, np.ones((3, 3), np.uint8)) > 0)


def tied_to_frame(
    frame: Frame,
    mask: npt.NDArray[np.bool_],
    *,
    frame_index: int,
    depth_factor: float,
    opacity: float,
    radius_factor: float = 1.0,
    border_radius: float = 1.0,
    edges: npt.NDArray[np.bool_] | None = None,
    exposure: Exposure | None = None,
) -> ViewTiedGaussians:
    """New Gaussians at the pixels of ``mask`` that have depth (paper, section 3.2 and Eq. 3).

    Args:
        frame: The frame they are tied to.
        mask: bool [H,W], where Gaussians are wanted.
        frame_index: Row of the frame in the section's frame table.
        depth_factor: Factor on depth before placing them.
        opacity: Initial opacity, 0 to 1.
        radius_factor: Initial sigma over depth / focal length.
        border_radius: Further factor for the outermost pixels.
        edges: bool [H,W], where four half-size Gaussians are added to the pixel's own, or None.
        exposure: How the frame shows the map's colours; None for the identity.

    Returns:
        Colour as observed in the map's gauge, sigma = radius_factor * depth / focal length (Eq. 3), halved for the edge
        supplement.
    """
    rgb = (exposure or Exposure.identity()).removed(frame.rgb)
    pixels = np.flatnonzero(mask & (frame.depth > 0)).astype(np.int32)
    subpixel = np.zeros(pixels.size, np.uint8)
    if edges is not None:
        edge_pixels = np.flatnonzero(mask & edges & (frame.depth > 0)).astype(np.int32)
        subpixel = np.concatenate([subpixel, np.tile(np.arange(1, 5, dtype=np.uint8), edge_pixels.size)])
        pixels = np.concatenate([pixels, np.repeat(edge_pixels, 4)])
    logit = np.float32(np.log(opacity / (1.0 - opacity)))
    tied = ViewTiedGaussians(
        frame_index=np.full(pixels.size, frame_index, np.uint16),
        pixel=pixels,
        subpixel=subpixel,
        depth=frame.depth.reshape(-1)[pixels],
        colors=rgb.reshape(-1, 3)[pixels],
        log_radii=np.zeros(pixels.size, np.float32),
        opacity_logits=np.full(pixels.size, logit, np.float32),
    )
    unit_m = frame.depth_scale_m * depth_factor
    radii = first_log_radii(tied, frame.camera, depth_unit_m=unit_m, factor=radius_factor, border_factor=border_radius)
    return tied.with_attributes(colors=tied.colors, log_radii=radii, opacity_logits=tied.opacity_logits)


def first_log_radii(
    gaussians: ViewTiedGaussians, camera: Camera, *, depth_unit_m: float, factor: float, border_factor: float
) -> npt.NDArray[np.float32]:
    """Log radii float32 [N] before any learning: factor * depth / focal length (Eq. 3).

    Halved for the edge supplement, and times ``border_factor`` at the outermost pixels of the image.
    """
    column, row = gaussians.pixel % camera.width, gaussians.pixel // camera.width
    border = (column == 0) | (row == 0) | (column == camera.width - 1) | (row == camera.height - 1)
    sigma_m = gaussians.depth * (depth_unit_m * factor / camera.mean_focal_px) * np.where(border, border_factor, 1.0)
    return np.log(np.where(gaussians.subpixel > 0, 0.5 * sigma_m, sigma_m)).astype(np.float32)

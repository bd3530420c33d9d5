"""A frame's points in blocks of its image, and which blocks a view may have seen, told without its depth image.

Bounds only: a block that is ruled out holds no point that `seen_by_view` would find seen; what is left is looked at
point by point.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.overlap.coarse import BLOCK_PX, CoarseDepth

Array = npt.NDArray[np.float64]

_MAX_BLOCKS = 640  # of a frame: more of them bound better, and cost more
_NEAR_M = 1e-3  # what comes nearer to the image plane may be seen anywhere in the image
_SLACK = 1e-5  # of coordinates, relative: far more than rounding moves a point that was computed in float32

_WORLD_SLACK = 1e-9  # likewise of world coordinates, which are float64


@dataclass(frozen=True, slots=True, eq=False)
class PointBlocks:
    """Spheres about the points of a frame, block by block of its image; only blocks with points.

    Attributes:
        centers_m: float64 [B,3], world.
        radii_m: float64 [B].
        counts: int64 [B], points in each.
        rows: int64 [N], the points' places in the order of `world_points_m`, block by block.
    """

    centers_m: Array
    radii_m: Array
    counts: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]

    @classmethod
    def of(cls, frame: Frame, T_world_camera: Array) -> "PointBlocks":
        """The blocks of all pixels with depth, as seen from ``T_world_camera`` float64 [4,4]."""
        depth = frame.depth
        side = block_side_px(frame.camera.width, frame.camera.height)
        shape = tuple(-(-size // side) for size in depth.shape)
        v, u = np.nonzero(depth)
        block = (v // side) * shape[1] + u // side
        rows = np.argsort(block.astype(np.uint16), kind="stable")
        counts = np.bincount(block, minlength=shape[0] * shape[1])
        starts = np.cumsum(counts) - counts
        used = np.flatnonzero(counts)
        z = depth[v, u][rows] * frame.depth_scale_m
        z_range = [part.reduceat(z, starts[used]) if used.size else np.zeros(0) for part in (np.minimum, np.maximum)]
        corners = _corners(frame, used, shape[1], side, np.stack(z_range))
        centers = corners.mean(axis=0)
        radii = np.linalg.norm(corners - centers, axis=-1).max(axis=0, initial=0.0)
        radii = radii + _SLACK * (1.0 + np.abs(corners).max(axis=(0, 2), initial=0.0))
        world = centers @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        return cls(world, radii, counts[used], rows)

    @property
    def num_points(self) -> int:
        """Points of the frame, N."""
        return int(self.rows.size)

    def points_in(self, blocks: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Which points, in the order of ``rows``, are in the blocks bool [B]; bool [N]."""
        return np.repeat(blocks, self.counts)

    def bounding_sphere(self) -> tuple[Array, float]:
        """Center float64 [3] (m, world) and radius (m) of a sphere about all points; there must be one."""
        low = (self.centers_m - self.radii_m[:, None]).min(axis=0)
        high = (self.centers_m + self.radii_m[:, None]).max(axis=0)
        return 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))


def block_side_px(width: int, height: int) -> int:
    """Side of a frame's blocks."""
    side = BLOCK_PX
    while -(-width // side) * -(-height // side) > _MAX_BLOCKS:
        side += BLOCK_PX
    return side


def _corners(frame: Frame, used: npt.NDArray[np.intp], columns: int, side: int, z: Array) -> Array:
    """The 8 corners of what each used block can hold, float64 [8,B,3], camera frame; ``z`` is [2,B]."""
    camera = frame.camera
    first_v, first_u = (used // columns) * side, (used % columns) * side
    edges_u = (first_u + 0.5, np.minimum(first_u + side, camera.width) - 0.5)
    edges_v = (first_v + 0.5, np.minimum(first_v + side, camera.height) - 0.5)
    return np.stack(
        [
            np.stack([(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth], axis=-1)
            for u in edges_u
            for v in edges_v
            for depth in z
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class DepthPyramid:
    """Coarse depth of one view at all sizes down to one block, one after another.

    Attributes:
        nearest, farthest: uint16 [P].
    """

    nearest: npt.NDArray[np.uint16]
    farthest: npt.NDArray[np.uint16]

    @classmethod
    def of(cls, coarse: CoarseDepth) -> "DepthPyramid":
        """The pyramid of a view's coarse depth."""
        return cls(_levels(coarse.nearest, np.minimum), _levels(coarse.farthest, np.maximum))


def _levels(image: npt.NDArray[np.uint16], reduce: np.ufunc) -> npt.NDArray[np.uint16]:
    parts = [image.ravel()]
    while image.size > 1:
        rows, columns = (size + size % 2 for size in image.shape)
        padded = np.pad(image, ((0, rows - image.shape[0]), (0, columns - image.shape[1])), mode="edge")
        halved = padded.reshape(rows // 2, 2, columns // 2, 2)
        image = np.asarray(reduce.reduce(halved, axis=(1, 3)), np.uint16)
        parts.append(image.ravel())
    return np.concatenate(parts)


@dataclass(frozen=True, slots=True, eq=False)
class PyramidLayout:
    """Where the levels of a pyramid lie: first place, rows and columns, each int64 [L]."""

    starts: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]
    size: tuple[int, int]

    @classmethod
    def of(cls, width: int, height: int) -> "PyramidLayout":
        """The layout for images of ``width`` x ``height``."""
        rows, columns = -(-height // BLOCK_PX), -(-width // BLOCK_PX)
        shapes = [(rows, columns)]
        while shapes[-1] != (1, 1):
            shapes.append((-(-shapes[-1][0] // 2), -(-shapes[-1][1] // 2)))
        sizes = np.array([r * c for r, c in shapes], np.int64)
        return cls(np.cumsum(sizes) - sizes, np.array([c for _, c in shapes], np.int64), (rows, columns))


@dataclass(frozen=True, slots=True, eq=False)
class ViewBatch:
    """Views of one camera and depth scale.

    Attributes:
        T_world_view: float64 [V,4,4].
        camera: Their intrinsics.
        depth_scale_m: Metres per unit of depth.
        tolerance, border_px: As in `seen_by_view`.
    """

    T_world_view: Array
    camera: Camera
    depth_scale_m: float
    tolerance: float
    border_px: float

    def windows(self, blocks: PointBlocks) -> "Windows":
        """Where in the views' images, and how deep, the points of each block can be."""
        T, camera = self.T_world_view, self.camera
        x, y, z = _seen_from(blocks.centers_m, T)
        r = blocks.radii_m[None] + _WORLD_SLACK * (1.0 + np.abs(T[:, :3, 3]).max(axis=1))[:, None]
        z0, z1 = z - r, z + r
        near = np.maximum(z0, _NEAR_M)
        far = np.maximum(z1, _NEAR_M)
        u0, u1 = _span(x, r, near, far, camera.fx, camera.cx)
        v0, v1 = _span(y, r, near, far, camera.fy, camera.cy)
        crosses = z0 < _NEAR_M
        u0, v0 = np.where(crosses, 0.0, u0), np.where(crosses, 0.0, v0)
        u1, v1 = np.where(crosses, camera.width, u1), np.where(crosses, camera.height, v1)
        border = self.border_px
        inside = (z1 > 0.0) & (u1 >= border) & (v1 >= border)
        inside &= (u0 <= camera.width - border) & (v0 <= camera.height - border)
        limit = 1.0 + self.tolerance
        return Windows(inside=inside, u=(u0, u1), v=(v0, v1), least_m=np.maximum(z0, 0.0) / limit, most_m=z1 * limit)

    def possible(
        self, windows: "Windows", nearest: npt.NDArray[np.uint16], farthest: npt.NDArray[np.uint16]
    ) -> npt.NDArray[np.bool_]:
        """Which blocks the views may have seen, bool [V,B], by their pyramids uint16 [V,P]."""
        layout = PyramidLayout.of(self.camera.width, self.camera.height)
        places = _places(windows, layout)
        view = np.arange(nearest.shape[0])[:, None]
        low = np.minimum.reduce([nearest[view, place] for place in places])
        high = np.maximum.reduce([farthest[view, place] for place in places])
        fits = self._most_m(high) >= windows.least_m
        fits &= low * (self.depth_scale_m * (1.0 - _SLACK)) <= windows.most_m
        return np.asarray(windows.inside & fits)

    def within_reach(self, windows: "Windows", farthest: npt.NDArray[np.uint16]) -> npt.NDArray[np.bool_]:
        """Which blocks, bool [V,B], are in the images and no deeper than the largest raw depths uint16 [V]."""
        return np.asarray(windows.inside & (self._most_m(farthest)[:, None] >= windows.least_m))

    def _most_m(self, farthest: npt.NDArray[np.uint16]) -> Array:
        return np.asarray(farthest * (self.depth_scale_m * (1.0 + _SLACK)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Windows:
    """Bounds for each of V views and B blocks.

    Attributes:
        inside: bool [V,B]; False where no point is in the image.
        u, v: Least and largest image coordinates, float64 [V,B] each.
        least_m, most_m: Depths that a measurement must lie between to agree with a point, float64 [V,B].
    """

    inside: npt.NDArray[np.bool_]
    u: tuple[Array, Array]
    v: tuple[Array, Array]
    least_m: Array
    most_m: Array

    def of_views(self, views: npt.NDArray[np.bool_]) -> "Windows":
        """Those of some of the views."""
        return Windows(
            inside=self.inside[views],
            u=(self.u[0][views], self.u[1][views]),
            v=(self.v[0][views], self.v[1][views]),
            least_m=self.least_m[views],
            most_m=self.most_m[views],
        )


def _seen_from(points_m: Array, T_world_view: Array) -> Array:
    """Points [B,3] in the coordinates of views [V,4,4], float64 [3,V,B]."""
    middle = points_m.mean(axis=0)  # near the points: a map far from its origin loses no digits
    rotations = T_world_view[:, :3, :3]
    local = rotations.transpose(2, 0, 1).reshape(-1, 3) @ (points_m - middle).T
    offsets = np.einsum("vj,vji->iv", middle - T_world_view[:, :3, 3], rotations)
    return np.asarray(local.reshape(3, len(rotations), -1) + offsets[:, :, None])


def _span(a: Array, r: Array, near: Array, far: Array, focal: float, middle: float) -> tuple[Array, Array]:
    """Least and largest image coordinate of spheres with coordinate ``a`` and radius ``r`` between two depths."""
    low, high = a - r, a + r
    first = focal * np.minimum(low / near, low / far) + middle
    last = focal * np.maximum(high / near, high / far) + middle
    return first - 0.01, last + 0.01


def _places(windows: Windows, layout: PyramidLayout) -> list[npt.NDArray[np.int64]]:
    """Places in the pyramid of the at most 2 x 2 blocks, of some level, that cover a window."""
    rows, columns = layout.size
    u0, u1 = (np.clip(u // BLOCK_PX, 0, columns - 1).astype(np.int64) for u in windows.u)
    v0, v1 = (np.clip(v // BLOCK_PX, 0, rows - 1).astype(np.int64) for v in windows.v)
    span = np.maximum(u1 - u0, v1 - v0)
    level = np.ceil(np.log2(np.maximum(span, 1))).astype(np.int64)
    level = np.minimum(level, layout.starts.size - 1)
    start, width = layout.starts[level], layout.columns[level]
    return [start + (v >> level) * width + (u >> level) for v in (v0, v1) for u in (u0, u1)]

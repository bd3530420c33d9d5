"""The candidate views of a map of any length: little is kept of each, its depth is read when it is needed."""

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.overlap.blocks import DepthPyramid, ViewBatch
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.selection import CandidateView
from vtslam.common.overlap.view_grid import BallGrid
from vtslam.common.settings import OverlapSettings

Array = npt.NDArray[np.float64]

_PYRAMIDS_KEPT = 1024
_FIRST_ROOM = 64
_ROW = np.dtype(
    [
        ("section_id", np.int64),
        ("section_row", np.int64),
        ("frame_id", np.int64),
        ("is_head", np.bool_),
        ("T_world_view", np.float64, (4, 4)),
        ("farthest", np.uint16),
        ("camera", np.int32),
        ("center_m", np.float64, 3),
        ("radius_m", np.float64),
    ]
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewFacts:
    """A candidate view without its depth image.

    Attributes:
        section_id, section_row, frame_id: Which frame; row 0 is its section's head.
        T_world_camera: float64 [4,4].
        farthest: Largest raw depth in its image.
        depth_scale_m, camera: Of its section.
    """

    section_id: int
    section_row: int
    frame_id: int
    T_world_camera: Array
    farthest: int
    depth_scale_m: float
    camera: Camera


class ReadsViewDepth(Protocol):
    """Where the depth of candidate views comes from."""

    def view_depth(self, section_id: int, section_row: int) -> npt.NDArray[np.uint16]:
        """What a view measured, uint16 [H,W]."""
        ...

    def coarse_depth(self, section_id: int, section_row: int, frame_id: int) -> CoarseDepth | None:
        """Its bounds by block if they are at hand; None means that they are to be made from the depth."""
        ...


class ViewIndex:
    """Candidate views in order of time.

    Args:
        depths: Where their depth comes from.
    """

    def __init__(self, depths: ReadsViewDepth) -> None:
        self._depths = depths
        self._rows = np.zeros(_FIRST_ROOM, _ROW)
        self._count = 0
        self._cameras: list[tuple[Camera, float]] = []
        self._heads: dict[int, bool] = {}  # by section with views: whether its head's is one of them
        self._grid = BallGrid()
        self._pyramids: OrderedDict[int, DepthPyramid] = OrderedDict()

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> npt.NDArray[np.void]:
        """The views as records [V]."""
        return self._rows[: self._count]

    def add(self, view: ViewFacts) -> None:
        """Add a view, later than those before it."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        key = (view.camera, view.depth_scale_m)
        if key not in self._cameras:
            self._cameras.append(key)
        self._heads[view.section_id] = self._heads.get(view.section_id, False) or view.section_row == 0
        center, radius = _ball(view)
        self._rows[self._count] = (
            view.section_id,
            view.section_row,
            view.frame_id,
            view.section_row == 0,
            view.T_world_camera,
            view.farthest,
            self._cameras.index(key),
            center,
            radius,
        )
        self._grid.add(self._count, center, radius)
        self._count += 1

    @property
    def num_sections(self) -> int:
        """Sections with views."""
        return len(self._heads)

    def has_head(self, section_id: int | None) -> bool | None:
        """Whether the head's view of a section is one of them; None if no view of the section is."""
        return None if section_id is None else self._heads.get(section_id)

    def batches(
        self, numbers: npt.NDArray[np.int64], settings: OverlapSettings
    ) -> list[tuple[npt.NDArray[np.int64], ViewBatch]]:
        """Views by number, together with those of the same camera."""
        cameras, out = self._rows["camera"][numbers], []
        for index in np.unique(cameras):
            (camera, scale), own = self._cameras[index], numbers[cameras == index]
            batch = ViewBatch(
                T_world_view=self._rows["T_world_view"][own],
                camera=camera,
                depth_scale_m=scale,
                tolerance=settings.depth_consistency,
                border_px=settings.border_share * camera.width,
            )
            out.append((own, batch))
        return out

    def near(self, center_m: Array, radius_m: float, tolerance: float) -> npt.NDArray[np.int64]:
        """Numbers, in order, of views that may see something of a ball, at a relative tolerance of depth."""
        # Depth that is this much larger moves the ball's center by at most as much as it widens the ball.
        stretch = 1.0 + 2.0 * tolerance
        numbers = self._grid.near(center_m, radius_m, stretch=stretch)
        distances = np.linalg.norm(self._rows["center_m"][numbers] - center_m, axis=1)
        return np.asarray(numbers[distances <= stretch * self._rows["radius_m"][numbers] + radius_m])

    def pyramid(self, number: int) -> DepthPyramid:
        """A view's coarse depth."""
        if number not in self._pyramids:
            row = self._rows[number]
            section_id, section_row = int(row["section_id"]), int(row["section_row"])
            coarse = self._depths.coarse_depth(section_id, section_row, int(row["frame_id"]))
            coarse = coarse or CoarseDepth.of(self._depths.view_depth(section_id, section_row))
            self._pyramids[number] = DepthPyramid.of(coarse)
            if len(self._pyramids) > _PYRAMIDS_KEPT:
                self._pyramids.popitem(last=False)
        self._pyramids.move_to_end(number)
        return self._pyramids[number]

    def view(self, number: int) -> CandidateView:
        """A view with its depth."""
        row = self._rows[number]
        section_id, section_row = int(row["section_id"]), int(row["section_row"])
        camera, scale = self._cameras[row["camera"]]
        return CandidateView(
            section_id=section_id,
            frame_id=int(row["frame_id"]),
            is_head=bool(row["is_head"]),
            T_world_camera=row["T_world_view"].copy(),
            depth=self._depths.view_depth(section_id, section_row),
            depth_scale_m=scale,
            camera=camera,
        )


def _ball(view: ViewFacts) -> tuple[Array, float]:
    """A ball about all that a view can see: center float64 [3] (m, world) and radius (m)."""
    camera = view.camera
    reach = max(view.farthest * view.depth_scale_m, 1e-3)
    slope_x = max(abs(camera.cx), abs(camera.width - camera.cx)) / camera.fx
    slope_y = max(abs(camera.cy), abs(camera.height - camera.cy)) / camera.fy
    half_width = math.hypot(slope_x, slope_y) * reach
    # Through the corners of the far end and the camera, or about the far end if that is wide.
    ahead = min((reach * reach + half_width * half_width) / (2.0 * reach), reach)
    radius = max(ahead, math.hypot(reach - ahead, half_width))
    center = view.T_world_camera[:3, :3] @ np.array([0.0, 0.0, ahead]) + view.T_world_camera[:3, 3]
    return center, radius * 1.000001

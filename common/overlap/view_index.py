"""The candidate views of a map of any length, and which of them see what a frame sees.

What is kept of a view is small: pose, reach and where its depth is. Depth is read when it is needed. A frame's search
goes from the cheap to the exact: balls in a grid, what lies in the image and within reach, coarse depth, and at last
every point of what is left. Each step rules out only what the last one would find unseen, so the choice is that of an
exhaustive search (`vtslam.common.overlap.selection`).
"""

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.overlap.blocks import DepthPyramid, PointBlocks, ViewBatch
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.selection import CandidateView, seen_by_view, world_points_m
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

    def search(
        self, frame: Frame, T_world_camera: Array, settings: OverlapSettings, *, only_head_of: int | None = None
    ) -> "OverlapSearch":
        """Look for views that see the points of ``frame`` at ``T_world_camera`` float64 [4,4].

        Args:
            frame: The frame.
            T_world_camera: Its pose.
            settings: Tolerance and border.
            only_head_of: A section of which only the head's view counts; None if all do.
        """
        return OverlapSearch(self, frame, T_world_camera, settings, only_head_of)

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


class OverlapSearch:
    """One frame's question; shares are worked out as far as the answers need them.

    Args:
        index: The views.
        frame, T_world_camera, settings, only_head_of: See `ViewIndex.search`.
    """

    def __init__(
        self,
        index: ViewIndex,
        frame: Frame,
        T_world_camera: Array,
        settings: OverlapSettings,
        only_head_of: int | None,
    ) -> None:
        self._index, self._frame, self._T_world_camera, self._settings = index, frame, T_world_camera, settings
        self._only_head_of = only_head_of
        self._blocks = PointBlocks.of(frame, T_world_camera)
        self._points_m: Array | None = None
        self._shares: dict[int, float] = {}
        # By number of the view, in order; all others see nothing.
        self._possible: dict[int, npt.NDArray[np.bool_]] = {}
        self._bounds: dict[int, float] = {}
        if self._blocks.num_points:
            self._bound()

    @property
    def num_exact(self) -> int:
        """Views that were looked at point by point so far."""
        return len(self._shares)

    def shares(self) -> dict[int, float]:
        """Share of the frame's points that each view saw, by number of the view; those that saw none are left out."""
        return {number: share for number in self._bounds if (share := self._share(number)) > 0.0}

    def sections_to_pretrack(self, *, head_section_id: int) -> list[int]:
        """As `vtslam.common.overlap.selection.sections_to_pretrack` over all views that count."""
        settings, section_ids = self._settings, self._section_ids()
        if section_ids is None:
            return []
        num_sections, last = section_ids
        wanted = settings.max_sections if head_section_id > 2 else 1
        wanted_now = min(wanted, num_sections)
        gamma = settings.gamma
        while True:
            passing = self._passing(gamma, wanted)
            if len(passing) >= wanted_now or gamma * settings.gamma_decay < settings.gamma_floor:
                break
            gamma *= settings.gamma_decay
        return passing or [last]

    def largest_overlap(self, *, excluded_section_id: int) -> int | None:
        """As `vtslam.common.overlap.selection.largest_overlap` over all views that count."""
        sections = self._index.rows["section_id"]
        allowed = [number for number in self._bounds if sections[number] != excluded_section_id]
        best: tuple[float, int] | None = None
        for number in sorted(allowed, key=lambda n: (-self._bounds[n], n)):
            if best is not None and self._bounds[number] < -best[0]:
                break
            share = self._share(number)
            if share > 0.0:
                best = min(best or (0.0, number), (-share, number))
        return None if best is None else int(sections[best[1]])

    def _section_ids(self) -> tuple[int, int] | None:
        """How many sections have views that count, and the last one; None if none has."""
        hidden = self._only_head_of if self._index.has_head(self._only_head_of) is False else None
        of_views = self._index.rows["section_id"]
        num_sections = self._index.num_sections - (hidden is not None)
        if not num_sections:
            return None
        last = int(of_views[-1])
        return num_sections, last if last != hidden else int(of_views[of_views < last][-1])

    def _passing(self, gamma: float, wanted: int) -> list[int]:
        """The first sections with a view that sees more than ``gamma``, at most ``wanted`` of them."""
        by_section: OrderedDict[int, list[int]] = OrderedDict()
        for number, bound in self._bounds.items():
            if bound > gamma:
                by_section.setdefault(int(self._index.rows["section_id"][number]), []).append(number)
        passing: list[int] = []
        for section_id, numbers in by_section.items():
            numbers.sort(key=lambda n: -self._bounds[n])
            if any(self._share(number) > gamma for number in numbers):
                passing.append(section_id)
                if len(passing) == wanted:
                    break
        return passing

    def _bound(self) -> None:
        """Largest possible shares, from coarse depth."""
        index, blocks = self._index, self._blocks
        center, radius = blocks.bounding_sphere()
        numbers = self._counting(index.near(center, radius, self._settings.depth_consistency))
        found: dict[int, npt.NDArray[np.bool_]] = {}
        for own, batch in index.batches(numbers, self._settings):
            windows = batch.windows(blocks)
            reached = np.asarray(batch.within_reach(windows, index.rows["farthest"][own]).any(axis=1))
            pyramids = [index.pyramid(int(number)) for number in own[reached]]
            if pyramids:
                nearest = np.stack([pyramid.nearest for pyramid in pyramids])
                farthest = np.stack([pyramid.farthest for pyramid in pyramids])
                possible = batch.possible(windows.of_views(reached), nearest, farthest)
                found.update(zip(own[reached].tolist(), possible, strict=True))
        for number in sorted(found):
            count = int(blocks.counts[found[number]].sum())
            if count:
                self._possible[number] = found[number]
                self._bounds[number] = count / blocks.num_points

    def _counting(self, numbers: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        if self._only_head_of is None:
            return numbers
        rows = self._index.rows[numbers]
        return np.asarray(numbers[(rows["section_id"] != self._only_head_of) | rows["is_head"]])

    def _share(self, number: int) -> float:
        """Share of the frame's points that a view saw, as `overlap_shares` has it."""
        if number not in self._shares:
            view = self._index.view(number)
            seen = seen_by_view(
                self._points()[self._blocks.rows_in(self._possible[number])],
                T_world_view=view.T_world_camera,
                view_depth=view.depth,
                depth_scale_m=view.depth_scale_m,
                camera=view.camera,
                tolerance=self._settings.depth_consistency,
                border_px=self._settings.border_share * view.camera.width,
            )
            self._shares[number] = int(np.count_nonzero(seen)) / self._blocks.num_points
        return self._shares[number]

    def _points(self) -> Array:
        if self._points_m is None:
            self._points_m = world_points_m(self._frame, self._T_world_camera, self._frame.depth > 0)
        return self._points_m


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

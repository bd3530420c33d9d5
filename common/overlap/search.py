"""Which candidate views see what a frame sees: the choices of an exhaustive search, at a cost that does not grow.

From the cheap to the exact: balls in a grid, what lies in the image and within reach, coarse depth, and at last the
points of what is left. Each step rules out only what the last one would find unseen, so the choices are those of
`vtslam.common.overlap.selection` over all views.
"""

from collections import OrderedDict
from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.overlap.blocks import PointBlocks
from vtslam.common.overlap.selection import CandidateView, seen_columns, world_points_m
from vtslam.common.overlap.view_index import ViewIndex
from vtslam.common.settings import OverlapSettings

Array = npt.NDArray[np.float64]

_POINTS_AT_ONCE = 4096  # few enough for the processor's cache, and for an answer before all were looked at


class OverlapSearch:
    """Which views see the points of a frame; worked out as far as the answers need it.

    Args:
        index: The views; there must be no new ones meanwhile.
        frame: The frame.
        T_world_camera: Its pose float64 [4,4].
        settings: Tolerance, border and thresholds.
        only_head_of: A section of which only the head's view counts; None if all do.
    """

    def __init__(
        self,
        index: ViewIndex,
        frame: Frame,
        T_world_camera: Array,
        settings: OverlapSettings,
        *,
        only_head_of: int | None = None,
    ) -> None:
        self._index, self._frame, self._T_world_camera, self._settings = index, frame, T_world_camera, settings
        self._only_head_of = only_head_of
        self._blocks = PointBlocks.of(frame, T_world_camera)
        self._points_m: Array | None = None
        self._looks: dict[int, _Look] = {}
        # By number of the view, in order; all others see nothing.
        self._possible: dict[int, npt.NDArray[np.bool_]] = {}
        self._bounds: dict[int, float] = {}
        if self._blocks.num_points:
            self._bound()

    @property
    def num_exact(self) -> int:
        """Views that were looked at point by point so far."""
        return len(self._looks)

    def shares(self) -> dict[int, float]:
        """Share of the frame's points that each view saw, by number of the view; those that saw none are left out."""
        found = {number: self._look(number, lambda low, high: True)[0] for number in self._bounds}
        return {number: share for number, share in found.items() if share > 0.0}

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
        best_share, best = 0.0, -1
        for number in sorted(allowed, key=lambda n: (-self._bounds[n], n)):
            if self._bounds[number] < best_share:
                break
            share, most = self._look(number, partial(_may_reach, best_share))
            if share == most and (share > best_share or (share == best_share > 0.0 and number < best)):
                best_share, best = share, number
        return None if best < 0 else int(sections[best])

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
            if any(self._sees_more(number, gamma) for number in numbers):
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

    def _sees_more(self, number: int, share: float) -> bool:
        """Whether a view sees more than a share of the points; looks at no more of them than that takes."""
        return self._look(number, lambda low, high: low <= share < high)[0] > share

    def _look(self, number: int, is_open: Callable[[float, float], bool]) -> tuple[float, float]:
        """Look on at what a view saw while that leaves a question open.

        Args:
            number: The view.
            is_open: Asked with the least and largest share it can have come to.

        Returns:
            Both shares; they are equal if all points were looked at.
        """
        if number not in self._looks:
            self._looks[number] = self._new_look(number)
        look, total = self._looks[number], self._blocks.num_points
        while True:
            low, high = look.seen / total, (look.seen + look.points_left) / total
            if not look.points_left or not is_open(low, high):
                return low, high
            look.advance()

    def _new_look(self, number: int) -> "_Look":
        view, settings = self._index.view(number), self._settings
        rows = np.flatnonzero(self._blocks.points_in(self._possible[number])).astype(np.int32)
        border_px = settings.border_share * view.camera.width
        return _Look(view, self._points(), rows, settings.depth_consistency, border_px)

    def _points(self) -> Array:
        """The frame's points float64 [3,N], block by block."""
        if self._points_m is None:
            points = world_points_m(self._frame, self._T_world_camera, self._frame.depth > 0)
            self._points_m = np.ascontiguousarray(points[self._blocks.rows].T)
        return self._points_m


def _may_reach(share: float, low: float, high: float) -> bool:
    return high >= share


class _Look:
    """What a view saw of the points that it may have seen, part by part.

    Args:
        view: The view.
        points_m: The frame's points float64 [3,N], world.
        rows: int32 [M], which of them it may have seen.
        tolerance, border_px: As in `seen_by_view`.

    Attributes:
        seen: Points seen so far.
        points_left: Points that were not looked at.
    """

    def __init__(
        self, view: CandidateView, points_m: Array, rows: npt.NDArray[np.int32], tolerance: float, border_px: float
    ) -> None:
        self._view, self._points_m, self._rows = view, points_m, rows
        self._tolerance, self._border_px = tolerance, border_px
        self._image = view.depth.astype(np.float32)
        self._parts = max(rows.size // _POINTS_AT_ONCE, 1)
        self._part = self.seen = 0
        self.points_left = rows.size

    def advance(self) -> None:
        """Look at one more part: points from all over the image."""
        points = self._points_m[:, self._rows[self._part :: self._parts]]
        view = self._view
        seen = seen_columns(
            points,
            view.T_world_camera,
            self._image,
            view.depth_scale_m,
            view.camera,
            self._tolerance,
            self._border_px,
        )
        self._part += 1
        self.seen += int(np.count_nonzero(seen))
        self.points_left -= points.shape[1]

"""What choosing overlapping sections costs on a long road: candidate views along it, their depth on disk."""

import math
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.search import OverlapSearch
from vtslam.common.overlap.view_index import ViewFacts, ViewIndex
from vtslam.common.settings import TrackerSettings
from vtslam.storage.section_file import read_columns, write_columns

_SPACING_M = 4.0  # from view to view
_VIEWS_OF_SECTION = 8
_SECTIONS = 12  # after so many the road repeats itself
_PERIOD = _SECTIONS * _VIEWS_OF_SECTION
_RANGE_M, _DEPTH_SCALE_M = 80.0, 1.0 / 256.0
_CAMERA_HEIGHT_M, _HALF_WIDTH_M, _DEPTH_OF_FACADES_M = 1.65, 7.0, 6.0
HEADS = 40


class _Road:
    """A straight street along z between rows of houses that stand forward or back; it repeats itself."""

    def __init__(self, camera: Camera, seed: int) -> None:
        self.camera = camera
        self._set_back_m = np.random.default_rng(seed).uniform(0.0, _DEPTH_OF_FACADES_M, (2, _PERIOD))
        self._rays = camera.pixel_rays().reshape(-1, 3).astype(np.float64)

    def depth(self, place_m: float) -> npt.NDArray[np.uint16]:
        """What a camera at z = ``place_m`` that looks along the street measures."""
        x, y, _ = self._rays.T
        z = np.where(y > 0, _CAMERA_HEIGHT_M / np.maximum(y, 1e-9), np.inf)
        first = math.floor(place_m / _SPACING_M)
        for house in range(first, first + math.ceil(_RANGE_M / _SPACING_M) + 1):
            begin, end = house * _SPACING_M - place_m, (house + 1) * _SPACING_M - place_m
            for side, set_back in zip((-1.0, 1.0), self._set_back_m[:, house % _PERIOD], strict=True):
                wall = _HALF_WIDTH_M + set_back
                along = np.where(side * x > 0, wall / np.maximum(side * x, 1e-9), np.inf)
                z = np.minimum(z, np.where((along >= begin) & (along < end), along, np.inf))
                front = begin > 0.1 and set_back < self._set_back_m[int(side > 0), (house - 1) % _PERIOD]
                if front:  # the wall that shows where this house stands before the last one
                    z = np.minimum(z, np.where(side * x * begin >= wall, begin, np.inf))
        raw = np.where(z < _RANGE_M, z / _DEPTH_SCALE_M, 0.0)
        return np.rint(raw).astype(np.uint16).reshape(self.camera.height, self.camera.width)


class _DepthFiles:
    """Depth of one stretch of road in section files, and its coarse depth; others are like it."""

    def __init__(self, folder: Path, road: _Road) -> None:
        self._folder = folder
        self._at_hand: tuple[int, npt.NDArray[np.uint16]] | None = None  # of one section, as a small cache
        self.farthest: list[int] = []
        self._coarse: list[CoarseDepth] = []
        for section in range(_SECTIONS):
            places = [(section * _VIEWS_OF_SECTION + row) * _SPACING_M for row in range(_VIEWS_OF_SECTION)]
            depth = np.stack([road.depth(place) for place in places])
            self.farthest += [int(image.max()) for image in depth]
            self._coarse += [CoarseDepth.of(image) for image in depth]
            write_columns(self._path(section), {}, {"view_depth": depth})

    def view_depth(self, section_id: int, section_row: int) -> npt.NDArray[np.uint16]:
        if self._at_hand is None or self._at_hand[0] != section_id:
            _, columns = read_columns(self._path(section_id % _SECTIONS), ["view_depth"])
            self._at_hand = section_id, columns["view_depth"]
        return np.asarray(self._at_hand[1][section_row])

    def coarse_depth(self, section_id: int, section_row: int, frame_id: int) -> CoarseDepth | None:
        return self._coarse[frame_id % _PERIOD]

    def _path(self, section: int) -> Path:
        return self._folder / f"{section:06d}.vts"


def bench_overlap(
    size: tuple[int, int], *, views: int, tracker: TrackerSettings, on_step: Callable[[], None] = lambda: None
) -> dict[str, Any]:
    """Milliseconds of a head's choices among ``views`` candidate views, and among a tenth of them.

    Every other head is where the road was driven before, the others are at its end.

    Args:
        size: Width and height of frames and views.
        views: Candidate views along the road.
        tracker: Settings of the choices.
        on_step: Called for each head.
    """
    width, height = size
    camera = Camera(width=width, height=height, fx=0.58 * width, fy=0.58 * width, cx=0.49 * width, cy=0.46 * height)
    road = _Road(camera, seed=5)
    with TemporaryDirectory(prefix="vtslam-overlap-") as folder:
        depths = _DepthFiles(Path(folder), road)
        few, (many, num_bytes) = _index(depths, camera, views // 10), _measured_index(depths, camera, views)
        timers = [_Choices(few, tracker), _Choices(many, tracker)]
        for query in range(HEADS):
            for timer in timers:  # in turns: machines drift
                timer.choose(road, query)
            on_step()
    tenth, whole = timers
    return {
        "views": views,
        "width": width,
        "height": height,
        "select_ms": round(_median(whole.select_ms), 3),
        "select_p95_ms": round(float(np.percentile(whole.select_ms, 95)), 3),
        "neighbour_ms": round(_median(whole.neighbour_ms), 3),
        "select_ms_tenth": round(_median(tenth.select_ms), 3),
        "neighbour_ms_tenth": round(_median(tenth.neighbour_ms), 3),
        "growth": round(_median(whole.select_ms) / _median(tenth.select_ms), 4),
        "views_looked_at": round(float(np.mean(whole.looked_at)), 2),
        "bytes_per_view": round(num_bytes / views, 1),
    }


class _Choices:
    """What the choices among the views of one index take."""

    def __init__(self, index: ViewIndex, tracker: TrackerSettings) -> None:
        self._index, self._settings = index, tracker.overlap
        self._of_neighbours = replace(tracker.overlap, depth_consistency=tracker.visibility_tolerance)
        self.select_ms: list[float] = []
        self.neighbour_ms: list[float] = []
        self.looked_at: list[int] = []

    def choose(self, road: _Road, query: int) -> None:
        """What tracker and mapper do with a head."""
        count = len(self._index)
        number = count - 1 if query % 2 else (query + 1) * count // (HEADS + 1)
        frame, T, head_section_id = _head(road, number, query), _pose(number, query), number // _VIEWS_OF_SECTION + 1
        start_s = time.perf_counter()
        search = OverlapSearch(self._index, frame, T, self._settings)
        search.sections_to_pretrack(head_section_id=head_section_id)
        selected_s = time.perf_counter()
        OverlapSearch(self._index, frame, T, self._of_neighbours).largest_overlap(
            excluded_section_id=head_section_id - 1
        )
        self.select_ms.append(1e3 * (selected_s - start_s))
        self.neighbour_ms.append(1e3 * (time.perf_counter() - selected_s))
        self.looked_at.append(search.num_exact)


def _median(values: list[float]) -> float:
    return float(np.median(values))


def _pose(number: int, query: int) -> npt.NDArray[np.float64]:
    """Somewhere after the view ``number``, not quite in its direction."""
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.02 * math.sin(query), 0.0]))
    T[2, 3] = (number + 0.3 + 0.01 * query) * _SPACING_M
    return T


def _head(road: _Road, number: int, query: int) -> Frame:
    """What is measured there, its direction left out."""
    depth = road.depth(float(_pose(number, query)[2, 3]))
    rgb = np.zeros((*depth.shape, 3), np.uint8)
    return Frame(frame_id=0, capture_time_ns=0, rgb=rgb, depth=depth, depth_scale_m=_DEPTH_SCALE_M, camera=road.camera)


def _measured_index(depths: _DepthFiles, camera: Camera, count: int) -> tuple[ViewIndex, int]:
    """The index of a road, and the bytes of memory it takes."""
    tracemalloc.start()
    index = _index(depths, camera, count)
    num_bytes = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return index, num_bytes


def _index(depths: _DepthFiles, camera: Camera, count: int) -> ViewIndex:
    index = ViewIndex(depths)
    for number in range(count):
        T = np.eye(4)
        T[2, 3] = number * _SPACING_M
        section_id, row = divmod(number, _VIEWS_OF_SECTION)
        index.add(
            ViewFacts(
                section_id=section_id,
                section_row=row,
                frame_id=number,
                T_world_camera=T,
                farthest=depths.farthest[number % _PERIOD],
                depth_scale_m=_DEPTH_SCALE_M,
                camera=camera,
            )
        )
    return index

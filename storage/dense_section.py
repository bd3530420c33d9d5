"""The dense form of a section's Gaussians and depth images (docs/format-section.md, 6).

Attributes are rounded to grids, relative to what depth and camera already say, and the grid levels are coded behind
predictions from neighbouring Gaussians. Ties, depths, poses and candidate views are kept exactly.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.storage import _coder
from vtslam.storage.section_record import SectionRecord, check_header_types

AnyArray = npt.NDArray[Any]
Ints = np.ndarray[tuple[Any, ...], np.dtype[np.int32]]

GAUSSIAN_COLUMNS = ("frame_index", "pixel", "subpixel", "depth", "color", "log_radius", "opacity_logit", "view_depth")
DENSE_COLUMNS: dict[str, tuple[str, int]] = {  # type and axes
    "gaussian_counts": ("uint32", 2),
    "depth_values": ("uint16", 1),
    "gaussian_stream": ("uint8", 1),
    "view_stream": ("uint8", 1),
}
# A bit costs a stream at least 1/700 bit, a Gaussian has at least 8 of them, a pixel of a view one.
_MOST_GAUSSIANS_PER_BYTE, _MOST_PIXELS_PER_BYTE, _STREAM_END = 1024, 8192, 16
_LARGEST_LEVEL = 2**19
_LARGEST_SIDE_PX = 65535
_LARGEST_LOGIT = 16.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseGrid:
    """Distances between the values that attributes are rounded to, and where the grids lie.

    Attributes:
        opacity: Of the angle 2 atan(exp(logit / 2)), which is 0 to pi for opacities 0 to 1; radians.
        radius: Of log radii.
        luma: Of (red + 2 green + blue) / 4.
        chroma: Of red - blue, and of green - (red + blue) / 2.
        faint: Below this opacity angle the other steps are doubled ...
        fainter: ... and below this one doubled again: such Gaussians show less.
        opacity_zero: The angle at level 0.
        radius_zero: Log radius minus log(depth / focal length, of a quarter half of it) at level 0.
    """

    opacity: float = 0.4
    radius: float = 0.056
    luma: float = 0.008
    chroma: float = 0.016
    faint: float = 1.6
    fainter: float = 0.9
    opacity_zero: float = 0.0
    radius_zero: float = 0.0

    def coarser(self, factor: float) -> "DenseGrid":
        """The same with all steps ``factor`` times as long."""
        steps = {name: factor * getattr(self, name) for name in ("opacity", "radius", "luma", "chroma")}
        return replace(self, **steps)

    def as_dict(self) -> dict[str, float]:
        """Plain values by name."""
        return {field.name: float(getattr(self, field.name)) for field in fields(self)}

    @property
    def scales(self) -> tuple[int, int]:
        """The opacity levels of ``faint`` and ``fainter``."""
        faint, fainter = (
            int(np.ceil((angle - self.opacity_zero) / self.opacity)) for angle in (self.faint, self.fainter)
        )
        return faint, fainter

    @classmethod
    def from_dict(cls, values: object) -> "DenseGrid":
        """The grid of a file's header; ValueError if it is none."""
        names = [field.name for field in fields(cls)]
        if not isinstance(values, dict) or sorted(values) != sorted(names):
            raise ValueError(f"grid: expected {sorted(names)}, found {values!r:.120}")
        if not all(type(value) is float and abs(value) < 1e3 for value in values.values()):
            raise ValueError(f"grid: expected numbers within 1000, found {values!r:.200}")
        if min(values[name] for name in names[:4]) < 1e-4:
            raise ValueError(f"grid: expected steps of at least 0.0001, found {values!r:.200}")
        return cls(**values)


def dense_columns(record: SectionRecord, grid: DenseGrid) -> tuple[dict[str, float], dict[str, AnyArray]]:
    """The grid used, and the columns that replace ``GAUSSIAN_COLUMNS``.

    Gaussians are put in the order of frame, whole before quarter pixels, pixel, sub-pixel, which is the mapper's.

    Raises:
        ValueError: Two Gaussians share frame, pixel and sub-pixel, or those of one pixel differ in depth; an image
            side is over 65535 pixels; or an attribute is off every grid.
    """
    if max(record.camera.width, record.camera.height) > _LARGEST_SIDE_PX:
        raise ValueError(f"images of more than {_LARGEST_SIDE_PX} pixels a side have no dense form")
    order = np.lexsort((record.subpixel, record.pixel, record.subpixel > 0, record.frame_index))
    depth_values, ranks = np.unique(np.concatenate([record.view_depth.reshape(-1), record.depth]), return_inverse=True)
    if not depth_values.size or depth_values[0] != 0:  # so that rank 0 is "no depth", always
        depth_values, ranks = np.concatenate([np.zeros(1, np.uint16), depth_values]), ranks + 1
    view_ranks: Ints = ranks[: record.view_depth.size].reshape(record.view_depth.shape).astype(np.int32)
    gaussian_ranks: Ints = ranks[record.view_depth.size :].astype(np.int32)
    levels, grid = _levels(record, grid)
    counts = _counts(record)
    stream = _coder.encode_gaussians(
        (record.camera.height, record.camera.width),
        counts,
        _view_of(record.view_index, record.num_frames),
        view_ranks,
        depth_values.size - 1,
        grid.scales,
        record.pixel[order],
        record.subpixel[order],
        gaussian_ranks[order],
        levels[order],
    )
    return grid.as_dict(), {
        "gaussian_counts": counts,
        "depth_values": depth_values,
        "gaussian_stream": np.frombuffer(stream, np.uint8),
        "view_stream": np.frombuffer(_coder.encode_depth_images(view_ranks, depth_values.size - 1), np.uint8),
    }


def gaussian_columns(
    header: Mapping[str, Any], grid_values: object, columns: Mapping[str, AnyArray]
) -> dict[str, AnyArray]:
    """What :func:`dense_columns` replaced, attributes rounded; neither argument is trusted.

    Raises:
        ValueError: The columns are not such ones.
    """
    grid = DenseGrid.from_dict(grid_values)
    camera = _camera(header)
    counts, values, view_index = _checked(columns, camera)
    num_views, view_stream = view_index.size, columns["view_stream"]
    if num_views * camera.height * camera.width > _MOST_PIXELS_PER_BYTE * (view_stream.size + _STREAM_END):
        raise ValueError(f"view_stream: {view_stream.size} bytes cannot hold {num_views} images of the camera")
    shape = (num_views, camera.height, camera.width)
    view_ranks = _coder.decode_depth_images(view_stream.tobytes(), shape, values.size - 1).reshape(shape)
    pixel, subpixel, rank, levels = _coder.decode_gaussians(
        columns["gaussian_stream"].tobytes(),
        (camera.height, camera.width),
        counts,
        _view_of(view_index, counts.shape[0]),
        view_ranks,
        values.size - 1,
        grid.scales,
    )
    depth = values[rank]
    unit = header["depth_scale_m"] * header["depth_factor"]
    geometric = _geometric_log_radius(depth, subpixel, unit_m=unit, focal_px=camera.mean_focal_px)
    frames = np.repeat(np.arange(counts.shape[0], dtype=np.uint16), counts.sum(axis=1, dtype=np.int64))
    return {
        "frame_index": frames,
        "pixel": pixel,
        "subpixel": subpixel,
        "depth": depth,
        **_attributes(levels.reshape(-1, 5), geometric, grid),
        "view_depth": values[view_ranks],
    }


def _camera(header: Mapping[str, Any]) -> Camera:
    """The header's camera, and its depth units, as far as decoding needs them right."""
    check_header_types(header)
    camera = Camera(**header["camera"])
    unit = header["depth_scale_m"] * header["depth_factor"]
    if not (np.isfinite(unit) and unit > 0 and max(camera.width, camera.height) <= _LARGEST_SIDE_PX):
        raise ValueError("header: expected positive depth units, and images of at most 65535 pixels a side")
    return camera


def _checked(columns: Mapping[str, AnyArray], camera: Camera) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Counts [F,2], depth values [P] and view index [V], such that memory for them may be taken."""
    expected = {**DENSE_COLUMNS, "frame_ids": ("int64", 1), "view_index": ("uint16", 1)}
    for name, (dtype, axes) in expected.items():
        if name not in columns or columns[name].dtype != dtype or columns[name].ndim != axes:
            raise ValueError(f"{name}: expected {dtype} with {axes} axes")
    counts, values, view_index = columns["gaussian_counts"], columns["depth_values"], columns["view_index"]
    frames = columns["frame_ids"].size
    if counts.shape != (frames, 2):
        raise ValueError(f"gaussian_counts: expected {(frames, 2)}, found {counts.shape}")
    if not values.size or values[0] != 0 or (np.diff(values.astype(np.int64)) <= 0).any():
        raise ValueError("depth_values: expected 0 and then depths that increase")
    if view_index.size and view_index.max() >= frames:
        raise ValueError("view_index: expected rows of the frame table")
    per_frame = counts.astype(np.int64) - np.array([1, 4]) * (camera.width * camera.height)
    most = _MOST_GAUSSIANS_PER_BYTE * (columns["gaussian_stream"].size + _STREAM_END)
    if (per_frame > 0).any() or int(counts.sum(dtype=np.int64)) > most:
        raise ValueError("gaussian_counts: more Gaussians than pixels, or than the stream can hold")
    return counts, values, view_index


def _counts(record: SectionRecord) -> npt.NDArray[np.uint32]:
    """Whole and quarter Gaussians per frame, uint32 [F,2]."""
    kind = 2 * record.frame_index.astype(np.int64) + (record.subpixel > 0)
    return np.bincount(kind, minlength=2 * record.num_frames).astype(np.uint32).reshape(-1, 2)


def _view_of(view_index: AnyArray, frames: int) -> Ints:
    """The depth image of each frame, or -1, int32 [F]."""
    out = np.full(frames, -1, np.int32)
    out[view_index] = np.arange(view_index.size, dtype=np.int32)
    return out


def _geometric_log_radius(
    depth: AnyArray, subpixel: AnyArray, *, unit_m: float, focal_px: float
) -> npt.NDArray[np.float64]:
    """Log of a pixel's (a quarter's: half of it) width on the surface, m, float64 [N]."""
    width_m = depth * (unit_m / focal_px)
    return np.asarray(np.log(np.where(subpixel > 0, 0.5 * width_m, width_m)))


def _levels(record: SectionRecord, grid: DenseGrid) -> tuple[Ints, DenseGrid]:
    """Grid levels int32 [N,5] (opacity, radius, luma, two chroma), and the grid with its zeros set."""
    logits = np.clip(record.opacity_logit.astype(np.float64), -_LARGEST_LOGIT, _LARGEST_LOGIT)
    angle = 2.0 * np.arctan(np.exp(0.5 * logits))
    unit = record.depth_scale_m * record.depth_factor
    radius = record.log_radius - _geometric_log_radius(
        record.depth, record.subpixel, unit_m=unit, focal_px=record.camera.mean_focal_px
    )
    zeros = (float(np.median(angle)), float(np.median(radius))) if record.num_gaussians else (0.0, 0.0)
    grid = replace(grid, opacity_zero=zeros[0], radius_zero=zeros[1])
    red, green, blue = record.color.astype(np.float64).T
    scaled = np.stack(
        [
            (angle - grid.opacity_zero) / grid.opacity,
            (radius - grid.radius_zero) / grid.radius,
            (red + 2.0 * green + blue) / (4.0 * grid.luma),
            (red - blue) / grid.chroma,
            (green - 0.5 * (red + blue)) / grid.chroma,
        ],
        axis=1,
    )
    if scaled.size and not np.abs(scaled).max() < _LARGEST_LEVEL:
        raise ValueError("an attribute is too large for the dense form")
    return _rounded(scaled, grid), grid


def _rounded(scaled: npt.NDArray[np.float64], grid: DenseGrid) -> Ints:
    """Levels int32 [N,5], those but the opacity's on the coarser grids of Gaussians that show less."""
    faint, fainter = grid.scales
    opacity = np.rint(scaled[:, 0])
    scale = 1 << ((opacity < faint).astype(np.int64) + (opacity < fainter))
    levels: Ints = (np.rint(scaled / scale[:, None]) * scale[:, None]).astype(np.int32)
    levels[:, 0] = opacity
    return levels


def _attributes(levels: Ints, geometric: npt.NDArray[np.float64], grid: DenseGrid) -> dict[str, AnyArray]:
    """Attributes of grid levels."""
    angle = np.clip(levels[:, 0] * grid.opacity + grid.opacity_zero, 1e-3, np.pi - 1e-3)
    luma, first, second = levels[:, 2] * grid.luma, levels[:, 3] * grid.chroma, levels[:, 4] * grid.chroma
    red_and_blue = luma - 0.5 * second  # half their sum: luma = (r + b) / 4 + g / 2, g = (r + b) / 2 + second
    return {
        "opacity_logit": (2.0 * np.log(np.tan(0.5 * angle))).astype(np.float32),
        "log_radius": (geometric + grid.radius_zero + levels[:, 1] * grid.radius).astype(np.float32),
        "color": np.stack(
            [red_and_blue + 0.5 * first, red_and_blue + second, red_and_blue - 0.5 * first], axis=1
        ).astype(np.float32),
    }

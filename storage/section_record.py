"""A finished section as plain numpy arrays: what one section file holds, and the checks of its meaning."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera

_KIND = "section"
_MAX_FRAMES = 65536  # rows of the frame table are named by uint16
_CAMERA_TYPES = {"width": int, "height": int, "fx": float, "fy": float, "cx": float, "cy": float}
_HEADER_TYPES = {"kind": str, "section_id": int, "camera": dict, "depth_scale_m": float, "depth_factor": float}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionRecord:
    """A finished section of F frames, N Gaussians and V candidate views, with images of H x W.

    The position of a Gaussian follows from its pixel, its depth z = depth * depth_scale_m * depth_factor, the camera
    and the pose of its frame; it is not stored.

    Attributes:
        section_id: Place among the sections, from 0.
        camera: Intrinsics of all frames.
        depth_scale_m: Metres per unit of ``depth`` and ``view_depth``.
        depth_factor: Factor on the depth of Gaussians.
        T_world_section: float64 [4,4], the anchor.
        frame_ids: int64 [F], places in the stream, strictly increasing; F is 1 to 65536.
        capture_times_ns: int64 [F].
        T_section_frame: float64 [F,4,4], camera to section.
        exposure_gain: float32 [F,3], positive: a frame shows the map's colours as gain * colour + offset.
        exposure_offset: float32 [F,3].
        frame_index: uint16 [N], the row of the frame table that a Gaussian is tied to.
        pixel: int32 [N], v * W + u.
        subpixel: uint8 [N]; 0 for the whole pixel, 1 to 4 for its quarter cells (the edge supplement).
        depth: uint16 [N], at least 1.
        color: float32 [N,3].
        log_radius: float32 [N], natural logarithm of metres.
        opacity_logit: float32 [N].
        view_index: uint16 [V], rows of the frame table, strictly increasing.
        view_depth: uint16 [V,H,W], raw depth; 0 means none.

    Raises:
        ValueError: A type, shape or range differs from the above, a float is not finite, or a pose is not rigid.
    """

    section_id: int
    camera: Camera
    depth_scale_m: float
    depth_factor: float
    T_world_section: npt.NDArray[np.float64]
    frame_ids: npt.NDArray[np.int64]
    capture_times_ns: npt.NDArray[np.int64]
    T_section_frame: npt.NDArray[np.float64]
    exposure_gain: npt.NDArray[np.float32]
    exposure_offset: npt.NDArray[np.float32]
    frame_index: npt.NDArray[np.uint16]
    pixel: npt.NDArray[np.int32]
    subpixel: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.uint16]
    color: npt.NDArray[np.float32]
    log_radius: npt.NDArray[np.float32]
    opacity_logit: npt.NDArray[np.float32]
    view_index: npt.NDArray[np.uint16]
    view_depth: npt.NDArray[np.uint16]

    COLUMN_TYPES: ClassVar[dict[str, tuple[str, str]]] = {
        "T_world_section": ("float64", "4 4"),
        "frame_ids": ("int64", "F"),
        "capture_times_ns": ("int64", "F"),
        "T_section_frame": ("float64", "F 4 4"),
        "exposure_gain": ("float32", "F 3"),
        "exposure_offset": ("float32", "F 3"),
        "frame_index": ("uint16", "N"),
        "pixel": ("int32", "N"),
        "subpixel": ("uint8", "N"),
        "depth": ("uint16", "N"),
        "color": ("float32", "N 3"),
        "log_radius": ("float32", "N"),
        "opacity_logit": ("float32", "N"),
        "view_index": ("uint16", "V"),
        "view_depth": ("uint16", "V H W"),
    }

    def __post_init__(self) -> None:
        self._check_header()
        self._check_shapes()
        self._check_frames()
        self._check_gaussians()
        self._check_views()

    @property
    def num_frames(self) -> int:
        """Number of frames, F."""
        return int(self.frame_ids.shape[0])

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians, N."""
        return int(self.frame_index.shape[0])

    @property
    def num_views(self) -> int:
        """Number of candidate views, V."""
        return int(self.view_index.shape[0])

    def header(self) -> dict[str, Any]:
        """All that is not an array, as plain values."""
        camera = self.camera.as_dict()
        return {
            "kind": _KIND,
            "section_id": self.section_id,
            "camera": {key: kind(camera[key]) for key, kind in _CAMERA_TYPES.items()},
            "depth_scale_m": float(self.depth_scale_m),
            "depth_factor": float(self.depth_factor),
        }

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """All arrays by name; the record's own, not copies."""
        return {name: getattr(self, name) for name in self.COLUMN_TYPES}

    @classmethod
    def from_parts(cls, header: Mapping[str, Any], columns: Mapping[str, npt.NDArray[Any]]) -> "SectionRecord":
        """The record of a :meth:`header` and :meth:`columns`, which are not trusted.

        Raises:
            ValueError: A key or column is missing, unknown, or breaks a rule of the class.
        """
        check_header_types(header)
        if header["kind"] != _KIND:
            raise ValueError(f"kind: expected {_KIND!r}, found {header['kind']!r}")
        if set(columns) != set(cls.COLUMN_TYPES):
            raise ValueError(f"columns: expected {sorted(cls.COLUMN_TYPES)}, found {sorted(columns)}")
        return cls(
            section_id=header["section_id"],
            camera=Camera(**header["camera"]),
            depth_scale_m=header["depth_scale_m"],
            depth_factor=header["depth_factor"],
            **columns,
        )

    def _check_header(self) -> None:
        if type(self.section_id) is not int or self.section_id < 0:
            raise ValueError(f"section_id: expected an integer of 0 or more, found {self.section_id!r}")
        for name in ("depth_scale_m", "depth_factor"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}: expected a positive number, found {value!r}")
        if self.camera.width * self.camera.height > 2**31:
            size = f"{self.camera.width} x {self.camera.height}"
            raise ValueError(f"camera: expected at most 2^31 pixels, as int32 can name, found {size}")

    def _check_shapes(self) -> None:
        """Types and shapes by the table; a letter stands for one size throughout."""
        sizes = {"H": self.camera.height, "W": self.camera.width, "3": 3, "4": 4}
        for name, (dtype, letters) in self.COLUMN_TYPES.items():
            array = getattr(self, name)
            axes = letters.split()
            if array.ndim == len(axes):
                for axis, size in zip(axes, array.shape, strict=True):
                    sizes.setdefault(axis, size)
            expected = tuple(sizes.get(axis, axis) for axis in axes)
            if array.dtype != dtype or array.shape != expected:
                raise ValueError(f"{name}: expected {dtype} {expected}, found {array.dtype} {array.shape}")

    def _check_frames(self) -> None:
        if not 1 <= self.num_frames <= _MAX_FRAMES:
            raise ValueError(f"frame_ids: expected 1 to {_MAX_FRAMES} frames, found {self.num_frames}")
        if self.frame_ids[0] < 0 or (np.diff(self.frame_ids) <= 0).any():
            raise ValueError("frame_ids: expected numbers of 0 or more that strictly increase, found others")
        if not _is_rigid(self.T_world_section):
            raise ValueError(f"T_world_section: expected a rigid motion, found {self.T_world_section.tolist()}")
        for row, pose in enumerate(self.T_section_frame):
            if not _is_rigid(pose):
                raise ValueError(f"T_section_frame: expected a rigid motion in row {row}, found {pose.tolist()}")
        if not (np.isfinite(self.exposure_gain) & (self.exposure_gain > 0)).all():
            raise ValueError("exposure_gain: expected positive numbers, found others")
        if not np.isfinite(self.exposure_offset).all():
            raise ValueError("exposure_offset: expected finite numbers, found NaN or infinity")

    def _check_gaussians(self) -> None:
        self._check_range("frame_index", 0, self.num_frames - 1)
        self._check_range("pixel", 0, self.camera.width * self.camera.height - 1)
        self._check_range("subpixel", 0, 4)
        self._check_range("depth", 1, 65535)
        for name in ("color", "log_radius", "opacity_logit"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name}: expected finite numbers, found NaN or infinity")

    def _check_views(self) -> None:
        self._check_range("view_index", 0, self.num_frames - 1)
        if (np.diff(self.view_index.astype(np.int64)) <= 0).any():
            raise ValueError("view_index: expected rows that strictly increase, found others")

    def _check_range(self, name: str, low: int, high: int) -> None:
        values = getattr(self, name)
        if values.size and not (low <= values.min() and values.max() <= high):
            raise ValueError(f"{name}: expected {low} to {high}, found {values.min()} to {values.max()}")


def check_header_types(header: Mapping[str, Any]) -> None:
    """Raise ValueError unless a :meth:`SectionRecord.header` has its keys, of their types."""
    _check_map("header", header, _HEADER_TYPES)
    _check_map("camera", header["camera"], _CAMERA_TYPES)


def _is_rigid(pose: npt.NDArray[np.float64]) -> bool:
    with np.errstate(over="ignore", invalid="ignore"):  # numbers from a file may be as large as they like
        return se3.is_rigid(pose)


def _check_map(what: str, found: Mapping[str, Any], expected: Mapping[str, type]) -> None:
    kinds = {key: type(value).__name__ for key, value in found.items()}
    wanted = {key: kind.__name__ for key, kind in expected.items()}
    if kinds != wanted:
        raise ValueError(f"{what}: expected {wanted}, found {kinds}")

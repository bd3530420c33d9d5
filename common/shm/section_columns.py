"""How a section's frame table, images and columns lie in shared memory (docs/protocol-shm.md, sections 5 and 6)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.frame import Frame
from vtslam.common.gaussians import ViewTiedGaussians
from vtslam.common.geometry.camera import Camera
from vtslam.common.section import Section, SectionFrame
from vtslam.common.shm.blocks import aligned, column

ROW = np.dtype(
    [
        ("frame_id", "<i8"),
        ("capture_time_ns", "<i8"),
        ("T_section_frame", "<f8", (4, 4)),
        ("gain", "<f4", (3,)),
        ("offset", "<f4", (3,)),
        ("flags", "<u4"),
        ("unused", "<u4"),
    ]
)
KEEPS_DEPTH, TRAINED = 1, 2

# Descriptions of blocks that hold images or Gaussians start with these.
CAMERA_FIELDS: list[tuple[str, str]] = [
    ("section_id", "<i8"),
    ("width", "<u4"),
    ("height", "<u4"),
    ("fx", "<f8"),
    ("fy", "<f8"),
    ("cx", "<f8"),
    ("cy", "<f8"),
    ("depth_scale_m", "<f8"),
]

# Columns of Gaussians: name in `ViewTiedGaussians`, type, values per Gaussian.
TIE_COLUMNS: tuple[tuple[str, str, tuple[int, ...]], ...] = (
    ("pixel", "<i4", ()),
    ("frame_index", "<u2", ()),
    ("depth", "<u2", ()),
    ("subpixel", "<u1", ()),
)
LEARNED_COLUMNS: tuple[tuple[str, str, tuple[int, ...]], ...] = (
    ("colors", "<f4", (3,)),
    ("log_radii", "<f4", ()),
    ("opacity_logits", "<f4", ()),
)


def camera_of(description: Any) -> Camera:  # noqa: ANN401
    """The camera in a description that starts with `CAMERA_FIELDS`."""
    return Camera(
        width=int(description["width"]),
        height=int(description["height"]),
        **{name: float(description[name]) for name in ("fx", "fy", "cx", "cy")},
    )


def camera_fields(section_id: int, camera: Camera, depth_scale_m: float) -> tuple[float, ...]:
    """Values of `CAMERA_FIELDS`."""
    return (section_id, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, depth_scale_m)


def packed_rows(frames: tuple[SectionFrame, ...], trained: Callable[[int], bool]) -> npt.NDArray[Any]:
    """The frame table as records [F] of `ROW`."""
    rows = np.zeros(len(frames), ROW)
    if frames:  # by column, which takes a tenth of the time
        rows["frame_id"] = [frame.frame_id for frame in frames]
        rows["capture_time_ns"] = [frame.capture_time_ns for frame in frames]
        rows["T_section_frame"] = [frame.T_section_frame for frame in frames]
        rows["gain"] = [frame.exposure.gain for frame in frames]
        rows["offset"] = [frame.exposure.offset for frame in frames]
        keeps_depth = [KEEPS_DEPTH * (frame.view_depth is not None) for frame in frames]
        rows["flags"] = [keeps | TRAINED * trained(index) for index, keeps in enumerate(keeps_depth)]
    return rows


def frames_of_rows(
    rows: npt.NDArray[Any], view_depth: Callable[[int], npt.NDArray[np.uint16]]
) -> tuple[SectionFrame, ...]:
    """The frame table of records; ``view_depth`` gives the depth of rows that keep theirs."""
    columns = (rows["frame_id"].tolist(), rows["capture_time_ns"].tolist(), rows["flags"].tolist())
    poses, gains, offsets = rows["T_section_frame"], rows["gain"], rows["offset"]
    return tuple(
        SectionFrame(
            frame_id=frame_id,
            capture_time_ns=capture_time_ns,
            T_section_frame=poses[index],
            exposure=Exposure(gain=gains[index], offset=offsets[index]),
            view_depth=view_depth(index) if flags & KEEPS_DEPTH else None,
        )
        for index, (frame_id, capture_time_ns, flags) in enumerate(zip(*columns, strict=True))
    )


def untied_section(
    description: Any,  # noqa: ANN401
    *,
    T_world_section: npt.NDArray[np.float64],
    frames: tuple[SectionFrame, ...],
    gaussians: ViewTiedGaussians,
) -> Section:
    """A section without positions and surface."""
    return Section(
        section_id=int(description["section_id"]),
        T_world_section=T_world_section,
        camera=camera_of(description),
        depth_scale_m=float(description["depth_scale_m"]),
        depth_factor=float(description["depth_factor"]),
        frames=frames,
        gaussians=gaussians,
        means_m=np.zeros((0, 3), np.float32),
        surface=np.zeros((0, 6), np.float32),
    )


class ImageLayout:
    """Where a frame's colour and depth lie, one frame after another on pages of their own."""

    def __init__(self, camera: Camera) -> None:
        self._size = (camera.height, camera.width)
        pixels = camera.width * camera.height
        self._depth_offset = aligned(3 * pixels, 64)
        self.frame_bytes = aligned(self._depth_offset + 2 * pixels)

    def rgb(self, area: npt.NDArray[np.uint8], offset: int) -> npt.NDArray[np.uint8]:
        """Colour uint8 [H,W,3] of the frame that starts at ``offset``."""
        return column(area, offset, np.uint8, (*self._size, 3))

    def depth(self, area: npt.NDArray[np.uint8], offset: int) -> npt.NDArray[np.uint16]:
        """Depth uint16 [H,W] of the frame that starts at ``offset``."""
        return column(area, offset + self._depth_offset, "<u2", self._size)

    def write(self, area: npt.NDArray[np.uint8], offset: int, frame: Frame) -> None:
        """Copy a frame's images to ``offset``."""
        self.rgb(area, offset)[:] = frame.rgb
        self.depth(area, offset)[:] = frame.depth

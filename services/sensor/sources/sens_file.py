"""ScanNet's ``.sens`` files, version 4: one recording in one file, read frame by frame.

Little-endian: version (u32); length (u64) and bytes of the sensor's name; intrinsics and extrinsics of colour, then of
depth (four float32 4x4, row-major); compression of colour (i32: 0 raw, 1 PNG, 2 JPEG) and of depth (i32: 0 raw, 1 zlib,
2 occi); width and height of colour, then of depth (u32); depth units per metre (f32); number of frames (u64). Then for
each frame ``T_world_camera`` (float32 4x4), two time stamps (u64), bytes of colour and of depth (u64), and both images.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.image_files import decoded_color

_VERSION = 4
_LONGEST_NAME = 4096
_MATRIX = struct.Struct("<16f")
_IMAGES = struct.Struct("<iiIIIIfQ")
_FRAME = struct.Struct("<16fQQQQ")
_COLOR_COMPRESSIONS = (1, 2)  # PNG, JPEG
_DEPTH_RAW, _DEPTH_ZLIB = 0, 1
_LARGEST_SIDE = 1 << 15


@dataclass(frozen=True, slots=True, kw_only=True)
class SensHeader:
    """What the file says of all its frames.

    Attributes:
        sensor: The sensor's name.
        color_intrinsics: fx, fy, cx, cy of colour, pixel centres at whole numbers.
        color_size, depth_size: Width and height in pixels.
        depth_compression: 0 raw, 1 zlib.
        units_per_m: Of depth.
        num_frames: As the header says.
        frames_at: Offset of the first frame in the file.
    """

    sensor: str
    color_intrinsics: tuple[float, float, float, float]
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_compression: int
    units_per_m: float
    num_frames: int
    frames_at: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SensIndex:
    """Where the frames are, so that any of them is read alone.

    Attributes:
        offsets: Start of each frame's images, int64 [F].
        color_bytes, depth_bytes: Lengths of both, int64 [F].
        poses: ``T_world_camera`` float64 [F,4,4] as written, not finite where tracking was lost.
    """

    offsets: npt.NDArray[np.int64]
    color_bytes: npt.NDArray[np.int64]
    depth_bytes: npt.NDArray[np.int64]
    poses: npt.NDArray[np.float64]


def read_header(path: Path, file: BinaryIO) -> SensHeader:
    """The header of an open file.

    Raises:
        SourceError: It is cut, of another version, or says what this reader does not know.
    """
    (version,) = struct.unpack("<I", _taken(path, file, 4, "the version"))
    if version != _VERSION:
        raise SourceError(f"{path}: expected a .sens file of version {_VERSION}, found version {version}")
    (length,) = struct.unpack("<Q", _taken(path, file, 8, "the sensor's name"))
    if length > _LONGEST_NAME:
        raise SourceError(f"{path}: expected a sensor name of at most {_LONGEST_NAME} bytes, found {length}")
    sensor = _taken(path, file, length, "the sensor's name").decode("utf-8", errors="replace")
    color_matrix = _MATRIX.unpack(_taken(path, file, _MATRIX.size, "the intrinsics"))
    _taken(path, file, 3 * _MATRIX.size, "the intrinsics")
    color, depth, *sizes, units_per_m, num_frames = _IMAGES.unpack(_taken(path, file, _IMAGES.size, "the header"))
    _check(path, color, depth, sizes, units_per_m, num_frames)
    return SensHeader(
        sensor=sensor,
        color_intrinsics=(color_matrix[0], color_matrix[5], color_matrix[2], color_matrix[6]),
        color_size=(sizes[0], sizes[1]),
        depth_size=(sizes[2], sizes[3]),
        depth_compression=depth,
        units_per_m=float(units_per_m),
        num_frames=int(num_frames),
        frames_at=file.tell(),
    )


def read_index(path: Path, file: BinaryIO, header: SensHeader) -> SensIndex:
    """Places and poses of all frames, by reading their 96-byte heads and skipping their images.

    Raises:
        SourceError: The file ends before the last frame does.
    """
    rows = list(_heads(path, file, header))
    lengths = np.array([(at, color, depth) for at, color, depth, _ in rows], np.int64)
    return SensIndex(
        offsets=lengths[:, 0],
        color_bytes=lengths[:, 1],
        depth_bytes=lengths[:, 2],
        poses=np.array([pose for *_, pose in rows], np.float64).reshape(-1, 4, 4),
    )


def read_images(
    path: Path, header: SensHeader, index: SensIndex, number: int
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint16]]:
    """Colour uint8 [h,w,3] and depth uint16 [H,W] of frame ``number``, each of its own size.

    Raises:
        SourceError: The file is gone, shorter than it was, or an image is damaged.
    """
    where = f"{path}: frame {number}"
    try:
        with path.open("rb") as file:
            file.seek(int(index.offsets[number]))
            color = _taken(path, file, int(index.color_bytes[number]), f"the colour of frame {number}")
            depth = _taken(path, file, int(index.depth_bytes[number]), f"the depth of frame {number}")
    except OSError as error:
        raise SourceError(f"{where}: expected a readable file, found {error.strerror}") from error
    rgb = decoded_color(color, f"{where}: colour", header.color_size)
    return rgb, _decoded_depth(f"{where}: depth", depth, header)


def _heads(path: Path, file: BinaryIO, header: SensHeader) -> Iterator[tuple[int, int, int, tuple[float, ...]]]:
    at, end = header.frames_at, path.stat().st_size
    for number in range(header.num_frames):
        file.seek(at)
        *pose, _, _, color, depth = _FRAME.unpack(
            _taken(path, file, _FRAME.size, f"frame {number} of {header.num_frames}")
        )
        images_at = at + _FRAME.size
        at = images_at + color + depth
        if at > end:
            raise SourceError(
                f"{path}: expected {header.num_frames} frames, found the file cut within frame {number} "
                f"({end} bytes of at least {at})"
            )
        yield images_at, color, depth, tuple(pose)


def _check(path: Path, color: int, depth: int, sizes: list[int], units_per_m: float, num_frames: int) -> None:
    if color not in _COLOR_COMPRESSIONS:
        raise SourceError(f"{path}: expected colour compression 1 (PNG) or 2 (JPEG), found {color}")
    if depth not in (_DEPTH_RAW, _DEPTH_ZLIB):
        raise SourceError(f"{path}: expected depth compression 0 (raw) or 1 (zlib), found {depth}")
    if not all(0 < size < _LARGEST_SIDE for size in sizes):
        raise SourceError(f"{path}: expected image sizes from 1 to {_LARGEST_SIDE - 1}, found {sizes}")
    if not 0.0 < units_per_m < float("inf"):
        raise SourceError(f"{path}: expected positive depth units per metre, found {units_per_m}")
    if num_frames == 0:
        raise SourceError(f"{path}: expected frames, found none")


def _taken(path: Path, file: BinaryIO, count: int, what: str) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise SourceError(f"{path}: expected {count} bytes of {what}, found the file cut after {len(data)} of them")
    return data


def _decoded_depth(where: str, data: bytes, header: SensHeader) -> npt.NDArray[np.uint16]:
    width, height = header.depth_size
    expected = 2 * width * height
    if header.depth_compression == _DEPTH_ZLIB:
        unpacking = zlib.decompressobj()
        try:
            data = unpacking.decompress(data, expected + 1)
        except zlib.error as error:
            raise SourceError(f"{where}: expected zlib data, found {error}") from error
        if len(data) == expected and not unpacking.eof:
            raise SourceError(f"{where}: expected zlib data of {expected} bytes, found it cut or longer")
    if len(data) != expected:
        raise SourceError(f"{where}: expected {expected} bytes for {width}x{height}, found {len(data)}")
    return np.frombuffer(data, "<u2").reshape(height, width).astype(np.uint16)

"""Reading colour and depth image files strictly, and the source made of one file pair per frame.

What OpenCV makes of a cut or damaged file differs by version and format (some return as much as they could decode), so
each file's structure is checked before it is decoded.
"""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources.base import SourceError

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_JPEG_FRAMES = (*range(0xC0, 0xC4), *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0))  # SOF markers
_JPEG_ALONE = (0x00, 0x01, *range(0xD0, 0xD8))  # without a segment
_JPEG_LAST = (0xD9, 0xDA)  # end of the image, start of its data
_FRAMES_PER_SECOND = 30  # of recordings without time stamps


@dataclass(frozen=True, slots=True, kw_only=True)
class FramePaths:
    """The two image files of one frame."""

    color: Path
    depth: Path


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilePairSource:
    """A recording of one colour and one depth file per frame (the `Source` protocol).

    Attributes:
        uri, family, camera, depth_scale_m: As in `Source`.
        files: The image files of all frames, in order.
        poses: ``T_world_camera`` float64 [F,4,4], or None.
        no_depth: A raw depth value that means "no depth" besides 0, or None.
        capture_times_ns: Capture time of each frame; None for 30 frames a second from 0.
        color_size: Width and height of the colour images where they are not those of ``camera``; they are scaled to it
            by area.
    """

    uri: str
    family: str
    camera: Camera
    depth_scale_m: float
    files: Sequence[FramePaths]
    poses: npt.NDArray[np.float64] | None
    no_depth: int | None = None
    capture_times_ns: Sequence[int] | None = None
    color_size: tuple[int, int] | None = None

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.files)

    def frame(self, index: int) -> Frame:
        """Frame ``index``, 0 to F-1.

        Raises:
            SourceError: A file is missing, damaged, of another kind, or not of the intrinsics' size.
            IndexError: There is no such frame.
        """
        if not 0 <= index < len(self.files):
            raise IndexError(f"{self.uri}: frame {index} of {len(self.files)}")
        paths = self.files[index]
        rgb, depth = read_color(paths.color), read_depth(paths.depth)
        self._check_sizes(paths, rgb.shape[:2], depth.shape)
        rgb = scaled_color(rgb, self.camera)
        if self.no_depth is not None:
            depth[depth == self.no_depth] = 0
        return Frame(
            frame_id=index,
            capture_time_ns=assumed_time_ns(index) if self.capture_times_ns is None else self.capture_times_ns[index],
            rgb=rgb,
            depth=depth,
            depth_scale_m=self.depth_scale_m,
            camera=self.camera,
        )

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        """True poses ``T_world_camera`` float64 [F,4,4] (a copy), or None."""
        return None if self.poses is None else self.poses.copy()

    def _check_sizes(self, paths: FramePaths, color_hw: tuple[int, ...], depth_hw: tuple[int, ...]) -> None:
        if self.color_size is not None:
            self._check_own_sizes(paths, color_hw, depth_hw, self.color_size)
            return
        if color_hw != depth_hw:
            raise SourceError(f"{paths.depth}: expected the size of its colour image {_wxh(color_hw)}, "
                              f"found {_wxh(depth_hw)}")  # fmt: skip
        if color_hw != (self.camera.height, self.camera.width):
            raise SourceError(
                f"{paths.color}: expected the size of the intrinsics {self.camera.width}x{self.camera.height}, "
                f"found {_wxh(color_hw)}"
            )

    def _check_own_sizes(
        self, paths: FramePaths, color_hw: tuple[int, ...], depth_hw: tuple[int, ...], color_size: tuple[int, int]
    ) -> None:
        if color_hw != (color_size[1], color_size[0]):
            raise SourceError(f"{paths.color}: expected {color_size[0]}x{color_size[1]}, found {_wxh(color_hw)}")
        if depth_hw != (self.camera.height, self.camera.width):
            raise SourceError(
                f"{paths.depth}: expected {self.camera.width}x{self.camera.height}, found {_wxh(depth_hw)}"
            )


def assumed_time_ns(index: int) -> int:
    """Capture time of frame ``index`` of a recording without time stamps: 30 frames a second from 0."""
    return (index * 1_000_000_000) // _FRAMES_PER_SECOND


def scaled_color(rgb: npt.NDArray[np.uint8], camera: Camera) -> npt.NDArray[np.uint8]:
    """Colour uint8 [h,w,3] at the camera's size, uint8 [H,W,3], by area."""
    if rgb.shape[:2] == (camera.height, camera.width):
        return rgb
    return np.asarray(cv2.resize(rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)


def read_color(path: Path) -> npt.NDArray[np.uint8]:
    """An 8-bit PNG or JPEG file as uint8 [H,W,3], red first; rotation tags are not applied.

    Raises:
        SourceError: The file is missing, cut, damaged, or of another kind.
    """
    return decoded_color(_read_bytes(path, "colour image"), path)


def decoded_color(data: bytes, where: Path | str, size: tuple[int, int] | None = None) -> npt.NDArray[np.uint8]:
    """The same from the bytes of such a file.

    Args:
        data: The bytes.
        where: The file, or another place, for messages.
        size: Width and height that it must have; unpacking a file that claims another size is not even tried.

    Raises:
        SourceError: The bytes are cut, damaged, of another kind or size.
    """
    if data.startswith(_PNG_SIGNATURE):
        _check_png(where, data, size)
        if data[24] != 8:
            raise SourceError(f"{where}: expected an 8-bit colour image, found {data[24]} bits per channel")
    elif data.startswith(_JPEG_START):
        if not data.rstrip(b"\0").endswith(_JPEG_END):
            raise SourceError(
                f"{where}: expected a whole JPEG file, found it cut after {len(data)} bytes (no end mark)"
            )
        if size is not None:
            _check_claimed(where, _jpeg_size(where, data), size)
    else:
        raise SourceError(f"{where}: expected a PNG or JPEG file, found {_head(data)}")
    bgr = _decode(where, data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    _check_size(where, bgr, size)
    return np.ascontiguousarray(bgr[..., ::-1], np.uint8)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels of a PNG or JPEG file.

    Raises:
        SourceError: As :func:`read_color`.
    """
    height, width = read_color(path).shape[:2]
    return width, height


def read_depth(path: Path) -> npt.NDArray[np.uint16]:
    """A 16-bit gray PNG file as uint16 [H,W].

    Raises:
        SourceError: The file is missing, cut, damaged, or of another kind.
    """
    return decoded_depth(_read_bytes(path, "depth image"), path)


def decoded_depth(data: bytes, path: Path | str, size: tuple[int, int] | None = None) -> npt.NDArray[np.uint16]:
    """The same from the bytes of such a file; arguments and errors as those of `decoded_color`."""
    if not data.startswith(_PNG_SIGNATURE):
        raise SourceError(f"{path}: expected a 16-bit PNG file, found {_head(data)}")
    _check_png(path, data, size)
    bits, color_type = data[24], data[25]
    if bits != 16 or color_type != 0:
        kind = "gray" if color_type == 0 else f"PNG colour type {color_type}"
        raise SourceError(f"{path}: expected 16-bit gray depth, found {bits}-bit {kind}")
    depth = _decode(path, data, cv2.IMREAD_UNCHANGED)
    _check_size(path, depth, size)
    return np.asarray(depth, np.uint16)


def _read_bytes(path: Path, what: str) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise SourceError(f"{path}: expected a {what}, found no such file") from None
    except OSError as error:
        raise SourceError(f"{path}: expected a readable {what}, found {error.strerror}") from error


def _check_size(path: Path | str, image: npt.NDArray[np.generic], size: tuple[int, int] | None) -> None:
    if size is not None and image.shape[:2] != size[::-1]:
        raise SourceError(f"{path}: expected an image of {size[0]}x{size[1]}, found {_wxh(image.shape)}")


def _check_png(path: Path | str, data: bytes, size: tuple[int, int] | None) -> None:
    """Walk the chunks (length, type, payload, CRC) from IHDR to IEND."""
    at, kind = len(_PNG_SIGNATURE), b""
    while kind != b"IEND":
        if at + 12 > len(data):
            raise SourceError(f"{path}: expected a whole PNG file, found it cut after {len(data)} bytes")
        (length,) = struct.unpack_from(">I", data, at)
        kind, end = data[at + 4 : at + 8], at + 12 + length
        if end > len(data):
            raise SourceError(
                f"{path}: expected a whole PNG file, found it cut after {len(data)} bytes of at least {end + 12}"
            )
        (crc,) = struct.unpack_from(">I", data, end - 4)
        if crc != zlib.crc32(memoryview(data)[at + 4 : end - 4]):
            raise SourceError(f"{path}: expected a sound PNG file, found a wrong checksum in chunk {kind!r}")
        if at == len(_PNG_SIGNATURE) and (kind != b"IHDR" or length != 13):
            raise SourceError(f"{path}: expected a PNG header, found chunk {kind!r} of {length} bytes")
        at = end
    if size is not None:
        _check_claimed(path, struct.unpack_from(">II", data, 16), size)


def _jpeg_size(path: Path | str, data: bytes) -> tuple[int, int]:
    """Width and height by the frame header; segments before it are passed over as decoders do."""
    at = len(_JPEG_START) - 1
    while (at := data.find(b"\xff", at)) >= 0:
        while data[at : at + 1] == b"\xff":
            at += 1
        marker, at = data[at] if at < len(data) else -1, at + 1
        if marker in _JPEG_ALONE:
            continue
        if marker in _JPEG_FRAMES and at + 7 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 3)
            return width, height
        if marker in _JPEG_LAST or at + 2 > len(data):
            break
        at += max(int.from_bytes(data[at : at + 2], "big"), 2)
    raise SourceError(f"{path}: expected a JPEG file with a frame header, found none before its data")


def _check_claimed(path: Path | str, found: tuple[int, int], size: tuple[int, int]) -> None:
    """Refuse an image of another width and height by its header, before memory is taken for its pixels."""
    if found != size:
        raise SourceError(f"{path}: expected an image of {size[0]}x{size[1]}, found {found[0]}x{found[1]}")


def _decode(path: Path | str, data: bytes, flags: int) -> npt.NDArray[np.generic]:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise SourceError(f"{path}: expected a decodable image, found {error}") from error
    if image is None:
        raise SourceError(f"{path}: expected a decodable image, found damaged data ({len(data)} bytes)")
    return np.asarray(image)


def _head(data: bytes) -> str:
    return f"a file that begins with {data[:8].hex(' ')}" if data else "an empty file"


def _wxh(height_width: tuple[int, ...]) -> str:
    return f"{height_width[1]}x{height_width[0]}"

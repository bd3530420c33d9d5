"""Images of recorded messages as colour and depth of frames."""

import re

import numpy as np
import numpy.typing as npt

from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.image_files import decoded_color, decoded_depth
from vtslam.storage.recording.decoding import ImageMessage

_COLOR_ORDER = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "8uc3": (2, 1, 0)}
_GRAY, _MILLIMETRES, _METRES = ("mono8", "8uc1"), ("16uc1", "mono16"), ("32fc1",)
_COMPRESSED_DEPTH_HEAD = 12  # bytes before the PNG file in what ROS calls compressedDepth
_MAX_RAW = 65535


def color_of(image: ImageMessage, size: tuple[int, int], where: str) -> npt.NDArray[np.uint8]:
    """Colour, uint8 [H,W,3], red first.

    Args:
        image: The message.
        size: Width and height by the calibration.
        where: Its place, for messages.

    Raises:
        SourceError: It is damaged, of another size or of an encoding that is not read.
    """
    if image.format:
        return decoded_color(image.data, where, size)
    encoding = image.encoding.lower()
    if encoding in _GRAY:
        return np.repeat(_pixels(image, np.dtype("u1"), 1, size, where), 3, axis=2)
    if encoding not in _COLOR_ORDER:
        known = ", ".join((*_COLOR_ORDER, *_GRAY))
        raise SourceError(f"{where}: expected a colour image ({known}), found encoding {image.encoding!r:.40}")
    pixels = _pixels(image, np.dtype("u1"), 4 if "a8" in encoding else 3, size, where)
    return np.ascontiguousarray(pixels[..., list(_COLOR_ORDER[encoding])])


def depth_of(image: ImageMessage, size: tuple[int, int], units_per_m: float, where: str) -> npt.NDArray[np.uint16]:
    """Depth in units, uint16 [H,W]; 0 where there is none.

    Args:
        image: The message: uint16 values are units already, float32 values metres, rounded to units here.
        size: Width and height by the calibration.
        units_per_m: Units to a metre.
        where: Its place, for messages.

    Raises:
        SourceError: It is damaged, of another size or of an encoding that is not read.
    """
    if image.format:
        return decoded_depth(_depth_file(image, where), where, size)
    encoding = image.encoding.lower()
    order = ">" if image.is_bigendian else "<"
    if encoding in _MILLIMETRES:
        return _pixels(image, np.dtype(f"{order}u2"), 1, size, where)[..., 0].astype(np.uint16)
    if encoding not in _METRES:
        raise SourceError(f"{where}: expected a depth image (16UC1, 32FC1), found encoding {image.encoding!r:.40}")
    metres = _pixels(image, np.dtype(f"{order}f4"), 1, size, where)[..., 0]
    with np.errstate(invalid="ignore", over="ignore"):
        units = np.rint(metres.astype(np.float64) * units_per_m)
        return np.where((units >= 1.0) & (units <= _MAX_RAW), units, 0.0).astype(np.uint16)


def _depth_file(image: ImageMessage, where: str) -> bytes:
    """The PNG file in a compressed depth image."""
    if not re.search(r"compresseddepth", image.format, re.IGNORECASE):
        return image.data
    if not image.format.lower().startswith("16uc1"):
        raise SourceError(f"{where}: expected compressed depth of 16UC1, found {image.format!r:.60}")
    return image.data[_COMPRESSED_DEPTH_HEAD:]


def _pixels(
    image: ImageMessage, dtype: np.dtype[np.generic], channels: int, size: tuple[int, int], where: str
) -> npt.NDArray[np.generic]:
    """Raw pixels [H,W,channels]."""
    if (image.width, image.height) != size:
        raise SourceError(
            f"{where}: expected the size of the intrinsics {size[0]}x{size[1]}, found {image.width}x{image.height}"
        )
    row = image.width * channels * dtype.itemsize
    if image.step < row or len(image.data) < image.step * (image.height - 1) + row:
        raise SourceError(
            f"{where}: expected {image.height} rows of at least {row} bytes, "
            f"found {len(image.data)} bytes in rows of {image.step}"
        )
    data = np.frombuffer(image.data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(data, (image.height, row), (image.step, 1), writeable=False)
    return np.ascontiguousarray(rows).view(dtype).reshape(image.height, image.width, channels)

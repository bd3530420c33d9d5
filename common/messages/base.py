"""What all messages share, and the bounds on sizes that come from outside."""

import re
from typing import Annotated, ClassVar

import numpy as np

from vtslam.common.exposure import Exposure
from vtslam.common.geometry.camera import Camera
from vtslam.common.messages.rules import MAX_INT, NAME, POSE, Fields, Flag, Integer, Numbers, Real, Text

MAX_SIDE_PX = 8192  # of an image
MAX_PIXELS = 4096 * 2160  # of an image: bounds the memory a frame of another host can take

Count = Annotated[int, Integer(0, MAX_INT)]  # a number of things, an id, an epoch, nanoseconds
CaptureTime = Annotated[int, Integer(0, 2**62)]  # nanoseconds; leaves room in an int64 for what follows
OptionalId = Annotated[int, Integer(-1, MAX_INT)]  # -1: none
Name = Annotated[str, NAME]
Note = Annotated[str, Text(256)]
Switch = Annotated[bool, Flag()]
Measure = Annotated[float, Real()]
NonNegative = Annotated[float, Real(0.0)]
Share = Annotated[float, Real(0.0, 1.0)]
Side = Annotated[int, Integer(1, MAX_SIDE_PX)]
DepthScale = Annotated[float, Real(1e-9, 1e3)]
Sha256 = Annotated[str, Text(64, re.compile("[0-9a-f]{64}"))]

CAMERA = Fields(
    Camera,
    {
        "width": Integer(1, MAX_SIDE_PX),
        "height": Integer(1, MAX_SIDE_PX),
        "fx": Real(1e-3, 1e7),
        "fy": Real(1e-3, 1e7),
        "cx": Real(-1e7, 1e7),
        "cy": Real(-1e7, 1e7),
    },
)
EXPOSURE = Fields(Exposure, {"gain": Numbers((3,), "float32"), "offset": Numbers((3,), "float32")})
Pose = Annotated[np.ndarray[tuple[int, ...], np.dtype[np.float64]], POSE]


class Message:
    """A record that crosses the bus.

    Attributes:
        KIND: Its name on the wire.
        VERSION: Counts changes of its fields; readers refuse others than their own.
    """

    __slots__ = ()
    KIND: ClassVar[str]
    VERSION: ClassVar[int]


class Pixels:
    """Marks a field that travels as raw bytes after the record: an image of the size of the record's camera.

    Args:
        dtype: Type of its values, little-endian.
        channels: Values per pixel; 0 for an image [H,W].
    """

    __slots__ = ("channels", "dtype")

    def __init__(self, dtype: str, channels: int = 0) -> None:
        self.dtype, self.channels = np.dtype(dtype), channels

    def shape(self, camera: Camera) -> tuple[int, ...]:
        """Its shape for images of ``camera``."""
        size = (camera.height, camera.width)
        return (*size, self.channels) if self.channels else size

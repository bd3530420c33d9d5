"""Messages of sensors: frames in the ring, frames from another host, credit."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, ClassVar

import numpy as np
import numpy.typing as npt

from vtslam.common.external_pose import ExternalPose
from vtslam.common.geometry.camera import Camera
from vtslam.common.messages.base import (
    CAMERA,
    MAX_PIXELS,
    CaptureTime,
    Count,
    DepthScale,
    Message,
    Name,
    NonNegative,
    OptionalId,
    Pixels,
    Side,
)
from vtslam.common.messages.rules import COVARIANCE, POSE, Choice, Fields, Maybe

_PRIOR = Maybe(Fields(ExternalPose, {"T_world_camera": POSE, "covariance": COVARIANCE}))


class FrameCondition(StrEnum):
    """What the sensor service found odd about a frame."""

    OK = "ok"
    CLOCK_JUMPED = "clock_jumped"  # capture time went back or far ahead
    CAMERA_CHANGED = "camera_changed"
    COVERED = "covered"  # nothing to see


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameDescriptor(Message):
    """A frame that lies in the frame ring.

    Attributes:
        frame_id: Its place in the stream.
        capture_time_ns: Capture time.
        slot: The ring's slot.
        slot_sequence: Which filling of the slot it is; a reader discards what has another one.
        width, height: Size in pixels.
        epoch: Of the sensor service; those of a fenced one are smaller.
        dropped_before: Frames that were dropped between this one and the one published before.
        condition: What is odd about it.
        read_s: Seconds that reading it from its source took.
    """

    KIND: ClassVar[str] = "frame_descriptor"
    VERSION: ClassVar[int] = 1

    frame_id: Count
    capture_time_ns: Count
    slot: Count
    slot_sequence: Count
    width: Side
    height: Side
    epoch: Count
    dropped_before: Count = 0
    condition: Annotated[FrameCondition, Choice(FrameCondition)] = FrameCondition.OK
    read_s: NonNegative = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FramePixels(Message):
    """A whole frame, from a sensor that does not share memory with the fleet.

    Attributes:
        stream: Name of the publisher's stream.
        frame_id: Its place in the stream.
        capture_time_ns: Capture time.
        depth_scale_m: Metres per unit of depth.
        camera: Intrinsics of both images, pixel centres at half-integers.
        rgb: uint8 [H,W,3], red first.
        depth: uint16 [H,W]; 0 means no depth.
        pose_prior: Where another sensor says the camera was, or None. It comes with the frame, so that a frame that is
            sent again has the same.

    Raises:
        ValueError: The images have more pixels than allowed.
    """

    KIND: ClassVar[str] = "frame_pixels"
    VERSION: ClassVar[int] = 2

    stream: Name
    frame_id: Count
    capture_time_ns: CaptureTime
    depth_scale_m: DepthScale
    camera: Annotated[Camera, CAMERA]
    rgb: Annotated[npt.NDArray[np.uint8], Pixels("u1", 3)]
    depth: Annotated[npt.NDArray[np.uint16], Pixels("<u2")]
    pose_prior: Annotated[ExternalPose | None, _PRIOR] = None

    def __post_init__(self) -> None:
        pixels = self.camera.width * self.camera.height
        if pixels > MAX_PIXELS:
            raise ValueError(f"images of {pixels} pixels, at most {MAX_PIXELS} are taken")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Credit(Message):
    """How far a publisher of pixels may go: cumulative, so that a lost one is made good by the next.

    Attributes:
        acknowledged_frame_id: All frames up to this one are committed and need not be sent again; -1 for none.
        next_frame_id: The frame that is wanted next.
        limit_frame_id: Frames up to this one may be sent; -1 for none.
        epoch: Of the sensor service.
    """

    KIND: ClassVar[str] = "credit"
    VERSION: ClassVar[int] = 1

    acknowledged_frame_id: OptionalId
    next_frame_id: Count
    limit_frame_id: OptionalId
    epoch: Count

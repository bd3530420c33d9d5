"""The frame ring as the fleet's sensor makes it, and the message that names a frame in it."""

from pathlib import Path

from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.messages import FrameCondition, FrameDescriptor
from vtslam.common.shm.frame_ring import FrameRingWriter
from vtslam.common.shm.ring_layout import FrameDescriptor as RingDescriptor
from vtslam.common.shm.ring_layout import RingSpec

_PINS = 4
_REALTIME_SLOTS = 8  # of them two or three are pinned; the rest is what readers may be late


def make_ring(
    path: Path, camera: Camera, *, credit: int | None = None, frames_before: int = 0, is_recorded: bool = False
) -> FrameRingWriter:
    """A new ring for frames of ``camera``; raises SharedMemoryFull.

    Args:
        path: Where it will be.
        camera: Of all frames.
        credit: Frames that may be in it without being committed; None in realtime, where any may be overwritten.
        frames_before: Frames before the first one, which are done with.
        is_recorded: Whether frames stay until they are recorded, unless any may be overwritten.
    """
    slots = _REALTIME_SLOTS if credit is None else _PINS + credit
    spec = RingSpec(width=camera.width, height=camera.height, slots=slots, pins=_PINS)
    waits = is_recorded and credit is not None
    return FrameRingWriter.create(path, spec, acknowledged=frames_before, is_recorded=waits)


def descriptor_message(
    frame: Frame,
    descriptor: RingDescriptor,
    *,
    epoch: int,
    read_s: float = 0.0,
    condition: FrameCondition = FrameCondition.OK,
) -> FrameDescriptor:
    """What the sensor tells of a frame in the ring; ``read_s`` seconds were spent on reading it."""
    return FrameDescriptor(
        frame_id=frame.frame_id,
        capture_time_ns=frame.capture_time_ns,
        slot=descriptor.slot,
        slot_sequence=descriptor.sequence,
        width=frame.camera.width,
        height=frame.camera.height,
        epoch=epoch,
        read_s=read_s,
        condition=condition,
    )

"""The frame ring as the fleet's sensor makes it."""

from pathlib import Path

from vtslam.common.geometry.camera import Camera
from vtslam.common.shm.frame_ring import FrameRingWriter
from vtslam.common.shm.ring_layout import RingSpec

CREDIT = 2  # frames in the ring that are not committed: the one at work, and the next one ready
_PINS = 4


def make_ring(path: Path, camera: Camera, *, frames_before: int = 0) -> FrameRingWriter:
    """A new ring for frames of ``camera`` after the first ``frames_before``; raises SharedMemoryFull."""
    spec = RingSpec(width=camera.width, height=camera.height, slots=_PINS + CREDIT, pins=_PINS)
    return FrameRingWriter.create(path, spec, acknowledged=frames_before)

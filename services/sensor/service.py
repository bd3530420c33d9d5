"""The sensor as a service: the frames of a recording, one after another, into the ring; a descriptor on the bus."""

import time
from pathlib import Path

from vtslam.common.bus import Bus
from vtslam.common.frame import Frame
from vtslam.common.messages import ServiceState
from vtslam.common.shm.frame_ring import FrameRingReader, FrameRingWriter
from vtslam.common.shm.ring_layout import FrameDescriptor as RingDescriptor
from vtslam.common.topics import MAPPER_COMMITTED, SENSOR_FRAME
from vtslam.services.sensor.ring import descriptor_message, make_ring
from vtslam.services.sensor.sources.base import Source
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink


class RecordingSensor:
    """Puts every frame of a seekable source into the ring once, in order, as fast as they are committed.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        source: The recording; after a restart frames that the ring does not have are read again.
        ring_path: Where the ring is, or will be.
        credit: Frames that may be in the ring without being committed.
        frames_before: Frames that an earlier part of the run has mapped.
        is_recorded: Whether frames stay in the ring until they are recorded.
    """

    def __init__(
        self,
        bus: Bus,
        link: ServiceLink,
        source: Source,
        ring_path: Path,
        *,
        credit: int = 2,
        frames_before: int = 0,
        is_recorded: bool = False,
    ) -> None:
        self._link, self._source, self._credit = link, source, credit
        self._frames = bus.publisher(SENSOR_FRAME)
        self._commits = bus.subscriber(MAPPER_COMMITTED)
        self._ring = _open_ring(ring_path, source, credit, frames_before, is_recorded)
        self._next = self._ring.published  # frames are numbered from 0, the ring's sequence from 1
        self._read: tuple[Frame, float] | None = None
        self._announce_again(FrameRingReader(ring_path))

    def step(self) -> float | None:
        """See `Steps`."""
        self._link.poll()
        while self._commits.receive() is not None:
            pass  # what is committed is acknowledged in the ring
        self._link.counters["frames.published"] = self._next
        if self._link.stopping or self._next == len(self._source):
            self._link.tell(ServiceState.FINISHED, self._next - 1)
            return None
        frame, read_s = self._read = self._read or timed(self._source, self._next)
        descriptor = self._ring.try_publish(frame, credit=self._credit)
        if descriptor is None:
            self._link.tell(ServiceState.READY, self._next - 1)
            return HEARTBEAT_S
        self._announce(frame, descriptor, read_s)
        self._next, self._read = self._next + 1, None
        self._link.tell(ServiceState.WORKING, self._next - 1)
        return 0.0

    def _announce_again(self, reader: FrameRingReader) -> None:
        """Frames that are not done with, of a sensor that died: it may not have told anybody."""
        for descriptor in self._ring.unacknowledged():
            with reader.using(descriptor) as frame:
                self._announce(frame, descriptor, 0.0)

    def _announce(self, frame: Frame, descriptor: RingDescriptor, read_s: float) -> None:
        self._frames.publish(descriptor_message(frame, descriptor, epoch=self._link.epoch, read_s=read_s))


def _open_ring(path: Path, source: Source, credit: int, frames_before: int, is_recorded: bool) -> FrameRingWriter:
    """The fleet's ring, taken over from a sensor that died if there was one."""
    if path.exists():
        return FrameRingWriter.adopt(path)
    return make_ring(path, source.camera, credit=credit, frames_before=frames_before, is_recorded=is_recorded)


def timed(source: Source, index: int) -> tuple[Frame, float]:
    """A frame, and the seconds that reading it took."""
    start_s = time.perf_counter()
    frame = source.frame(index)
    return frame, time.perf_counter() - start_s

"""The sensor service of a recording in realtime: frames as fast as they were captured, whoever keeps up."""

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from vtslam.common.bus import Bus
from vtslam.common.frame import Frame
from vtslam.common.messages import ServiceState
from vtslam.common.shm.frame_ring import FrameRingWriter
from vtslam.common.topics import SENSOR_FRAME
from vtslam.services.sensor.ring import descriptor_message, make_ring
from vtslam.services.sensor.service import timed
from vtslam.services.sensor.sources.base import Source
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink


class ReplaySensor:
    """Puts each frame of a source into the ring when its time comes, over the oldest one that nobody uses.

    The next frame is read in a thread of its own, so that whoever tells of a frame does nothing else. A frame that
    takes too long to be read comes late, and so do those after it until they have caught up. A sensor that starts again
    goes on with the next frame.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        source: The recording.
        ring_path: Where the ring is, or will be.
        rate_hz: Frames per second; 0 as they were captured.
    """

    def __init__(self, bus: Bus, link: ServiceLink, source: Source, ring_path: Path, *, rate_hz: float = 0.0) -> None:
        self._clock, self._link, self._source, self._rate_hz = bus.clock, link, source, rate_hz
        self._frames = bus.publisher(SENSOR_FRAME)
        self._ring = FrameRingWriter.adopt(ring_path) if ring_path.exists() else make_ring(ring_path, source.camera)
        self._next = self._ring.published  # frames are numbered from 0, the ring's sequence from 1
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="read")
        self._read = self._reading()
        self._origin: tuple[int, int] | None = None  # a frame's time by the recording, and when that was

    def step(self) -> float | None:
        """See `Steps`."""
        self._link.poll()
        self._link.counters["frames.published"] = self._next
        if self._link.stopping or self._read is None:
            self._reader.shutdown(cancel_futures=True)
            self._link.tell(ServiceState.FINISHED, self._next - 1)
            return None
        self._link.tell(ServiceState.WORKING, self._next - 1)
        frame, read_s = self._read.result()
        left_s = self._left_s(frame)
        if left_s > 0.0:
            return min(left_s, HEARTBEAT_S)
        descriptor = self._ring.publish_newest(frame)
        self._frames.publish(descriptor_message(frame, descriptor, epoch=self._link.epoch, read_s=read_s))
        self._next += 1
        self._read = self._reading()
        return 0.0

    def _reading(self) -> Future[tuple[Frame, float]] | None:
        """The next frame, and the seconds that reading it took; None after the last."""
        if self._next >= len(self._source):
            return None
        return self._reader.submit(timed, self._source, self._next)

    def _left_s(self, frame: Frame) -> float:
        """Seconds until the frame's time."""
        time_ns = round(1e9 * self._next / self._rate_hz) if self._rate_hz > 0 else frame.capture_time_ns
        now_ns = self._clock.monotonic_ns()
        self._origin = self._origin or (time_ns, now_ns)
        return 1e-9 * (self._origin[1] + time_ns - self._origin[0] - now_ns)

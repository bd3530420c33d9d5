"""What the tracker hears of frames in the ring: it wakes it, and tells how long frames and descriptors take."""

from collections import deque

import numpy as np

from vtslam.common.bus import Bus
from vtslam.common.topics import SENSOR_FRAME
from vtslam.services.service_link import ServiceLink

_SAMPLES = 4096  # latencies remembered
_FRAMES = 1024  # frames remembered


class Descriptors:
    """Listens to the sensor, and keeps latencies of its messages in the service's gauges.

    Start-up, when all processes load what they need, is left out of the gauges.

    Args:
        bus: The tracker's session.
        link: What it says of itself.
    """

    def __init__(self, bus: Bus, link: ServiceLink) -> None:
        self._clock, self._link = bus.clock, link
        self._subscriber = bus.subscriber(SENSOR_FRAME)
        self._start_ns: int | None = None  # when start-up was over
        self._heard: dict[int, tuple[float, int]] = {}  # by frame: reading time, and when it was published
        self._latencies_ms: deque[float] = deque(maxlen=_SAMPLES)

    def listen(self, *, started: bool) -> None:
        """Take in what has come; ``started`` once a frame was committed."""
        if started and self._start_ns is None:
            self._start_ns = self._clock.wall_ns()
        to_wall_ns = self._clock.wall_ns() - self._clock.monotonic_ns()
        heard = False
        while (frame := self._subscriber.receive()) is not None:
            self._heard[frame.message.frame_id] = frame.message.read_s, frame.publish_time_ns
            if self._start_ns is not None and frame.publish_time_ns >= self._start_ns:
                self._latencies_ms.append(1e-6 * (frame.arrival_time_ns + to_wall_ns - frame.publish_time_ns))
                heard = True
        while len(self._heard) > _FRAMES:
            del self._heard[next(iter(self._heard))]
        if heard:
            p50, p99 = np.percentile(self._latencies_ms, (50.0, 99.0))
            self._link.gauges.update(descriptor_p50_ms=float(p50), descriptor_p99_ms=float(p99))

    def read_s(self, frame_id: int) -> float:
        """Seconds that reading a frame from its source took; 0 if nothing was said of it."""
        return self._heard[frame_id][0] if frame_id in self._heard else 0.0

    def published_ns(self, frame_id: int) -> int | None:
        """When the sensor told of a frame, by the wall clock; None if that was not heard (yet)."""
        return self._heard[frame_id][1] if frame_id in self._heard else None

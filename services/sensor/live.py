"""The sensor service of a live fleet: frames that a publisher sends over the bus, into the ring; credit back."""

from dataclasses import replace
from pathlib import Path

from vtslam.common.bus import Bus
from vtslam.common.frame import Frame
from vtslam.common.messages import Credit, FrameCondition, FramePixels, ServiceState
from vtslam.common.shm.frame_ring import FrameRingReader, FrameRingWriter
from vtslam.common.shm.ring_layout import FrameDescriptor as RingDescriptor
from vtslam.common.topics import MAPPER_COMMITTED, SENSOR_CREDIT, SENSOR_FRAME, SENSOR_PIXELS
from vtslam.services.sensor.ring import descriptor_message, make_ring
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink

WINDOW = 4  # frames a publisher may have under way
_FAR_AHEAD_NS = 86_400_000_000_000  # of the frame before: a day, which no pause of a camera takes


class LiveSensor:
    """Puts the frames of a publisher into the ring, each once, in the order of their numbers.

    The fleet numbers its frames from 0, and says in its credit which number it wants next; a publisher counts from
    there. A publisher keeps what is not committed, so a sensor that starts again gets it again. Frames of other
    numbers, of another camera or scale than the first one's, and of a time far ahead of the one before, which all later
    ones would have to follow, are refused and counted. Times that do not increase are counted too, and taken for the
    nanosecond after the one before.

    Without a credit (realtime) a frame in the ring is done with for its publisher, whatever becomes of it there.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        ring_path: Where the ring is, or will be once the first frame came.
        credit: Frames that may be in the ring without being committed; None in realtime, where the oldest one goes.
        is_recorded: Whether frames stay in the ring until they are recorded, but for realtime.
    """

    def __init__(
        self, bus: Bus, link: ServiceLink, ring_path: Path, *, credit: int | None = 2, is_recorded: bool = False
    ) -> None:
        self._clock, self._link, self._ring_path, self._credit_frames = bus.clock, link, ring_path, credit
        self._is_recorded = is_recorded
        self._pixels = bus.subscriber(SENSOR_PIXELS)
        self._commits = bus.subscriber(MAPPER_COMMITTED)
        self._frames = bus.publisher(SENSOR_FRAME)
        self._credit = bus.publisher(SENSOR_CREDIT)
        self._told: tuple[int, int] | None = None
        self._told_ns = 0
        self._pending: FramePixels | None = None
        self._last: Frame | None = None  # has the camera and scale of all frames
        self._ring = FrameRingWriter.adopt(ring_path) if ring_path.exists() else None
        if self._ring is not None:
            self._announce_again(FrameRingReader(ring_path))

    def step(self) -> float | None:
        """See `Steps`."""
        self._link.poll()
        while self._commits.receive() is not None:
            pass  # what is committed is acknowledged in the ring
        self._link.counters["frames.published"] = self._wanted
        if self._link.stopping:
            self._link.tell(ServiceState.FINISHED, self._wanted - 1)
            return None
        progress = self._take_one()
        self._grant()
        self._link.tell(ServiceState.WORKING if progress else ServiceState.READY, self._wanted - 1)
        return 0.0 if progress else HEARTBEAT_S

    @property
    def _wanted(self) -> int:
        """The number of the next frame."""
        return 0 if self._ring is None else self._ring.published

    def _take_one(self) -> bool:
        """Bring one message further; false if there is none, or the ring is full."""
        if self._pending is None:
            received = self._pixels.receive()
            if received is None:
                return False
            self._pending = received.message
        pixels = self._pending
        if not self._is_wanted(pixels):
            self._pending = None
            return True
        frame, condition = self._in_time(_frame_of(pixels))
        if self._ring is None:
            self._ring = make_ring(
                self._ring_path, frame.camera, credit=self._credit_frames, is_recorded=self._is_recorded
            )
        descriptor = self._published(self._ring, frame)
        if descriptor is None:
            return False
        self._pending, self._last = None, frame
        self._announce(frame, descriptor, condition)
        if condition is not FrameCondition.OK:
            self._link.count(f"frames.{condition}")
        return True

    def _published(self, ring: FrameRingWriter, frame: Frame) -> RingDescriptor | None:
        if self._credit_frames is None:
            return ring.publish_newest(frame)
        return ring.try_publish(frame, credit=self._credit_frames)

    def _is_wanted(self, pixels: FramePixels) -> bool:
        if pixels.frame_id != self._wanted:
            self._link.count("frames.repeated" if pixels.frame_id < self._wanted else "frames.ahead")
            return False
        last = self._last
        if last is not None and (last.camera, last.depth_scale_m) != (pixels.camera, pixels.depth_scale_m):
            self._link.count("frames.other_camera")
            return False
        if last is not None and pixels.capture_time_ns - last.capture_time_ns > _FAR_AHEAD_NS:
            self._link.count("frames.other_time")
            return False
        return True

    def _in_time(self, frame: Frame) -> tuple[Frame, FrameCondition]:
        """The frame at a time after the one before, as trajectories need it."""
        if self._last is None or frame.capture_time_ns > self._last.capture_time_ns:
            return frame, FrameCondition.OK
        return replace(frame, capture_time_ns=self._last.capture_time_ns + 1), FrameCondition.CLOCK_JUMPED

    def _grant(self) -> None:
        """Say how far publishers may go, when that has changed and now and then."""
        committed = self._wanted - 1
        if self._ring is not None and self._credit_frames is not None:
            committed = self._ring.acknowledged - 1
        now_ns = self._clock.monotonic_ns()
        if self._told == (committed, self._wanted) and now_ns - self._told_ns < HEARTBEAT_S * 1e9:
            return
        self._told, self._told_ns = (committed, self._wanted), now_ns
        self._credit.publish(
            Credit(
                acknowledged_frame_id=committed,
                next_frame_id=self._wanted,
                limit_frame_id=self._wanted + WINDOW - 1,
                epoch=self._link.epoch,
            )
        )

    def _announce_again(self, reader: FrameRingReader) -> None:
        """Frames that are not done with, of a sensor that died; any of the ring's frames says what they are like."""
        newest = reader.newest()
        if newest is not None:
            self._last = reader.copied(newest)
        for descriptor in reader.unacknowledged():
            with reader.using(descriptor) as frame:
                self._announce(frame, descriptor)

    def _announce(
        self, frame: Frame, descriptor: RingDescriptor, condition: FrameCondition = FrameCondition.OK
    ) -> None:
        self._frames.publish(descriptor_message(frame, descriptor, epoch=self._link.epoch, condition=condition))


def _frame_of(pixels: FramePixels) -> Frame:
    return Frame(
        frame_id=pixels.frame_id,
        capture_time_ns=pixels.capture_time_ns,
        rgb=pixels.rgb,
        depth=pixels.depth,
        depth_scale_m=pixels.depth_scale_m,
        camera=pixels.camera,
        pose_prior=pixels.pose_prior,
    )

"""Publishes frames to a fleet from any program: what a camera driver calls."""

from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Self

from vtslam.common.bus import Bus, BusError, Member
from vtslam.common.bus_zenoh import join
from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.frame import Frame
from vtslam.common.messages import Credit, FramePixels
from vtslam.common.topics import SENSOR_CREDIT, SENSOR_PIXELS, Role

_STREAM = "frames"
_FIRST_PATIENCE_S = 2.0  # without progress, until frames under way are sent again; doubled each time


class FramePublisher:
    """Sends frames to a fleet, no faster than it takes them; a context manager that waits for the last one.

    In lockstep a frame is taken once there is room for it beside those being mapped, in realtime at once; likewise the
    last one is waited for until it is in the map, or only until it has arrived.

    Frames are numbered by the fleet; their own ``frame_id`` does not matter. What is not committed is kept, at most a
    few frames, and sent again if the fleet's sensor service was started again.

    Args:
        fleet: Name of a fleet of this user on this host, as in ``vtslam up --fleet NAME``, or a bus of another one.
        timeout_s: How long to wait for the fleet, and for room.

    Raises:
        SharedMemoryError: There is no such fleet on this host.
        BusError: It does not answer in time.
    """

    def __init__(self, fleet: str | Bus, *, timeout_s: float = 60.0) -> None:
        self._bus = _joined(fleet, timeout_s) if isinstance(fleet, str) else fleet
        self._timeout_s = timeout_s
        self._pixels = self._bus.publisher(SENSOR_PIXELS)
        self._credits = self._bus.subscriber(SENSOR_CREDIT)
        self._credit: Credit | None = None
        self._kept: OrderedDict[int, FramePixels] = OrderedDict()
        self._again_ns, self._patience_s = self._bus.clock.monotonic_ns(), _FIRST_PATIENCE_S
        self._next = 0
        self._next = self._granted().next_frame_id

    def publish(self, frame: Frame) -> int:
        """Send a frame, when there is room for it; its number in the fleet.

        Raises:
            BusError: There was no room in time.
        """
        number = self._next
        self._wait(lambda credit: credit.limit_frame_id >= number, "room for a frame")
        pixels = FramePixels(
            stream=_STREAM,
            frame_id=number,
            capture_time_ns=frame.capture_time_ns,
            depth_scale_m=frame.depth_scale_m,
            camera=frame.camera,
            rgb=frame.rgb.copy(),  # the caller's may change before it is sent again
            depth=frame.depth.copy(),
            pose_prior=None if frame.pose_prior is None else frame.pose_prior.copied(),
        )
        self._kept[number] = pixels
        self._next += 1
        self._pixels.publish(pixels)
        return number

    def flush(self) -> None:
        """Wait until every frame is in the map; raises BusError if that takes longer than the timeout for one."""
        while self._kept:
            first = next(iter(self._kept))
            self._wait(partial(_is_committed, first), f"the commit of frame {first}")

    def close(self) -> None:
        """Leave the fleet; frames that are not committed yet may be lost: see :meth:`flush`."""
        self._bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.flush()
        finally:
            self.close()

    # --- credit -----------------------------------------------------------------------------------------------------

    def _granted(self) -> Credit:
        """The credit as it is now."""
        self._wait(lambda credit: True, "an answer")
        assert self._credit is not None
        return self._credit

    def _wait(self, enough: Callable[[Credit], bool], what: str) -> None:
        def poll() -> bool | None:
            self._listen()
            return True if self._credit is not None and enough(self._credit) else None

        if self._bus.until(poll, timeout_s=self._timeout_s) is None:
            raise BusError(f"fleet {self._bus.member.fleet}: {what} did not come within {self._timeout_s:g} s")

    def _listen(self) -> None:
        while (received := self._credits.receive()) is not None:
            self._take(received.message)

    def _take(self, credit: Credit) -> None:
        """Forget what is committed; send again what a sensor service that started anew, or a bad line, has lost."""
        former = self._credit
        if former is not None and credit.epoch < former.epoch:
            return
        self._credit = credit
        for number in [each for each in self._kept if each <= credit.acknowledged_frame_id]:
            del self._kept[number]
        now_ns = self._bus.clock.monotonic_ns()
        moved = former is None or (credit.epoch, credit.next_frame_id) != (former.epoch, former.next_frame_id)
        if moved or credit.next_frame_id >= self._next:
            self._again_ns, self._patience_s = now_ns, _FIRST_PATIENCE_S
        restarted = former is not None and credit.epoch > former.epoch
        if restarted or now_ns - self._again_ns > self._patience_s * 1e9:
            self._again_ns, self._patience_s = now_ns, 2.0 * self._patience_s
            for number, pixels in self._kept.items():
                if number >= credit.next_frame_id:
                    self._pixels.publish(pixels)


def _is_committed(number: int, credit: Credit) -> bool:
    return credit.acknowledged_frame_id >= number


def _joined(fleet: str, timeout_s: float) -> Bus:
    folder = FleetFolder.open(fleet)
    return join(Member(fleet=fleet, role=Role.REMOTE_SENSOR, name="publisher"), folder.path, timeout_s=timeout_s)

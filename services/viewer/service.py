"""The viewer as a service: looks at the fleet now and then, and shows what is new."""

import contextlib
import time
from collections.abc import Iterable
from typing import Protocol

from vtslam.common.bus import Bus
from vtslam.common.messages import ServiceState, ServiceStatus
from vtslam.common.topics import EVERY_SERVICE, STATUS
from vtslam.services.process_facts import private_rss_mb
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink
from vtslam.services.viewer.fleet_view import FleetView, Update
from vtslam.services.viewer.parts import Part

_LEAST_INTERVAL_S = 0.2  # between updates


class Sink(Protocol):
    """Who shows updates."""

    @property
    def is_open(self) -> bool:
        """Whether somebody could see them."""
        ...

    def is_free(self) -> bool:
        """Whether the last one was taken."""
        ...

    def send(self, frame_id: int, update: Iterable[Part]) -> bool:
        """Show one; whether it was accepted."""
        ...

    def close(self) -> None:
        """Nothing more comes."""
        ...


class ViewerService:
    """Shows a fleet without being waited for.

    It reads shared memory by copies, and of the messages only those that the bus drops rather than wait (statuses).
    After each update it pauses so long that its processor time stays within its share, and an update that the
    sink has not taken yet delays its own successors only: what came in between is never shown.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        view: What there is to show.
        sink: Who shows it.
        cpu_share: Of one core.
    """

    def __init__(self, bus: Bus, link: ServiceLink, view: FleetView, sink: Sink, *, cpu_share: float) -> None:
        self._clock, self._link, self._view, self._sink, self._cpu_share = bus.clock, link, view, sink, cpu_share
        self._statuses = bus.subscriber(STATUS, service=EVERY_SERVICE)
        self._heard: dict[str, ServiceStatus] = {}
        self._due_s = 0.0
        self._spent_s = time.process_time()  # processor time up to the last update; what the start took counts too

    def step(self) -> float | None:
        """See `Steps`."""
        self._link.poll()
        while (received := self._statuses.receive()) is not None:
            self._heard[received.message.service] = received.message
        if self._link.stopping or not self._sink.is_open:
            self._show_rest()
            self._sink.close()
            self._link.tell(ServiceState.FINISHED, self._view.last_frame_id)
            return None
        now_s = self._now_s()
        if now_s >= self._due_s:
            self._show()
            used_s, self._spent_s = time.process_time() - self._spent_s, time.process_time()
            self._due_s = self._now_s() + max(_LEAST_INTERVAL_S, used_s / self._cpu_share)
        self._link.tell(ServiceState.READY, self._view.last_frame_id)
        return min(max(self._due_s - self._now_s(), 0.0), HEARTBEAT_S)

    def _now_s(self) -> float:
        return 1e-9 * self._clock.monotonic_ns()

    def _show(self) -> bool:
        """Show what is new; false if there is nothing, or the last update has not been taken."""
        if not self._sink.is_free():
            self._link.count("updates.waited")
            return False
        update = self._news()
        if update is None or not self._sink.send(update.frame_id, update.parts):
            return False
        self._link.count("updates.shown")
        return True

    def _show_rest(self) -> None:
        while self._sink.is_open and self._show():
            pass

    def _news(self) -> Update | None:
        memory_mb = {name: private_rss_mb(status.pid) for name, status in self._heard.items()}
        with contextlib.suppress(FileNotFoundError):  # the fleet's folder is gone
            return self._view.news({name: status.counters for name, status in self._heard.items()}, memory_mb)
        return None

"""What every service of a fleet says of itself, and what it is told."""

import os

from vtslam.common.bus import Bus, Publisher
from vtslam.common.messages import Command, FleetEvent, ServiceState, ServiceStatus
from vtslam.common.topics import CONTROL, FLEET_EVENT, STATUS
from vtslam.services.process_facts import peak_rss_mb

HEARTBEAT_S = 0.5
_IN_TURN = (ServiceState.READY, ServiceState.WORKING)  # of each other, with every frame


class ServiceLink:
    """Heartbeats out, orders in. To be used from the work loop only, so that a loop that hangs falls silent.

    Args:
        bus: The service's session.
        epoch: Which start of the service this is.

    Attributes:
        drain_through: Finish the frames up to this one, then end; None while there is no such order.
        stopping: Finish the step at hand, then end.
        counters, gauges: Figures of the status, by name.
    """

    def __init__(self, bus: Bus, epoch: int) -> None:
        self._bus, self.epoch = bus, epoch
        self._name = bus.member.name
        self._orders = bus.subscriber(CONTROL, service=self._name)
        self._status = bus.publisher(STATUS, service=self._name)
        self._token = bus.declare_alive()
        self._events: Publisher[FleetEvent] | None = None
        self._told: ServiceState | None = None
        self._told_ns = 0
        self.drain_through: int | None = None
        self.stopping = False
        self.counters: dict[str, int] = {}
        self.gauges: dict[str, float] = {}

    def count(self, what: str, number: int = 1) -> None:
        """Add to a counter of the status."""
        self.counters[what] = self.counters.get(what, 0) + number

    def poll(self) -> None:
        """Take in the orders that have come."""
        while (received := self._orders.receive()) is not None:
            order = received.message
            if order.epoch != self.epoch:
                continue
            if order.command is Command.STOP:
                self.stopping = True
            elif order.command is Command.DRAIN:
                self.drain_through = order.through_frame_id

    def tell(self, state: ServiceState, last_frame_id: int, *, detail: str = "") -> None:
        """A heartbeat, if the last one is long ago or the state has changed.

        Whether there was work at that moment does not count: processes would be woken several times for each frame.
        """
        now_ns = self._bus.clock.monotonic_ns()
        unchanged = self._told is state or (self._told in _IN_TURN and state in _IN_TURN)
        if unchanged and now_ns - self._told_ns < HEARTBEAT_S * 1e9:
            return
        self._told, self._told_ns = state, now_ns
        self._status.publish(
            ServiceStatus(
                service=self._name,
                pid=os.getpid(),
                epoch=self.epoch,
                state=state,
                last_frame_id=last_frame_id,
                counters=dict(self.counters),
                gauges={**self.gauges, "peak_rss_mb": peak_rss_mb()},
                detail=_printable(detail),
            )
        )

    def event(self, kind: str, text: str) -> None:
        """Tell the user, and the run's catalogue, what happened."""
        self._events = self._events or self._bus.publisher(FLEET_EVENT)
        now_ns = self._bus.clock.wall_ns()
        self._events.publish(FleetEvent(service=self._name, kind=kind, text=_printable(text), time_ns=now_ns))


def _printable(text: str) -> str:
    return "".join(c for c in text if c.isprintable())[:256]

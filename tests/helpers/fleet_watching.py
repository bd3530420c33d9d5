"""Who watches and orders the services of a fleet in memory, in the place of its supervisor."""

from dataclasses import dataclass

from vtslam.common.bus import Bus, Steps
from vtslam.common.messages import Command, Control, ServiceState
from vtslam.common.topics import CONTROL, EVERY_SERVICE, STATUS


@dataclass(slots=True)
class Watched:
    """A service whose end is noted, as a supervisor notes that of a process."""

    name: str
    steps: Steps
    ended: set[str]

    def step(self) -> float | None:
        patience_s = self.steps.step()
        if patience_s is None:
            self.ended.add(self.name)
        return patience_s


@dataclass(slots=True)
class Slow:
    """A service whose working steps take a while, in which it neither hears nor does anything."""

    steps: Steps
    seconds: float
    bus: Bus
    busy_until_ns: int = 0

    def step(self) -> float | None:
        left_ns = self.busy_until_ns - self.bus.clock.monotonic_ns()
        if left_ns > 0:
            return 1e-9 * left_ns
        patience_s = self.steps.step()
        if patience_s == 0.0 and self.seconds > 0.0:
            self.busy_until_ns = self.bus.clock.monotonic_ns() + int(1e9 * self.seconds)
            return self.seconds
        return patience_s


class Conductor:
    """Ends the fleet in order, as its supervisor does."""

    def __init__(self, bus: Bus, epochs: dict[str, int], ended: set[str], last_frame_id: int) -> None:
        self._epochs, self._ended, self._last = epochs, ended, last_frame_id
        self._ordered: set[tuple[str, int]] = set()
        self._orders = {name: bus.publisher(CONTROL, service=name) for name in epochs}

    def step(self) -> float | None:
        if self._ended == self._epochs.keys():
            return None
        if "sensor" in self._ended:
            self._order("mapper", Command.DRAIN)
        if "mapper" in self._ended:
            self._order("tracker", Command.STOP)
            if "archiver" in self._epochs:
                self._order("archiver", Command.DRAIN)
        return 0.1

    def _order(self, name: str, command: Command) -> None:
        epoch = self._epochs[name]
        if (name, epoch) not in self._ordered:
            self._ordered.add((name, epoch))
            self._orders[name].publish(Control(command=command, through_frame_id=self._last, epoch=epoch))


class Observer:
    """Keeps what services say that do not work as they should."""

    def __init__(self, bus: Bus, degraded: dict[str, str], ended: set[str], services: int) -> None:
        self._statuses = bus.subscriber(STATUS, service=EVERY_SERVICE)
        self._degraded, self._ended, self._num_services = degraded, ended, services

    def step(self) -> float | None:
        while (received := self._statuses.receive()) is not None:
            if received.message.state is ServiceState.DEGRADED:
                self._degraded[received.message.service] = received.message.detail
        return None if len(self._ended) == self._num_services else 0.5

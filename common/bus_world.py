"""A world in one thread for the bus in memory: what is under way, services, their deaths, and a clock that jumps.

Everything that could happen next is a named event: the delivery of the oldest message under way between two ends, or a
step of a service that has something to read or has waited long enough. A schedule chooses. Only when nothing can happen
does the clock go on, to the next thing that waits for it.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass

from vtslam.common.bus import Bus, BusError, Member, Steps
from vtslam.common.bus_schedule import Kills, NoKills, Schedule

_START_NS = 1_000_000_000_000
_EVENT_NS = 1_000  # that an event takes
_NEVER_NS = 2**63 - 1
_MAX_EVENTS = 1_000_000  # of one call: a course that goes on for ever ends in an error


class SimulatedDeath(BaseException):
    """Unwinds a service that is killed at a point; services must not catch it, nor act in `finally` as if alive."""


class SimulatedClock:
    """Time that goes on only when the world says so."""

    def __init__(self) -> None:
        self.now_ns = _START_NS

    def monotonic_ns(self) -> int:
        """See `Clock`."""
        return self.now_ns

    def wall_ns(self) -> int:
        """See `Clock`."""
        return self.now_ns


class Session(Bus):
    """A session in a world.

    Attributes:
        has_news: Whether something arrived since the last `wait`, or since a service's last step began.
    """

    has_news: bool = False


@dataclass(slots=True, kw_only=True, eq=False)
class _Service:
    """A service of the world, and what it takes to start it again."""

    member: Member
    start: Callable[[Session], Steps]
    restart_s: float
    bus: Session | None = None
    steps: Steps | None = None
    wake_ns: int = 0
    finished: bool = False


class World(ABC):
    """See the module.

    Args:
        schedule: Chooses what happens next.
        kills: Decides which services die where.

    Attributes:
        clock: The simulated clock.
        deaths: Services killed so far with the point where they were.
        passed: Points passed so far, as (service, point); a kill can be set at each.
        course: The events that happened, by name.
    """

    def __init__(self, schedule: Schedule, *, kills: Kills | None = None) -> None:
        self.clock = SimulatedClock()
        self.deaths: list[tuple[str, str]] = []
        self.passed: list[tuple[str, str]] = []
        self.course: list[str] = []
        self._schedule, self._kills = schedule, kills or NoKills()
        self._channels: dict[Hashable, deque[tuple[str, Callable[[], None]]]] = {}
        self._services: dict[str, _Service] = {}
        self._running: list[_Service] = []

    @abstractmethod
    def join(self, member: Member) -> Session:
        """A session of a member; called for each start of a service, and by tests for members they drive themselves."""

    def add_service(self, member: Member, start: Callable[[Session], Steps], *, restart_s: float = 0.1) -> None:
        """Add a service that the world steps, and starts again after ``restart_s`` when it was killed."""
        self._services[member.name] = _Service(
            member=member, start=start, restart_s=restart_s, wake_ns=self.clock.now_ns
        )

    def point(self, name: str) -> None:
        """A point where the service that runs may be killed; nothing happens outside of services."""
        if not self._running:
            return
        service = self._running[-1].member.name
        self.passed.append((service, name))
        if self._kills.dies(service, name):
            self.deaths.append((service, name))
            raise SimulatedDeath(f"{service} at {name}")

    def send(self, channel: Hashable, name: str, deliver: Callable[[], None]) -> None:
        """Put something under way; what is in one channel arrives in order."""
        self._channels.setdefault(channel, deque()).append((name, deliver))

    def run(self, *, timeout_s: float, done: Callable[[], bool] | None = None) -> bool:
        """Let things happen until ``done`` (by default: all services have finished); False if time ran out first."""
        ready = done or (lambda: all(service.finished for service in self._services.values()))
        deadline_ns = self.clock.now_ns + int(timeout_s * 1e9)
        for _ in range(_MAX_EVENTS):
            if ready():
                return True
            if self.clock.now_ns >= deadline_ns:
                return False
            if not self._happen():
                self.clock.now_ns = max(min(self._next_wake_ns(), deadline_ns), self.clock.now_ns)
        raise BusError(f"no end after {_MAX_EVENTS} events")

    def close(self) -> None:
        """End all services and forget what is under way."""
        for service in self._services.values():
            if service.bus is not None:
                service.bus.close()
        self._channels.clear()

    def _happen(self) -> bool:
        """One event, if any can happen."""
        events = [(queue[0][0], channel) for channel, queue in self._channels.items() if queue]
        steps = [service for service in self._services.values() if self._can_step(service)]
        names = [name for name, _ in events] + [f"step {service.member.name}" for service in steps]
        if not names:
            return False
        chosen = self._schedule.choose(names)
        self.course.append(names[chosen])
        self.clock.now_ns += _EVENT_NS
        if chosen >= len(events):
            self._step(steps[chosen - len(events)])
            return True
        channel = events[chosen][1]
        _, deliver = self._channels[channel].popleft()
        if not self._channels[channel]:
            del self._channels[channel]
        deliver()
        return True

    def _can_step(self, service: _Service) -> bool:
        if service.finished or service in self._running:
            return False
        return self.clock.now_ns >= service.wake_ns or (service.bus is not None and service.bus.has_news)

    def _next_wake_ns(self) -> int:
        waiting = [s.wake_ns for s in self._services.values() if not s.finished and s not in self._running]
        return min(waiting, default=_NEVER_NS)

    def _step(self, service: _Service) -> None:
        self._running.append(service)
        try:
            if service.bus is None or service.steps is None:
                service.bus = self.join(service.member)
                service.steps = service.start(service.bus)
            service.bus.has_news = False
            patience_s = service.steps.step()
            service.finished = patience_s is None
            service.wake_ns = self.clock.now_ns + int((patience_s or 0.0) * 1e9)
        except SimulatedDeath:
            self._bury(service)
        finally:
            self._running.pop()

    def _bury(self, service: _Service) -> None:
        if service.bus is not None:
            service.bus.close()
        service.bus = service.steps = None
        service.wake_ns = self.clock.now_ns + int(service.restart_s * 1e9)

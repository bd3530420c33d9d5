"""The bus as services see it: publishers, subscribers, questions and answers, who is alive, and what time it is.

Two implementations: `vtslam.common.bus_zenoh` between processes, and `vtslam.common.bus_memory` for several services in
one thread with a simulated clock. Nothing here blocks but `Bus.wait` and what is built on it, so a service is a `Steps`
that reads what has arrived, works and publishes, and a loop around it (`run_steps`).
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Generic, Protocol, Self, TypeVar

from vtslam.common.bus_inbox import Subscriber
from vtslam.common.bus_life import AliveWatcher
from vtslam.common.bus_received import Received
from vtslam.common.messages import Message
from vtslam.common.topics import QueryTopic, Role, Topic, checked_name

M = TypeVar("M", bound=Message)
R = TypeVar("R", bound=Message)
M_co = TypeVar("M_co", bound=Message, covariant=True)
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)
R_co = TypeVar("R_co", bound=Message, covariant=True)
R_contra = TypeVar("R_contra", bound=Message, contravariant=True)
T = TypeVar("T")


class BusError(Exception):
    """The bus cannot do what it was asked."""


class NoReply(BusError):
    """A question was not answered: nobody to answer, a refusal, an answer that was not accepted, or no time left."""


class Clock(Protocol):
    """Time, so that it can be simulated."""

    def monotonic_ns(self) -> int:
        """Nanoseconds that never go back; for durations and deadlines."""
        ...

    def wall_ns(self) -> int:
        """Nanoseconds since 1970; for what is written down."""
        ...


class SystemClock:
    """The machine's clocks."""

    def monotonic_ns(self) -> int:
        """See `Clock`."""
        return time.monotonic_ns()

    def wall_ns(self) -> int:
        """See `Clock`."""
        return time.time_ns()


@dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """Who opens a session.

    Attributes:
        fleet: The fleet's name; members of other fleets are never seen.
        role: What it does; decides what it may publish.
        name: Its own name, for status, control and liveliness; the role's unless given.
    """

    fleet: str
    role: Role
    name: str = ""

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.role.value)
        checked_name(self.fleet)
        checked_name(self.name)


class Steps(Protocol):
    """A service, one step at a time."""

    def step(self) -> float | None:
        """Deal with what has arrived; returns the seconds it can wait if nothing arrives, None when it has finished."""
        ...


class Closeable(Protocol):
    """Something that is given back."""

    def close(self) -> None:
        """Give it back; further calls do nothing."""
        ...


class Publisher(Protocol[M_contra]):
    """Publishes one topic."""

    def publish(self, message: M_contra) -> int:
        """Send a message; returns its sequence number.

        Raises:
            MessageError: A field holds what readers would refuse.
            BusError: The session is closed, or it cannot be sent; readers may get it all the same.
        """
        ...

    def close(self) -> None:
        """Give it back. What it kept to send again is gone then."""
        ...


class Request(Protocol[M_co, R_contra]):
    """A question that waits for an answer; every one must be answered or refused, once."""

    @property
    def message(self) -> M_co:
        """The question."""
        ...

    def reply(self, message: R_contra) -> None:
        """Answer it."""
        ...

    def refuse(self, why: str) -> None:
        """Say that there will be no answer."""
        ...


class Queryable(Protocol[M_co, R_contra]):
    """Receives the questions of a topic."""

    def receive(self) -> Request[M_co, R_contra] | None:
        """The next question, or None; does not wait."""
        ...

    def close(self) -> None:
        """Give it back; open questions are refused."""
        ...


class Pending(Protocol[R_co]):
    """A question under way."""

    def poll(self) -> R_co | None:
        """The answer, or None while there is none.

        Raises:
            NoReply: There will be none.
        """
        ...


class Bus(ABC):
    """A session on the bus. A context manager: leaving closes all that it gave out."""

    def __init__(self, member: Member, clock: Clock) -> None:
        self.member, self.clock = member, clock

    @abstractmethod
    def publisher(self, topic: Topic[M], *, service: str | None = None) -> Publisher[M]:
        """A publisher of a topic; ``service`` fills its suffix where that has such a part.

        Raises:
            BusError: The member's role may not publish it, or the session is closed.
        """

    @abstractmethod
    def subscriber(self, topic: Topic[M], *, service: str | None = None, newest_only: bool = False) -> Subscriber[M]:
        """A subscriber of a topic.

        Args:
            topic: The topic.
            service: Fills its suffix where that has such a part; `EVERY_SERVICE` for all.
            newest_only: Keep only the newest message, whatever the topic's rule, and ask for no past ones; for
                readers that may not be slowed down: realtime tracking, viewers, robots.
        """

    @abstractmethod
    def queryable(self, topic: QueryTopic[M, R]) -> Queryable[M, R]:
        """What receives the questions of a topic.

        Raises:
            BusError: The member's role may not answer them.
        """

    @abstractmethod
    def ask(self, topic: QueryTopic[M, R], request: M, *, timeout_s: float) -> Pending[R]:
        """Ask, without waiting for the answer."""

    @abstractmethod
    def declare_alive(self) -> Closeable:
        """Show that this member lives, until it is closed, ends or dies."""

    @abstractmethod
    def watch_alive(self) -> AliveWatcher:
        """Who lives, from now on and already."""

    @abstractmethod
    def wait(self, timeout_s: float) -> bool:
        """Wait until something arrives at this session that had not at the last call; False if nothing did."""

    @abstractmethod
    def close(self) -> None:
        """Close the session and all it gave out; further calls do nothing."""

    @abstractmethod
    def rejections(self) -> dict[tuple[str, str], int]:
        """Refused messages of this session by (topic suffix, reason)."""

    def until(self, ready: Callable[[], T | None], *, timeout_s: float) -> T | None:
        """Wait until ``ready`` gives something; None if it does not within the time."""
        deadline_ns = self.clock.monotonic_ns() + int(timeout_s * 1e9)
        while (result := ready()) is None:
            left_s = (deadline_ns - self.clock.monotonic_ns()) * 1e-9
            if left_s <= 0:
                return None
            self.wait(left_s)
        return result

    def receive(self, subscriber: Subscriber[M], *, timeout_s: float) -> Received[M] | None:
        """The next message, waiting for it; None if none comes within the time."""
        return self.until(subscriber.receive, timeout_s=timeout_s)

    def get(self, topic: QueryTopic[M, R], request: M, *, timeout_s: float) -> R:
        """Ask and wait for the answer.

        Raises:
            NoReply: There was none within the time.
        """
        pending = self.ask(topic, request, timeout_s=timeout_s)
        reply = self.until(pending.poll, timeout_s=timeout_s)
        if reply is None:
            raise NoReply(f"{topic.suffix}: no answer within {timeout_s:g} s")
        return reply

    def check_may_publish(self, topic: Topic[M]) -> None:
        """Refuse a topic that this member's role may not publish, with BusError."""
        if self.member.role not in topic.publishers:
            raise BusError(f"{self.member.role} may not publish {topic.suffix}; {_names(topic.publishers)} may")

    def check_may_answer(self, topic: QueryTopic[M, R]) -> None:
        """Refuse a topic that this member's role may not answer, with BusError."""
        if self.member.role not in topic.answerers:
            raise BusError(f"{self.member.role} may not answer {topic.suffix}; {_names(topic.answerers)} may")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class Answer(Generic[R]):
    """How a question ended: with a reply, or with why there is none."""

    reply: R | None
    why: str = ""

    def given(self) -> R:
        """The reply; NoReply if there is none."""
        if self.reply is None:
            raise NoReply(self.why)
        return self.reply


def run_steps(service: Steps, bus: Bus) -> None:
    """Run a service to its end."""
    while (patience_s := service.step()) is not None:
        bus.wait(patience_s)


def _names(roles: frozenset[Role]) -> str:
    return ", ".join(sorted(roles))

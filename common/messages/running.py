"""Messages about the processes themselves: their state, what befell them, and what they are told to do."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, ClassVar

from vtslam.common.messages.base import Count, Message, Name, Note, OptionalId
from vtslam.common.messages.rules import MAX_INT, Choice, Integer, Real, Table

_MAX_FIGURES = 64  # counters or gauges of one service


class ServiceState(StrEnum):
    """Where a service stands."""

    STARTING = "starting"
    READY = "ready"  # waits for work
    WORKING = "working"
    DEGRADED = "degraded"  # works, but not as it should: `detail` says why
    DRAINING = "draining"  # finishes what it has
    FINISHED = "finished"  # nothing left to do


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ServiceStatus(Message):
    """A heartbeat, sent from the work loop itself: a service that hangs falls silent.

    Attributes:
        service: Its name.
        pid: Its process.
        epoch: Which start of the service it is.
        state: Where it stands.
        last_frame_id: The last frame it finished; -1 for none.
        counters: Totals since the run began.
        gauges: Present values.
        detail: What to tell the user.
    """

    KIND: ClassVar[str] = "service_status"
    VERSION: ClassVar[int] = 1

    service: Name
    pid: Count
    epoch: Count
    state: Annotated[ServiceState, Choice(ServiceState)]
    last_frame_id: OptionalId
    counters: Annotated[dict[str, int], Table(Integer(0, MAX_INT), _MAX_FIGURES)] = field(default_factory=dict)
    gauges: Annotated[dict[str, float], Table(Real(), _MAX_FIGURES)] = field(default_factory=dict)
    detail: Note = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FleetEvent(Message):
    """Something that the user should know, and that the run's catalogue keeps.

    Attributes:
        service: Who tells.
        kind: In a word, as in "restarted".
        text: In words.
        time_ns: Unix time when it happened.
    """

    KIND: ClassVar[str] = "fleet_event"
    VERSION: ClassVar[int] = 1

    service: Name
    kind: Name
    text: Note
    time_ns: Count


class Command(StrEnum):
    """What a service is told."""

    DRAIN = "drain"  # finish all frames up to `through_frame_id`, seal, then report FINISHED
    STOP = "stop"  # finish the step at hand and end


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Control(Message):
    """An order of the supervisor.

    Attributes:
        command: What to do.
        through_frame_id: Last frame to finish when draining; -1 for what has been published so far.
        epoch: Of the service it is meant for; others ignore it.
        why: For the log.
    """

    KIND: ClassVar[str] = "control"
    VERSION: ClassVar[int] = 1

    command: Annotated[Command, Choice(Command)]
    through_frame_id: OptionalId
    epoch: Count
    why: Note = ""

"""The topics of a fleet: who says what, how often, what becomes of it when a reader is slow, what is recorded.

This table is the only place that knows. Keys are ``vtslam/<fleet>/<suffix>``; a suffix may end in ``{service}``.
"""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Generic, TypeVar

from vtslam.common.messages import (
    Control,
    Credit,
    FleetEvent,
    FrameCommitted,
    FrameDescriptor,
    FramePixels,
    Message,
    Odometry,
    SectionArchived,
    SectionReply,
    SectionRequest,
    SectionSealed,
    ServiceStatus,
    TrackedPose,
)
from vtslam.common.messages.base import MAX_PIXELS

M = TypeVar("M", bound=Message)
R = TypeVar("R", bound=Message)

ROOT = "vtslam"
EVERY_SERVICE = "*"
_SERVICE = "{service}"
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")


class Role(StrEnum):
    """What a session does in a fleet; it decides which topics it may publish."""

    SUPERVISOR = "supervisor"
    SENSOR = "sensor"
    TRACKER = "tracker"
    MAPPER = "mapper"
    ARCHIVER = "archiver"
    RECORDER = "recorder"
    VIEWER = "viewer"  # shows what there is; publishes how it is, and nothing else
    REMOTE_SENSOR = "remote_sensor"  # publishes pixels, usually from another host
    OBSERVER = "observer"  # reads only: robots, `vtslam status`


SERVICES = frozenset(
    {Role.SUPERVISOR, Role.SENSOR, Role.TRACKER, Role.MAPPER, Role.ARCHIVER, Role.RECORDER, Role.VIEWER}
)


class Overflow(StrEnum):
    """What happens when a reader does not keep up."""

    LOSSLESS = "lossless"  # kept and sent again, also to late readers; beyond `history` unread it is lost and counted
    CREDIT = "credit"  # the reader grants how many may be under way; beyond `history` unread it is dropped and counted
    NEWEST = "newest"  # only the newest is kept; what it replaces is counted
    OLDEST_GOES = "oldest_goes"  # the last `history` are kept; what they push out is counted


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic(Generic[M]):
    """One row of the table.

    Attributes:
        suffix: The key below the fleet.
        message: The kind of message.
        overflow: What happens when a reader does not keep up.
        history: Messages kept unread by a reader; for lossless topics also those a publisher keeps to send again.
        rate_hz: Smallest and largest rate that is as expected while work goes on; None if there is no such thing.
        recorded: Whether the recorder keeps it.
        publishers: Roles that may publish it.
        readers_elsewhere: Roles that may read it from another host.
        max_bytes: Longest message.
    """

    suffix: str
    message: type[M]
    overflow: Overflow
    history: int
    rate_hz: tuple[float, float] | None
    recorded: bool
    publishers: frozenset[Role]
    readers_elsewhere: frozenset[Role] = frozenset()
    max_bytes: int = 8192

    def key(self, fleet: str, service: str | None = None) -> str:
        """The key in a fleet; ``service`` fills the suffix's last part, `EVERY_SERVICE` stands for all.

        Raises:
            ValueError: A name is malformed, or a service is missing or too many.
        """
        return f"{ROOT}/{checked_name(fleet)}/{self.under(service)}"

    def under(self, service: str | None = None) -> str:
        """The key below the fleet; see :meth:`key`."""
        if (_SERVICE in self.suffix) != (service is not None):
            raise ValueError(f"topic {self.suffix} with service {service!r}")
        if service is None:
            return self.suffix
        return self.suffix.replace(_SERVICE, service if service == EVERY_SERVICE else checked_name(service))


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryTopic(Generic[M, R]):
    """A question with one answer.

    Attributes:
        suffix: The key below the fleet.
        request, reply: The kinds of message.
        history: Unanswered questions kept; more are refused.
        recorded: Whether the recorder keeps it.
        answerers: Roles that may answer.
        max_bytes: Longest message.
    """

    suffix: str
    request: type[M]
    reply: type[R]
    history: int
    recorded: bool
    answerers: frozenset[Role]
    max_bytes: int = 8192

    def key(self, fleet: str) -> str:
        """The key in a fleet."""
        return f"{ROOT}/{checked_name(fleet)}/{self.suffix}"


def checked_name(name: str) -> str:
    """A name of a fleet or service, unchanged.

    Raises:
        ValueError: It is not 1 to 32 of a-z, 0-9, _ and -, beginning with a letter or digit.
    """
    if _NAME.fullmatch(name) is None:
        raise ValueError(f"a fleet's or service's name is 1 to 32 of a-z 0-9 _ -, got {name!r}")
    return name


def alive_key(fleet: str, role: str, name: str, origin: str) -> str:
    """The key of a liveliness token; ``*`` stands for any role, name or origin (one start of a member)."""
    return f"{ROOT}/{checked_name(fleet)}/alive/{role}/{name}/{origin}"


def again_key(fleet: str, origin: int) -> str:
    """The key to ask a lossless publisher at for messages once more."""
    return f"{ROOT}/{checked_name(fleet)}/again/{origin}"


def _by(*roles: Role) -> frozenset[Role]:
    return frozenset(roles)


_ELSEWHERE = _by(Role.OBSERVER, Role.REMOTE_SENSOR)

SENSOR_FRAME = Topic(
    suffix="sensor/frame",
    message=FrameDescriptor,
    overflow=Overflow.LOSSLESS,
    history=1024,
    rate_hz=(0.2, 250.0),
    recorded=True,
    publishers=_by(Role.SENSOR),
)
SENSOR_PIXELS = Topic(
    suffix="sensor/pixels",
    message=FramePixels,
    overflow=Overflow.CREDIT,
    history=8,
    rate_hz=(0.2, 250.0),
    recorded=False,  # the frames are recorded once they are in the ring
    publishers=_by(Role.REMOTE_SENSOR),
    max_bytes=MAX_PIXELS * 5 + 8192,
)
SENSOR_CREDIT = Topic(
    suffix="sensor/credit",
    message=Credit,
    overflow=Overflow.NEWEST,  # cumulative, and repeated
    history=1,
    rate_hz=(0.5, 500.0),
    recorded=False,
    publishers=_by(Role.SENSOR),
    readers_elsewhere=_by(Role.REMOTE_SENSOR),
)
TRACKER_POSE = Topic(
    suffix="tracker/pose",
    message=TrackedPose,
    overflow=Overflow.LOSSLESS,
    history=1024,
    rate_hz=(0.2, 250.0),
    recorded=True,
    publishers=_by(Role.TRACKER),
    readers_elsewhere=_ELSEWHERE,
)
TRACKER_ODOMETRY = Topic(
    suffix="tracker/odometry",
    message=Odometry,
    overflow=Overflow.NEWEST,
    history=1,
    rate_hz=(0.2, 250.0),
    recorded=True,
    publishers=_by(Role.TRACKER),
    readers_elsewhere=_ELSEWHERE,
)
MAPPER_COMMITTED = Topic(
    suffix="mapper/committed",
    message=FrameCommitted,
    overflow=Overflow.LOSSLESS,
    history=1024,
    rate_hz=(0.2, 250.0),
    recorded=True,
    publishers=_by(Role.MAPPER),
    readers_elsewhere=_ELSEWHERE,
)
SECTION_SEALED = Topic(
    suffix="section/sealed",
    message=SectionSealed,
    overflow=Overflow.LOSSLESS,
    history=256,
    rate_hz=None,
    recorded=True,
    publishers=_by(Role.MAPPER),
    readers_elsewhere=_ELSEWHERE,
)
SECTION_ARCHIVED = Topic(
    suffix="section/archived",
    message=SectionArchived,
    overflow=Overflow.LOSSLESS,
    history=256,
    rate_hz=None,
    recorded=True,
    publishers=_by(Role.ARCHIVER),
    readers_elsewhere=_ELSEWHERE,
)
STATUS = Topic(
    suffix="status/{service}",
    message=ServiceStatus,
    overflow=Overflow.OLDEST_GOES,  # several services share a reader's queue
    history=64,
    rate_hz=(0.5, 50.0),
    recorded=True,
    publishers=SERVICES,
    readers_elsewhere=_ELSEWHERE,
    max_bytes=16384,
)
FLEET_EVENT = Topic(
    suffix="fleet/event",
    message=FleetEvent,
    overflow=Overflow.LOSSLESS,
    history=256,
    rate_hz=None,
    recorded=False,
    publishers=SERVICES - {Role.VIEWER},  # it may end at any time, which concerns nobody
    readers_elsewhere=_ELSEWHERE,
)
CONTROL = Topic(
    suffix="control/{service}",
    message=Control,
    overflow=Overflow.LOSSLESS,
    history=16,
    rate_hz=None,
    recorded=True,
    publishers=_by(Role.SUPERVISOR),
)
SECTION_LOAD = QueryTopic(
    suffix="section/load",
    request=SectionRequest,
    reply=SectionReply,
    history=64,
    recorded=False,
    answerers=_by(Role.ARCHIVER),
)

TOPICS: tuple[Topic[Any], ...] = (
    SENSOR_FRAME,
    SENSOR_PIXELS,
    SENSOR_CREDIT,
    TRACKER_POSE,
    TRACKER_ODOMETRY,
    MAPPER_COMMITTED,
    SECTION_SEALED,
    SECTION_ARCHIVED,
    STATUS,
    FLEET_EVENT,
    CONTROL,
)
QUERIES: tuple[QueryTopic[Any, Any], ...] = (SECTION_LOAD,)

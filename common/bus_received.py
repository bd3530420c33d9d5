"""A message as it reaches its reader."""

from dataclasses import dataclass
from typing import Generic, TypeVar

from vtslam.common.messages import Message

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Received(Generic[M]):
    """A message that arrived.

    Attributes:
        message: The record.
        origin: Its publisher; another start of the same service is another one.
        sequence: Its number among the publisher's.
        publish_time_ns: The publisher's wall clock.
        arrival_time_ns: This session's monotonic clock.
    """

    message: M
    origin: int
    sequence: int
    publish_time_ns: int
    arrival_time_ns: int

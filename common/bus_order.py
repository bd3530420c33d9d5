"""The order of messages of a topic that loses nothing: later messages wait until what lies before them has come.

zenoh's own recovery asks once and gives up, which a busy machine or a closed session can defeat (decision record 0010).
So a reader asks the publisher itself: for what lies in a gap, for what came before the first message it saw, and, when
nothing has come for a while, whether that was the last. An answer holds only for then, so it asks again, more and more
seldom. Patience counts from a question: a reader that was busy for long has not waited.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from vtslam.common.bus_received import Received
from vtslam.common.messages import Message

M = TypeVar("M", bound=Message)

MAX_AGAIN = 64  # messages asked for at once
_ASK_EVERY_NS = 100_000_000  # while there is no progress
_QUIET_NS = 200_000_000  # then the publisher is asked whether there was more; doubled each time that there was not
_LONGEST_QUIET_NS = 10_000_000_000  # between such questions to one that answers
_GIVE_UP_NS = 5_000_000_000  # of asking without progress: the publisher is gone


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """Messages to ask a publisher for once more: from `first` to `last`, as far as there are any."""

    origin: int
    first: int
    last: int


@dataclass(slots=True, kw_only=True, eq=False)
class Arrivals(Generic[M]):
    """What has come from one publisher.

    Attributes:
        expected: The next number.
        begun: Whether that is known; else `expected` is only the smallest that it could be.
        ahead: Messages that wait for earlier ones, by number.
        complete: Whether the publisher has said that there is no more, or was asked in vain for long.
        since_ns: The last progress; or when `complete` was found.
        quiet_ns: How long after that it is asked whether there is more.
        first_asked_ns, asked_ns: When the publisher was asked first and last since then; 0 if it was not.
    """

    expected: int
    begun: bool
    ahead: dict[int, Received[M]] = field(default_factory=dict)
    complete: bool = False
    since_ns: int = 0
    quiet_ns: int = _QUIET_NS
    first_asked_ns: int = 0
    asked_ns: int = 0

    @property
    def lacks(self) -> bool:
        """Whether something may be missing."""
        return bool(self.ahead) or not self.complete

    def is_new(self, sequence: int) -> bool:
        """Whether a message has not come before."""
        return sequence >= self.expected and sequence not in self.ahead

    def take(self, received: Received[M], keep: Callable[[Received[M]], None]) -> None:
        """Take a new message, and hand over those whose turn it is."""
        if not self.ahead:
            self._progressed(received.arrival_time_ns)
        self.complete = False
        self.begun = self.begun or received.sequence == 0
        self.ahead[received.sequence] = received
        self._hand_over(received.arrival_time_ns, keep)

    def told(self, oldest: int, newest: int, now_ns: int, keep: Callable[[Received[M]], None]) -> int:
        """Take the publisher's word for what it still has; returns how many messages are gone for good."""
        missed = 0
        if not self.begun:
            self.begun, self.expected = True, max(self.expected, min([oldest, *self.ahead]))
        self._hand_over(now_ns, keep)
        for sequence in [*sorted(each for each in self.ahead if each < oldest), oldest]:
            missed += max(sequence - self.expected, 0)
            self.expected = max(sequence, self.expected)
            self._hand_over(now_ns, keep)
        if not self.ahead and newest < self.expected:
            self._rest(now_ns, min(2 * self.quiet_ns, _LONGEST_QUIET_NS))
        return missed

    def skip_gap(self, now_ns: int, keep: Callable[[Received[M]], None]) -> int:
        """Go on behind the gap; returns how many messages it lacks, as far as they were ever to come."""
        first = min(self.ahead)
        missed = first - self.expected if self.begun else 0
        self.begun, self.expected = True, first
        self._hand_over(now_ns, keep)
        return missed

    def is_hopeless(self, now_ns: int, *, room: int) -> bool:
        """Whether waiting for the gap to be filled has to end."""
        return bool(self.ahead) and (len(self.ahead) > room or self._was_asked_in_vain(now_ns))

    def to_ask_for(self, origin: int, now_ns: int) -> Gap | None:
        """What to ask for now, if anything."""
        if not self.ahead and self._was_asked_in_vain(now_ns):
            self._rest(now_ns, 2 * max(self.quiet_ns, _LONGEST_QUIET_NS))
        is_due = bool(self.ahead) or now_ns - self.since_ns >= self.quiet_ns
        if not is_due or now_ns - self.asked_ns < _ASK_EVERY_NS:
            return None
        self.complete = False
        self.asked_ns, self.first_asked_ns = now_ns, self.first_asked_ns or now_ns
        return Gap(origin=origin, first=self.expected, last=min([*self.ahead, self.expected + MAX_AGAIN]) - 1)

    def _hand_over(self, now_ns: int, keep: Callable[[Received[M]], None]) -> None:
        while self.begun and (received := self.ahead.pop(self.expected, None)) is not None:
            self.expected += 1
            self._progressed(now_ns)
            keep(received)

    def _progressed(self, now_ns: int) -> None:
        self.since_ns, self.quiet_ns, self.first_asked_ns, self.asked_ns = now_ns, _QUIET_NS, 0, 0

    def _was_asked_in_vain(self, now_ns: int) -> bool:
        return self.first_asked_ns > 0 and now_ns - self.first_asked_ns > _GIVE_UP_NS

    def _rest(self, now_ns: int, quiet_ns: int) -> None:
        """Take it that there is no more, until ``quiet_ns`` have gone by."""
        self.complete = True
        self.since_ns, self.quiet_ns, self.first_asked_ns, self.asked_ns = now_ns, quiet_ns, 0, 0

"""What has arrived at one subscriber: decoded, counted, bounded; with the three questions that a reader asks of it."""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Generic, TypeVar

from vtslam.common.bus_life import AliveWatcher
from vtslam.common.bus_order import Arrivals, Gap
from vtslam.common.bus_received import Received
from vtslam.common.messages import Message, MessageError, Reason, decode
from vtslam.common.topics import Overflow, Topic

M = TypeVar("M", bound=Message)

_MAX_ORIGINS = 256  # publishers whose sequence is followed; the ones silent longest are forgotten
_RATE_SAMPLES = 33  # arrivals that the rate is taken over


@dataclass(slots=True, kw_only=True)
class Traffic:
    """Counts of one subscriber: arrived = accepted + rejected + repeated.

    What is accepted is read, waiting, dropped, lost, or held back behind a gap.

    Attributes:
        arrived: All that came.
        accepted: Those taken.
        rejected: Those refused; by reason in `Subscriber.rejections`.
        repeated: Those that had come before.
        read: Those handed to the reader.
        dropped: Those replaced by newer ones, as the topic's rule says.
        lost: Those that found the queue full although the topic's rule keeps all.
        missed: Gaps in the publishers' numbers that were not filled.
    """

    arrived: int = 0
    accepted: int = 0
    rejected: int = 0
    repeated: int = 0
    read: int = 0
    dropped: int = 0
    lost: int = 0
    missed: int = 0

    def copy(self) -> "Traffic":
        """The counts as they are now."""
        return Traffic(**{f.name: getattr(self, f.name) for f in fields(self)})


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """Three questions, answered separately.

    Attributes:
        alive: Whether a member that may publish the topic lives.
        rate_ok: Whether messages come as often as the topic says; None if it says nothing or too few have come.
        valid: Whether the last one was accepted, and nothing was lost that should not be.
        silent_s: Seconds since the last accepted one; None if there was none.
        rate_hz: Messages per second; None if too few have come.
    """

    alive: bool
    rate_ok: bool | None
    valid: bool
    silent_s: float | None
    rate_hz: float | None


class Subscriber(Generic[M]):
    """The unread messages of one topic. Filled by the bus from any thread, read by one.

    Args:
        topic: The topic.
        newest_only: Keep only the newest.
        monotonic_ns: The clock.
        watcher: Who lives.
        notify: Called after something was accepted.
        release: Called once, on closing.
        ask_again: Asks a publisher for messages once more, without waiting for them; None where nothing gets lost on
            the way or is not asked for again.
    """

    def __init__(
        self,
        topic: Topic[M],
        *,
        newest_only: bool,
        monotonic_ns: Callable[[], int],
        watcher: AliveWatcher,
        notify: Callable[[], None],
        release: Callable[[], None],
        ask_again: Callable[[Gap], None] | None = None,
    ) -> None:
        self.topic = topic
        self._overflow = Overflow.NEWEST if newest_only else topic.overflow
        self._room = 1 if self._overflow is Overflow.NEWEST else topic.history
        self._monotonic_ns, self._watcher = monotonic_ns, watcher
        self._notify, self._release, self._ask_again = notify, release, ask_again
        self._lock = threading.Lock()
        self._unread: deque[Received[M]] = deque()
        self._publishers: OrderedDict[int, Arrivals[M]] = OrderedDict()
        self._arrivals_ns: deque[int] = deque(maxlen=_RATE_SAMPLES)
        self._traffic = Traffic()
        self._rejections: dict[str, int] = {}
        self._valid = True
        self._closed = False

    def arrived(self, data: bytes) -> None:
        """Take a message from the bus; never raises on what it holds."""
        try:
            envelope = decode(self.topic.message, data, max_bytes=self.topic.max_bytes)
        except MessageError as error:
            self.refused(error.reason)
            return
        now_ns = self._monotonic_ns()
        received = Received(
            message=envelope.message,
            origin=envelope.origin,
            sequence=envelope.sequence,
            publish_time_ns=envelope.publish_time_ns,
            arrival_time_ns=now_ns,
        )
        with self._lock:
            self._traffic.arrived += 1
            publisher = self._publisher_of(received)
            if not publisher.is_new(received.sequence):
                self._traffic.repeated += 1
                return
            self._traffic.accepted += 1
            self._arrivals_ns.append(now_ns)
            self._valid = True
            publisher.take(received, self._keep)
            if publisher.ahead and (self._ask_again is None or publisher.is_hopeless(now_ns, room=self._room)):
                self._traffic.missed += publisher.skip_gap(now_ns, self._keep)
        self._notify()

    def told(self, origin: int, oldest: int, newest: int) -> None:
        """Take a publisher's word for the numbers that it keeps and can send again."""
        with self._lock:
            publisher = self._publishers.get(origin)
            if publisher is not None and 0 <= oldest <= newest + 1:
                self._traffic.missed += publisher.told(oldest, newest, self._monotonic_ns(), self._keep)
        self._notify()

    def refused(self, reason: Reason) -> None:
        """Count a message that was not taken; also for those too long to be read at all."""
        with self._lock:
            self._traffic.arrived += 1
            self._traffic.rejected += 1
            self._rejections[reason] = self._rejections.get(reason, 0) + 1
            self._valid = False

    def receive(self) -> Received[M] | None:
        """The next message, or None; does not wait."""
        self._close_gaps()
        with self._lock:
            if not self._unread:
                return None
            self._traffic.read += 1
            return self._unread.popleft()

    @property
    def lacks(self) -> bool:
        """Whether publishers should be asked for more soon; reading does so."""
        with self._lock:
            return (
                not self._closed
                and self._ask_again is not None
                and any(each.lacks for each in self._publishers.values())
            )

    @property
    def waiting(self) -> int:
        """Unread messages."""
        with self._lock:
            return len(self._unread)

    def traffic(self) -> Traffic:
        """The counts so far."""
        with self._lock:
            return self._traffic.copy()

    def rejections(self) -> dict[str, int]:
        """Refused messages by reason."""
        with self._lock:
            return dict(self._rejections)

    def health(self) -> Health:
        """Alive, rate and validity, now."""
        now_ns = self._monotonic_ns()
        with self._lock:
            last_ns = self._arrivals_ns[-1] if self._arrivals_ns else None
            silent_s = None if last_ns is None else (now_ns - last_ns) * 1e-9
            rate_hz = self._rate_hz(now_ns)
            valid = self._valid and self._traffic.lost == 0
            if self._overflow is Overflow.LOSSLESS:
                valid = valid and self._traffic.missed == 0
        expected = self.topic.rate_hz
        rate_ok = None if expected is None or rate_hz is None else expected[0] <= rate_hz <= expected[1]
        alive = not self._watcher.roles().isdisjoint(self.topic.publishers)
        return Health(alive=alive, rate_ok=rate_ok, valid=valid, silent_s=silent_s, rate_hz=rate_hz)

    def close(self) -> None:
        """Give it back; what is unread can still be read."""
        if not self._closed:
            self._closed = True
            self._release()

    def _rate_hz(self, now_ns: int) -> float | None:
        """Over the last arrivals and the silence since, so that it falls when nothing comes any more."""
        if len(self._arrivals_ns) < 2:
            return None
        first_ns, last_ns = self._arrivals_ns[0], self._arrivals_ns[-1]
        count = len(self._arrivals_ns) - 1
        period_ns = (last_ns - first_ns) / count
        silence_ns = now_ns - last_ns
        span_ns = last_ns - first_ns + (silence_ns - period_ns if silence_ns > 2 * period_ns else 0.0)
        return count / max(span_ns * 1e-9, 1e-9)

    def _publisher_of(self, received: Received[M]) -> Arrivals[M]:
        first = 0 if self._ask_again is not None else received.sequence
        new: Arrivals[M] = Arrivals(expected=first, begun=self._ask_again is None)
        publisher = self._publishers.setdefault(received.origin, new)
        self._publishers.move_to_end(received.origin)
        if len(self._publishers) > _MAX_ORIGINS:
            self._publishers.popitem(last=False)
        return publisher

    def _close_gaps(self) -> None:
        """Ask publishers for what is missing, or go on without it when that is in vain."""
        if self._ask_again is None or self._closed:
            return
        gaps, now_ns = [], self._monotonic_ns()
        with self._lock:
            for origin, publisher in self._publishers.items():
                if publisher.is_hopeless(now_ns, room=self._room):
                    self._traffic.missed += publisher.skip_gap(now_ns, self._keep)
                elif (gap := publisher.to_ask_for(origin, now_ns)) is not None:
                    gaps.append(gap)
        for gap in gaps:
            self._ask_again(gap)

    def _keep(self, received: Received[M]) -> None:
        if len(self._unread) < self._room:
            self._unread.append(received)
        elif self._overflow in (Overflow.NEWEST, Overflow.OLDEST_GOES):
            self._unread.popleft()
            self._unread.append(received)
            self._traffic.dropped += 1
        else:
            self._traffic.lost += 1

"""What has arrived at one subscriber: decoded, counted, bounded; with the three questions that a reader asks of it."""

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Generic, TypeVar

from vtslam.common.bus_life import AliveWatcher
from vtslam.common.messages import Message, MessageError, Reason, decode
from vtslam.common.topics import Overflow, Topic

M = TypeVar("M", bound=Message)

_MAX_ORIGINS = 256  # publishers whose sequence is followed; the ones silent longest are forgotten
_RATE_SAMPLES = 33  # arrivals that the rate is taken over


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


@dataclass(slots=True, kw_only=True)
class Traffic:
    """Counts of one subscriber; arrived = accepted + rejected + repeated, accepted = read + waiting + dropped + lost.

    Attributes:
        arrived: All that came.
        accepted: Those taken.
        rejected: Those refused; by reason in `Subscriber.rejections`.
        repeated: Those that had come before.
        read: Those handed to the reader.
        dropped: Those replaced by newer ones, as the topic's rule says.
        lost: Those that found the queue full although the topic's rule keeps all.
        missed: Gaps in the publishers' numbers.
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
    ) -> None:
        self.topic = topic
        self._overflow = Overflow.NEWEST if newest_only else topic.overflow
        self._room = 1 if self._overflow is Overflow.NEWEST else topic.history
        self._monotonic_ns, self._watcher = monotonic_ns, watcher
        self._notify, self._release = notify, release
        self._lock = threading.Lock()
        self._unread: deque[Received[M]] = deque()
        self._next_sequence: OrderedDict[int, int] = OrderedDict()
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
            if not self._is_new(received):
                self._traffic.repeated += 1
                return
            self._traffic.accepted += 1
            self._arrivals_ns.append(now_ns)
            self._valid = True
            self._keep(received)
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
        with self._lock:
            if not self._unread:
                return None
            self._traffic.read += 1
            return self._unread.popleft()

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

    def _is_new(self, received: Received[M]) -> bool:
        expected = self._next_sequence.get(received.origin)
        if expected is not None and received.sequence < expected:
            return False
        if expected is not None:
            self._traffic.missed += received.sequence - expected
        self._next_sequence[received.origin] = received.sequence + 1
        self._next_sequence.move_to_end(received.origin)
        if len(self._next_sequence) > _MAX_ORIGINS:
            self._next_sequence.popitem(last=False)
        return True

    def _keep(self, received: Received[M]) -> None:
        if len(self._unread) < self._room:
            self._unread.append(received)
        elif self._overflow in (Overflow.NEWEST, Overflow.OLDEST_GOES):
            self._unread.popleft()
            self._unread.append(received)
            self._traffic.dropped += 1
        else:
            self._traffic.lost += 1

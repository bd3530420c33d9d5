"""The bus in memory: the twin of `vtslam.common.bus_zenoh` for one thread, in a `MemoryWorld`.

Messages are encoded and decoded as on the wire. As there, messages between two ends keep their order, a lossless
publisher sends its last ones again to late readers, what a dead publisher kept is gone, and what was under way arrives.
"""

import itertools
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from vtslam.common.bus import Answer, BusError, Closeable, Member
from vtslam.common.bus_inbox import Subscriber
from vtslam.common.bus_life import AliveWatcher
from vtslam.common.bus_schedule import Kills, Schedule
from vtslam.common.bus_world import Session, World
from vtslam.common.messages import Message, decode, encode
from vtslam.common.topics import EVERY_SERVICE, ROOT, Overflow, QueryTopic, Topic, alive_key

M = TypeVar("M", bound=Message)
R = TypeVar("R", bound=Message)


class Exchange:
    """What the hub knows: who publishes, reads, answers and lives."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.ids = itertools.count(1)
        self.publishers: dict[int, MemoryPublisher[Any]] = {}
        self.readers: dict[int, tuple[str, Subscriber[Any], bool]] = {}  # key, reader, whether it wants past messages
        self.queryables: dict[int, MemoryQueryable[Any, Any]] = {}
        self.tokens: dict[int, str] = {}
        self.watchers: dict[int, tuple[str, AliveWatcher]] = {}  # fleet, watcher

    def send(self, origin: int, key: str, data: bytes) -> None:
        """Put a message under way to everyone who reads its key."""
        for reader_id, (pattern, reader, _) in self.readers.items():
            if _matches(pattern, key):
                self._send_to(reader_id, reader, origin, key, data)

    def add_reader(self, key: str, reader: Subscriber[Any], *, wants_past: bool) -> int:
        """Take a reader in, and put the past messages it wants under way to it."""
        reader_id = next(self.ids)
        self.readers[reader_id] = key, reader, wants_past
        for origin, publisher in self.publishers.items() if wants_past else ():
            if _matches(key, publisher.key):
                for data in publisher.kept:
                    self._send_to(reader_id, reader, origin, publisher.key, data)
        return reader_id

    def tell_alive(self, token: int, *, alive: bool) -> None:
        """Put a token's coming or going under way to all watchers of its fleet."""
        key = self.tokens[token]
        if not alive:
            del self.tokens[token]
        for watcher_id in self.watchers:
            self._tell(watcher_id, token, key, alive=alive)

    def add_watcher(self, fleet: str, watcher: AliveWatcher) -> int:
        """Take a watcher in, and tell it who lives already."""
        watcher_id = next(self.ids)
        self.watchers[watcher_id] = fleet, watcher
        for token, key in self.tokens.items():
            self._tell(watcher_id, token, key, alive=True)
        return watcher_id

    def _send_to(self, reader_id: int, reader: Subscriber[Any], origin: int, key: str, data: bytes) -> None:
        def deliver() -> None:
            if reader_id in self.readers:
                reader.arrived(data)

        self.world.send(("message", origin, reader_id), f"{key} {origin}>{reader_id}", deliver)

    def _tell(self, watcher_id: int, token: int, key: str, *, alive: bool) -> None:
        fleet, watcher = self.watchers[watcher_id]
        if not key.startswith(f"{ROOT}/{fleet}/"):
            return

        def deliver() -> None:
            if watcher_id in self.watchers:
                watcher.changed(key, alive=alive)

        self.world.send(("life", token, watcher_id), f"{key} {alive}>{watcher_id}", deliver)


def _matches(pattern: str, key: str) -> bool:
    if not pattern.endswith("/" + EVERY_SERVICE):
        return pattern == key
    return pattern.rpartition("/")[0] == key.rpartition("/")[0]


class MemoryWorld(World):
    """A world whose members talk over the bus in memory."""

    def __init__(self, schedule: Schedule, *, kills: Kills | None = None) -> None:
        super().__init__(schedule, kills=kills)
        self._exchange = Exchange(self)

    def join(self, member: Member) -> "MemoryBus":
        """See `World`."""
        return MemoryBus(member, self, self._exchange)


class MemoryBus(Session):
    """A session in a world; made by `MemoryWorld.join`."""

    def __init__(self, member: Member, world: World, exchange: Exchange) -> None:
        super().__init__(member, world.clock)
        self._world, self._exchange = world, exchange
        self._parts: list[Closeable] = []
        self._subscribers: list[Subscriber[Any]] = []
        self._rejections: Counter[tuple[str, str]] = Counter()
        self._watcher: AliveWatcher | None = None
        self._closed = False

    def publisher(self, topic: Topic[M], *, service: str | None = None) -> "MemoryPublisher[M]":
        """See `Bus`."""
        self.check_may_publish(topic)
        self._check_open()
        publisher = MemoryPublisher(self._world, self._exchange, topic, topic.key(self.member.fleet, service))
        self._parts.append(publisher)
        return publisher

    def subscriber(self, topic: Topic[M], *, service: str | None = None, newest_only: bool = False) -> Subscriber[M]:
        """See `Bus`."""
        self._check_open()
        readers, ids = self._exchange.readers, [0]
        subscriber = Subscriber(
            topic,
            newest_only=newest_only,
            monotonic_ns=self.clock.monotonic_ns,
            watcher=self.watch_alive(),
            notify=self._notify,
            release=lambda: readers.__delitem__(ids[0]),
        )
        wants_past = topic.overflow is Overflow.LOSSLESS and not newest_only
        ids[0] = self._exchange.add_reader(topic.key(self.member.fleet, service), subscriber, wants_past=wants_past)
        self._parts.append(subscriber)
        self._subscribers.append(subscriber)
        return subscriber

    def queryable(self, topic: QueryTopic[M, R]) -> "MemoryQueryable[M, R]":
        """See `Bus`."""
        self.check_may_answer(topic)
        self._check_open()
        key = topic.key(self.member.fleet)
        queryable = MemoryQueryable(self._world, self._exchange, topic, key, self._notify)
        self._parts.append(queryable)
        return queryable

    def ask(self, topic: QueryTopic[M, R], request: M, *, timeout_s: float) -> "MemoryPending[R]":
        """See `Bus`."""
        self._check_open()
        data = encode(request, origin=0, sequence=0, publish_time_ns=self.clock.wall_ns(), max_bytes=topic.max_bytes)
        pending = MemoryPending(self._world, topic, timeout_s, self._notify)
        key = topic.key(self.member.fleet)
        answering = [queryable for queryable in self._exchange.queryables.values() if queryable.key == key]
        if answering:
            answering[0].ask(data, pending)
        else:
            pending.end(f"{topic.suffix}: nobody answered")
        return pending

    def declare_alive(self) -> Closeable:
        """See `Bus`."""
        self._check_open()
        token = _Token(self._exchange, self.member)
        self._parts.append(token)
        return token

    def watch_alive(self) -> AliveWatcher:
        """See `Bus`; one per session."""
        if self._watcher is None:
            self._check_open()
            self._watcher = AliveWatcher(self._notify)
            watcher_id = self._exchange.add_watcher(self.member.fleet, self._watcher)
            self._parts.append(_Entry(self._exchange.watchers, watcher_id))
        return self._watcher

    def wait(self, timeout_s: float) -> bool:
        """See `Bus`; lets other things happen in the world."""
        came = self._world.run(timeout_s=timeout_s, done=lambda: self.has_news)
        self.has_news = False
        return came

    def close(self) -> None:
        """See `Bus`."""
        self._closed = True
        while self._parts:
            self._parts.pop().close()

    def rejections(self) -> dict[tuple[str, str], int]:
        """See `Bus`."""
        total = Counter(self._rejections)
        for subscriber in self._subscribers:
            for reason, count in subscriber.rejections().items():
                total[subscriber.topic.suffix, reason] += count
        return dict(total)

    def _notify(self) -> None:
        self.has_news = True

    def _check_open(self) -> None:
        if self._closed:
            raise BusError(f"the session of {self.member.name} is closed")


class _Entry:
    """An entry of one of the exchange's tables."""

    def __init__(self, table: dict[int, Any], entry_id: int) -> None:
        self._table, self._id = table, entry_id

    def close(self) -> None:
        self._table.pop(self._id, None)


class _Token:
    def __init__(self, exchange: Exchange, member: Member) -> None:
        self._exchange, self._id = exchange, next(exchange.ids)
        exchange.tokens[self._id] = alive_key(member.fleet, member.role, member.name, f"{self._id}")
        exchange.tell_alive(self._id, alive=True)

    def close(self) -> None:
        if self._id in self._exchange.tokens:
            self._exchange.tell_alive(self._id, alive=False)


class MemoryPublisher(Generic[M]):
    """See `vtslam.common.bus.Publisher`; the service may die before and after a message is under way."""

    def __init__(self, world: World, exchange: Exchange, topic: Topic[M], key: str) -> None:
        self._world, self._exchange, self._topic, self.key = world, exchange, topic, key
        self._origin, self._sequence = next(exchange.ids), 0
        self._closed = False
        self.kept: deque[bytes] = deque(maxlen=topic.history if topic.overflow is Overflow.LOSSLESS else 0)
        exchange.publishers[self._origin] = self

    def publish(self, message: M) -> int:
        """See `Publisher`."""
        if self._closed:
            raise BusError(f"the publisher of {self._topic.suffix} is closed")
        data = encode(
            message,
            origin=self._origin,
            sequence=self._sequence,
            publish_time_ns=self._world.clock.wall_ns(),
            max_bytes=self._topic.max_bytes,
        )
        self._world.point(f"publish {self._topic.suffix} before")
        self._sequence += 1
        self.kept.append(data)
        self._exchange.send(self._origin, self.key, data)
        self._world.point(f"publish {self._topic.suffix} after")
        return self._sequence - 1

    def close(self) -> None:
        """See `Publisher`."""
        self._closed = True
        self._exchange.publishers.pop(self._origin, None)


class MemoryPending(Generic[R]):
    """See `vtslam.common.bus.Pending`."""

    def __init__(self, world: World, topic: QueryTopic[M, R], timeout_s: float, notify: Callable[[], None]) -> None:
        self._world, self._topic, self._notify = world, topic, notify
        self._deadline_ns = world.clock.now_ns + int(timeout_s * 1e9)
        self._answer: Answer[R] | None = None

    def poll(self) -> R | None:
        """See `Pending`."""
        if self._answer is None and self._world.clock.now_ns >= self._deadline_ns:
            self.end(f"{self._topic.suffix}: nobody answered")
        return None if self._answer is None else self._answer.given()

    def take(self, data: bytes) -> None:
        """Take the answer over."""
        if self._answer is None:
            reply = decode(self._topic.reply, data, max_bytes=self._topic.max_bytes)
            self._answer = Answer(reply.message)
            self._notify()

    def end(self, why: str) -> None:
        """There will be no answer."""
        if self._answer is None:
            self._answer = Answer(None, why)
            self._notify()


class MemoryRequest(Generic[M, R]):
    """See `vtslam.common.bus.Request`."""

    def __init__(self, world: World, topic: QueryTopic[M, R], message: M, pending: MemoryPending[R]) -> None:
        self._world, self._topic, self._message, self._pending = world, topic, message, pending

    @property
    def message(self) -> M:
        """The question."""
        return self._message

    def reply(self, message: R) -> None:
        """Answer it."""
        now_ns = self._world.clock.wall_ns()
        data = encode(message, origin=0, sequence=0, publish_time_ns=now_ns, max_bytes=self._topic.max_bytes)
        self._world.point(f"reply {self._topic.suffix} before")
        self._send("answer", lambda: self._pending.take(data))
        self._world.point(f"reply {self._topic.suffix} after")

    def refuse(self, why: str) -> None:
        """Say that there will be no answer."""
        self._send("refusal", lambda: self._pending.end(f"{self._topic.suffix}: refused: {why}"))

    def _send(self, what: str, deliver: Callable[[], None]) -> None:
        self._world.send(("answer", id(self._pending)), f"{what} {self._topic.suffix}", deliver)


class MemoryQueryable(Generic[M, R]):
    """See `vtslam.common.bus.Queryable`."""

    def __init__(
        self, world: World, exchange: Exchange, topic: QueryTopic[M, R], key: str, notify: Callable[[], None]
    ) -> None:
        self._world, self._topic, self._notify, self.key = world, topic, notify, key
        self._open: deque[MemoryRequest[M, R]] = deque()
        self._id, self._table = next(exchange.ids), exchange.queryables
        self._table[self._id] = self

    def ask(self, data: bytes, pending: MemoryPending[R]) -> None:
        """Put a question under way to it."""
        self._world.send(("question", id(pending)), f"question {self._topic.suffix}", lambda: self._take(data, pending))

    def receive(self) -> MemoryRequest[M, R] | None:
        """See `Queryable`."""
        return self._open.popleft() if self._open else None

    def close(self) -> None:
        """See `Queryable`."""
        self._table.pop(self._id, None)
        while (request := self.receive()) is not None:
            request.refuse("closed")

    def _take(self, data: bytes, pending: MemoryPending[R]) -> None:
        message = decode(self._topic.request, data, max_bytes=self._topic.max_bytes).message
        request = MemoryRequest(self._world, self._topic, message, pending)
        if self._id not in self._table:
            request.refuse("closed")
        elif len(self._open) >= self._topic.history:
            request.refuse("too many open questions")
        else:
            self._open.append(request)
            self._notify()

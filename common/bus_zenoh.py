"""The bus between processes, over zenoh: a hub on a unix socket, and sessions that connect to it and nothing else.

What zenoh sends is handed over in its own threads: they decode, count and keep, and never call back into zenoh.
"""

import json
import secrets
import threading
import time
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

import zenoh
from zenoh import ext, handlers

from vtslam.common.bus import Bus, BusError, Clock, Closeable, Member, SystemClock
from vtslam.common.bus_access import Login, NetworkAccess, own_login
from vtslam.common.bus_config import Config, hub_config, member_config
from vtslam.common.bus_inbox import Subscriber
from vtslam.common.bus_life import AliveWatcher
from vtslam.common.bus_order import Gap
from vtslam.common.bus_zenoh_again import KeptMessages, ask_for
from vtslam.common.bus_zenoh_query import ZenohPending, ZenohQueryable
from vtslam.common.messages import Message, Reason, encode
from vtslam.common.private_folder import HUB_SOCKET, check_private_folder, make_private_folder
from vtslam.common.scheduling import threads_that_answer_at_once
from vtslam.common.topics import Overflow, QueryTopic, Topic, again_key, alive_key

M = TypeVar("M", bound=Message)
R = TypeVar("R", bound=Message)

_HEARTBEAT_S = 0.1  # of lossless publishers after they published: readers learn that the last message was lost
_LACK_S = 0.1  # waiting ends after so long while something has to be asked for again
_SMALL_BYTES = 65536  # topics of longer messages do not jump the queue
_RETRY_S = 0.05


class Hub:
    """The router of a fleet, inside the supervisor. A context manager; its socket goes with it.

    Args:
        folder: The fleet's run-time folder; made for this user only.
        fleet: The fleet.
        access: How it is opened to other hosts; closed unless given.

    Raises:
        PrivateFolderError: The folder cannot be used.
        BusError: Another hub is there, or it cannot listen.
    """

    def __init__(self, folder: Path, fleet: str, access: NetworkAccess | None = None) -> None:
        make_private_folder(folder)
        self.folder, self.fleet = folder, fleet
        self._session = _opened(hub_config(folder, fleet, access))
        (folder / HUB_SOCKET).chmod(0o600)

    def bus(self, member: Member, clock: Clock | None = None) -> "ZenohBus":
        """A session within the hub itself, for the supervisor; to be closed before the hub."""
        return ZenohBus(member, self._session, clock or SystemClock(), owned=False)

    def close(self) -> None:
        """Stop routing; members reconnect by themselves if a new hub appears."""
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def join(member: Member, folder: Path, *, login: Login | None = None, timeout_s: float = 10.0) -> "ZenohBus":
    """A session of a fleet's member on the hub's host.

    Args:
        member: Who opens it.
        folder: The fleet's run-time folder.
        login: Needed where the hub has a password file; what the fleet left in its folder unless given.
        timeout_s: How long to wait for the hub.

    Raises:
        PrivateFolderError: The folder is not there, or others could have tampered with it.
        BusError: No hub took the connection within the time.
    """
    check_private_folder(folder)
    return join_by(member, member_config(folder, login or own_login(folder)), timeout_s=timeout_s)


def join_by(member: Member, config: Config, *, timeout_s: float = 10.0, clock: Clock | None = None) -> "ZenohBus":
    """A session by a configuration of `vtslam.common.bus_config`, for members on other hosts; see :func:`join`."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        try:
            return ZenohBus(member, _opened(config), clock or SystemClock(), owned=True)
        except BusError:
            if time.monotonic() >= deadline_s:
                raise
            time.sleep(_RETRY_S)


def _opened(config: Config) -> zenoh.Session:
    try:
        with threads_that_answer_at_once():  # zenoh's own, which all that is sent goes through
            return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError as error:
        places: list[str] = (config.get("connect") or config["listen"])["endpoints"]
        raise BusError(f"{config['mode']} at {', '.join(places)}: {error}") from error


class ZenohBus(Bus):
    """A session on zenoh; made by `join`, `join_by` or `Hub.bus`.

    Args:
        member: Who opens it.
        session: The zenoh session.
        clock: What time it is.
        owned: Whether closing the bus closes the session.
    """

    def __init__(self, member: Member, session: zenoh.Session, clock: Clock, *, owned: bool) -> None:
        super().__init__(member, clock)
        self._session, self._owned = session, owned
        self._arrival = threading.Condition()
        self._arrivals = self._seen = 0
        self._parts: list[Closeable] = []
        self._subscribers: list[Subscriber[Any]] = []
        self._rejections: Counter[tuple[str, str]] = Counter()
        self._watcher: AliveWatcher | None = None
        self._closed = False

    def publisher(self, topic: Topic[M], *, service: str | None = None) -> "_Publisher[M]":
        """See `Bus`."""
        self.check_may_publish(topic)
        publisher = _Publisher(self, self._open_session(), topic, topic.key(self.member.fleet, service))
        self._parts.append(publisher)
        return publisher

    def subscriber(self, topic: Topic[M], *, service: str | None = None, newest_only: bool = False) -> Subscriber[M]:
        """See `Bus`."""
        session, key = self._open_session(), topic.key(self.member.fleet, service)
        declared: list[_Declared] = []
        lossless = topic.overflow is Overflow.LOSSLESS and not newest_only

        def ask_again(gap: Gap) -> None:
            ask_for(session, again_key(self.member.fleet, gap.origin), gap, take, subscriber.told)

        subscriber = Subscriber(
            topic,
            newest_only=newest_only,
            monotonic_ns=self.clock.monotonic_ns,
            watcher=self.watch_alive(),
            notify=self.notify,
            release=lambda: declared[0].close(),
            ask_again=ask_again if lossless else None,
        )

        def take(sample: zenoh.Sample) -> None:
            if len(sample.payload) > topic.max_bytes:
                subscriber.refused(Reason.TOO_LONG)
            else:
                subscriber.arrived(bytes(sample.payload))

        handler: handlers.Callback[zenoh.Sample] = handlers.Callback(take, indirect=False)
        if lossless:
            history = ext.HistoryConfig(detect_late_publishers=True, max_samples=topic.history)
            recovery = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
            advanced = ext.declare_advanced_subscriber(session, key, handler, history=history, recovery=recovery)
            declared.append(_Declared(advanced))
        else:
            declared.append(_Declared(session.declare_subscriber(key, handler)))
        self._parts.append(subscriber)
        self._subscribers.append(subscriber)
        return subscriber

    def queryable(self, topic: QueryTopic[M, R]) -> ZenohQueryable[M, R]:
        """See `Bus`."""
        self.check_may_answer(topic)
        queryable = ZenohQueryable(
            self._open_session(),
            topic,
            key=topic.key(self.member.fleet),
            wall_ns=self.clock.wall_ns,
            notify=self.notify,
            rejected=self._count_rejected,
        )
        self._parts.append(queryable)
        return queryable

    def ask(self, topic: QueryTopic[M, R], request: M, *, timeout_s: float) -> ZenohPending[R]:
        """See `Bus`."""
        pending = ZenohPending(topic, notify=self.notify, rejected=self._count_rejected)
        data = encode(request, origin=0, sequence=0, publish_time_ns=self.clock.wall_ns(), max_bytes=topic.max_bytes)
        handler: handlers.Callback[zenoh.Reply] = handlers.Callback(pending.take, pending.end, indirect=False)
        self._open_session().get(topic.key(self.member.fleet), handler, payload=data, timeout=timeout_s)
        return pending

    def declare_alive(self) -> Closeable:
        """See `Bus`."""
        key = alive_key(self.member.fleet, self.member.role, self.member.name, secrets.token_hex(8))
        token = _Declared(self._open_session().liveliness().declare_token(key))
        self._parts.append(token)
        return token

    def watch_alive(self) -> AliveWatcher:
        """See `Bus`; one per session."""
        if self._watcher is None:
            watcher = self._watcher = AliveWatcher(self.notify)

            def take(sample: zenoh.Sample) -> None:
                watcher.changed(str(sample.key_expr), alive=sample.kind == zenoh.SampleKind.PUT)

            key = alive_key(self.member.fleet, "*", "*", "*")
            handler: handlers.Callback[zenoh.Sample] = handlers.Callback(take, indirect=False)
            self._parts.append(
                _Declared(self._open_session().liveliness().declare_subscriber(key, handler, history=True))
            )
        return self._watcher

    def wait(self, timeout_s: float) -> bool:
        """See `Bus`."""
        lacks = any(subscriber.lacks for subscriber in self._subscribers)
        with self._arrival:
            limit_s = min(timeout_s, _LACK_S) if lacks else timeout_s
            came = self._arrival.wait_for(lambda: self._arrivals != self._seen, limit_s) or limit_s < timeout_s
            self._seen = self._arrivals
            return came

    def close(self) -> None:
        """See `Bus`."""
        if self._closed:
            return
        self._closed = True
        for part in reversed(self._parts):
            part.close()
        if self._owned:
            self._session.close()

    def rejections(self) -> dict[tuple[str, str], int]:
        """See `Bus`."""
        with self._arrival:
            total = Counter(self._rejections)
        for subscriber in self._subscribers:
            for reason, count in subscriber.rejections().items():
                total[subscriber.topic.suffix, reason] += count
        return dict(total)

    def notify(self) -> None:
        """Wake `wait`."""
        with self._arrival:
            self._arrivals += 1
            self._arrival.notify_all()

    def _count_rejected(self, suffix: str, reason: Reason) -> None:
        """Count a refused question or answer."""
        with self._arrival:
            self._rejections[suffix, reason] += 1

    def _open_session(self) -> zenoh.Session:
        if self._closed:
            raise BusError(f"the session of {self.member.name} is closed")
        return self._session


class _Declared:
    """Something that only has to be undeclared."""

    def __init__(self, declared: Any) -> None:  # noqa: ANN401
        self._declared = declared

    def close(self) -> None:
        declared, self._declared = self._declared, None
        if declared is not None:
            declared.undeclare()


class _Publisher(Generic[M]):
    def __init__(self, bus: ZenohBus, session: zenoh.Session, topic: Topic[M], key: str) -> None:
        self._bus, self._topic = bus, topic
        self._origin, self._sequence = secrets.randbits(63), 0
        self._lock = threading.Lock()
        keeps = topic.overflow in (Overflow.LOSSLESS, Overflow.CREDIT)
        congestion = zenoh.CongestionControl.BLOCK if keeps else zenoh.CongestionControl.DROP
        small = topic.max_bytes <= _SMALL_BYTES
        priority = zenoh.Priority.REAL_TIME if small else zenoh.Priority.DATA
        self._kept: KeptMessages | None = None
        self._declared: ext.AdvancedPublisher | zenoh.Publisher | None
        if topic.overflow is Overflow.LOSSLESS:
            self._kept = KeptMessages(session, again_key(bus.member.fleet, self._origin), topic.history)
            replies = ext.RepliesConfig(congestion_control=congestion, priority=priority, express=small)
            self._declared = ext.declare_advanced_publisher(
                session,
                key,
                congestion_control=congestion,
                priority=priority,
                express=small,
                cache=ext.CacheConfig(topic.history, replies_config=replies),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
                publisher_detection=True,
            )
        else:
            self._declared = session.declare_publisher(
                key, congestion_control=congestion, priority=priority, express=small
            )

    def publish(self, message: M) -> int:
        with self._lock:
            if self._declared is None:
                raise BusError(f"the publisher of {self._topic.suffix} is closed")
            data = encode(
                message,
                origin=self._origin,
                sequence=self._sequence,
                publish_time_ns=self._bus.clock.wall_ns(),
                max_bytes=self._topic.max_bytes,
            )
            sequence = self._sequence
            if self._kept is not None:
                self._kept.add(sequence, data)
            # Also if sending fails: readers may ask for what is kept, and a number must not stand for two messages.
            self._sequence += 1
            try:
                self._declared.put(data)
            except zenoh.ZError as error:
                raise BusError(f"{self._topic.suffix}: {error}") from error
            return sequence

    def close(self) -> None:
        with self._lock:
            declared, self._declared = self._declared, None
        if self._kept is not None:
            self._kept.close()
        _Declared(declared).close()

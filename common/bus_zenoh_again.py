"""Messages asked for once more over zenoh: what a lossless publisher keeps, and how a reader asks for it."""

import struct
import threading
from collections import deque
from collections.abc import Callable

import zenoh
from zenoh import handlers

from vtslam.common.bus_order import MAX_AGAIN, Gap

_RANGE = struct.Struct("<qq")  # first and last number that is asked for, or that there is
_TIMEOUT_S = 2.0


class KeptMessages:
    """The last messages of one publisher, sent again to readers that ask for them."""

    def __init__(self, session: zenoh.Session, key: str, history: int) -> None:
        self._key = key
        self._lock = threading.Lock()
        self._kept: deque[tuple[int, bytes]] = deque(maxlen=history)
        handler: handlers.Callback[zenoh.Query] = handlers.Callback(self._answer, indirect=False)
        self._declared: zenoh.Queryable[None] | None = session.declare_queryable(self._key, handler)

    def add(self, sequence: int, data: bytes) -> None:
        """Keep a message; the oldest goes."""
        with self._lock:
            self._kept.append((sequence, data))

    def close(self) -> None:
        """Forget all."""
        declared, self._declared = self._declared, None
        if declared is not None:
            declared.undeclare()

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            payload = b"" if query.payload is None or len(query.payload) > _RANGE.size else bytes(query.payload)
            if len(payload) != _RANGE.size:
                return
            first, last = _RANGE.unpack(payload)
            with self._lock:
                wanted = [data for sequence, data in self._kept if first <= sequence <= last]
                oldest, newest = (self._kept[0][0], self._kept[-1][0]) if self._kept else (0, -1)
            for data in wanted[:MAX_AGAIN]:
                query.reply(self._key, data)
            query.reply(self._key, _RANGE.pack(oldest, newest))


def ask_for(
    session: zenoh.Session,
    key: str,
    gap: Gap,
    take: Callable[[zenoh.Sample], None],
    told: Callable[[int, int, int], None],
) -> None:
    """Ask a publisher for what lies in a gap, without waiting.

    Args:
        session: The reader's session.
        key: The publisher's `again_key`.
        gap: What to ask for.
        take: Takes each message as it comes.
        told: Takes the origin, and the oldest and newest number that the publisher has, after the messages.
    """

    def answered(reply: zenoh.Reply) -> None:
        if reply.ok is None:
            return
        if len(reply.ok.payload) == _RANGE.size:  # no message is so short
            told(gap.origin, *_RANGE.unpack(bytes(reply.ok.payload)))
        else:
            take(reply.ok)

    handler: handlers.Callback[zenoh.Reply] = handlers.Callback(answered, indirect=False)
    session.get(
        key,
        handler,
        payload=_RANGE.pack(gap.first, gap.last),
        timeout=_TIMEOUT_S,
        # Of one priority with the messages, or the answers would fall behind those.
        priority=zenoh.Priority.REAL_TIME,
        congestion_control=zenoh.CongestionControl.BLOCK,
        consolidation=zenoh.ConsolidationMode.NONE,
    )

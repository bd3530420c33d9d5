"""Questions and answers over zenoh; see `vtslam.common.bus_zenoh`."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

import zenoh
from zenoh import handlers

from vtslam.common.bus import Answer
from vtslam.common.messages import Message, MessageError, Reason, decode, encode
from vtslam.common.topics import QueryTopic

M = TypeVar("M", bound=Message)
R = TypeVar("R", bound=Message)

_Rejected = Callable[[str, Reason], None]
_MAX_REFUSAL = 256  # bytes of a refusal that are shown


def _accepted(kind: type[M], payload: zenoh.ZBytes | None, max_bytes: int) -> M:
    """The message of a payload; MessageError if it is refused."""
    if payload is not None and len(payload) > max_bytes:
        raise MessageError(Reason.TOO_LONG, "", expected=f"at most {max_bytes} bytes", found=str(len(payload)))
    return decode(kind, b"" if payload is None else bytes(payload), max_bytes=max_bytes).message


class ZenohRequest(Generic[M, R]):
    """A question; see `vtslam.common.bus.Request`."""

    def __init__(self, message: M, query: zenoh.Query, key: str, encoded: Callable[[R], bytes]) -> None:
        self._message, self._query, self._key, self._encoded = message, query, key, encoded

    @property
    def message(self) -> M:
        """The question."""
        return self._message

    def reply(self, message: R) -> None:
        """Answer it."""
        data = self._encoded(message)
        with self._query:
            self._query.reply(self._key, data)

    def refuse(self, why: str) -> None:
        """Say that there will be no answer."""
        with self._query:
            self._query.reply_err(why)


class ZenohQueryable(Generic[M, R]):
    """Receives the questions of a topic; see `vtslam.common.bus.Queryable`."""

    def __init__(
        self,
        session: zenoh.Session,
        topic: QueryTopic[M, R],
        *,
        key: str,
        wall_ns: Callable[[], int],
        notify: Callable[[], None],
        rejected: _Rejected,
    ) -> None:
        self._topic, self._key = topic, key
        self._wall_ns, self._notify, self._rejected = wall_ns, notify, rejected
        self._lock = threading.Lock()
        self._open: deque[ZenohRequest[M, R]] = deque()
        handler: handlers.Callback[zenoh.Query] = handlers.Callback(self._take, indirect=False)
        self._declared: zenoh.Queryable[None] | None = session.declare_queryable(key, handler)

    def receive(self) -> ZenohRequest[M, R] | None:
        """The next question, or None; does not wait."""
        with self._lock:
            return self._open.popleft() if self._open else None

    def close(self) -> None:
        """Give it back; open questions are refused."""
        declared, self._declared = self._declared, None
        if declared is not None:
            declared.undeclare()
        while (request := self.receive()) is not None:
            request.refuse("closed")

    def _take(self, query: zenoh.Query) -> None:
        try:
            message = _accepted(self._topic.request, query.payload, self._topic.max_bytes)
        except MessageError as error:
            self._rejected(self._topic.suffix, error.reason)
            with query:
                query.reply_err(str(error))
            return
        request: ZenohRequest[M, R] = ZenohRequest(message, query, self._key, self._encoded)
        with self._lock:
            room = len(self._open) < self._topic.history
            if room:
                self._open.append(request)
        if not room:
            request.refuse("too many open questions")
        self._notify()

    def _encoded(self, message: R) -> bytes:
        return encode(message, origin=0, sequence=0, publish_time_ns=self._wall_ns(), max_bytes=self._topic.max_bytes)


class ZenohPending(Generic[R]):
    """A question under way; see `vtslam.common.bus.Pending`."""

    def __init__(self, topic: QueryTopic[M, R], *, notify: Callable[[], None], rejected: _Rejected) -> None:
        self._kind, self._suffix, self._max_bytes = topic.reply, topic.suffix, topic.max_bytes
        self._notify, self._rejected = notify, rejected
        self._answer: Answer[R] | None = None
        self._why = f"{topic.suffix}: nobody answered"

    def poll(self) -> R | None:
        """The answer, or None while there is none."""
        return None if self._answer is None else self._answer.given()

    def take(self, reply: zenoh.Reply) -> None:
        """Take an answer over from zenoh; the first that is accepted counts."""
        if reply.ok is None:
            if reply.err is not None:
                text = bytes(reply.err.payload)[:_MAX_REFUSAL].decode(errors="replace")
                self._why = f"{self._suffix}: refused: {text}"
            return
        try:
            message = _accepted(self._kind, reply.ok.payload, self._max_bytes)
        except MessageError as error:
            self._rejected(self._suffix, error.reason)
            self._why = f"{self._suffix}: the answer was not accepted: {error}"
            return
        if self._answer is None:
            self._answer = Answer(message)
            self._notify()

    def end(self) -> None:
        """There will be no more answers."""
        if self._answer is None:
            self._answer = Answer(None, self._why)
        self._notify()

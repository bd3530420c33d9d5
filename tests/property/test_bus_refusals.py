"""Random and mutated messages on every topic of a real bus: none crashes a reader, every refused one is counted."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

import msgpack  # type: ignore[import-untyped]
import numpy as np
import pytest
import zenoh
from helpers.bus_backends import ZenohBackend, zenoh_backend
from helpers.bus_messages import MAX_BYTES, RANDOM

from vtslam.common.bus import Bus, Queryable
from vtslam.common.bus_inbox import Subscriber
from vtslam.common.messages import Message, MessageError, SectionRequest, decode, encode
from vtslam.common.topics import EVERY_SERVICE, QUERIES, SECTION_LOAD, TOPICS, QueryTopic, Role, Topic

SEED = 20_26
MESSAGES = 20_000
IN_FLIGHT = 100
LOST_AFTER_S = 5.0
PATIENCE_S = 60.0
FEW_BYTES = 4096  # of a made-up message; pixels are small here as well

ODD_VALUES: tuple[Any, ...] = (
    None, True, -1, 2**63, 2**64 - 1, -(2**63), 0.5, float("nan"), float("inf"), "", "x" * 300, "\x00", "../..", b"",
    b"raw", [], [0.0] * 16, [float("nan")] * 36, [[[[]]]], {}, {"a": {"b": 1}}, {1: 2}, msgpack.ExtType(5, b"x"),
)  # fmt: skip


@pytest.fixture
def backend() -> Iterator[ZenohBackend]:
    with zenoh_backend() as opened:
        yield opened


def _flipped(rng: np.random.Generator, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        changed[int(rng.integers(len(changed)))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _cut(rng: np.random.Generator, data: bytes) -> bytes:
    return data[: int(rng.integers(len(data)))]


def _grown(rng: np.random.Generator, data: bytes) -> bytes:
    return data + rng.bytes(int(rng.integers(1, 64)))


def _spliced(rng: np.random.Generator, data: bytes) -> bytes:
    start, end = sorted(int(x) for x in rng.integers(0, len(data), 2))
    return data[:start] + rng.bytes(int(rng.integers(0, 32))) + data[end:]


def _noise(rng: np.random.Generator, data: bytes) -> bytes:
    return rng.bytes(int(rng.integers(0, FEW_BYTES)))


def _odd_field(rng: np.random.Generator, data: bytes) -> bytes:
    """One value anywhere in the envelope replaced by one of another type, shape or range."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(data)
    envelope = unpacker.unpack()
    holder: Any = envelope
    while True:
        places = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        place = places[int(rng.integers(len(places)))]
        if not isinstance(holder[place], dict | list) or not holder[place] or rng.random() < 0.2:
            break
        holder = holder[place]
    holder[place] = ODD_VALUES[int(rng.integers(len(ODD_VALUES)))]
    packed: bytes = msgpack.packb(envelope)
    return packed + data[unpacker.tell() :]


def _too_long(rng: np.random.Generator, data: bytes) -> bytes:
    return data + bytes(20_000)


MUTATIONS = (_flipped, _cut, _grown, _spliced, _noise, _odd_field, _odd_field, _odd_field, _too_long)


def _good(rng: np.random.Generator, kind: type[Message], number: int) -> bytes:
    return encode(RANDOM[kind](rng), origin=number, sequence=0, publish_time_ns=1, max_bytes=MAX_BYTES)


def _mutated(rng: np.random.Generator, kind: type[Message], number: int) -> bytes:
    wrong = rng.random() < 0.1
    data = _good(rng, list(RANDOM)[int(rng.integers(len(RANDOM)))] if wrong else kind, number)
    if rng.random() < 0.1:
        return data
    return MUTATIONS[int(rng.integers(len(MUTATIONS)))](rng, data)


def _wait_for_all(reader: Bus, subscribers: dict[str, Subscriber[Any]], sent: Counter[str], lost: Counter[str]) -> None:
    """Wait until all that was sent has arrived; what has not after a while is lost."""

    def missing() -> Counter[str]:
        return Counter({suffix: sent[suffix] - each.traffic().arrived for suffix, each in subscribers.items()})

    if not reader.until(lambda: missing() == lost or None, timeout_s=LOST_AFTER_S):
        lost.update(missing() - lost)


def _verdict(kind: type[Message], data: bytes, max_bytes: int) -> str:
    """The reason of refusal, or nothing; anything else that is raised fails the test."""
    try:
        decode(kind, data, max_bytes=max_bytes)
    except MessageError as error:
        return error.reason.value
    return ""


def _key(topic: Topic[Any], service: str) -> str:
    return topic.key("test", service if "{" in topic.suffix else None)


def _raw_session(bus: Bus) -> zenoh.Session:
    """The zenoh session below a bus: what a faulty or hostile program would send with."""
    session = bus._session  # type: ignore[attr-defined]
    assert isinstance(session, zenoh.Session)
    return session


def test_every_refused_message_is_counted_on_every_topic(backend: ZenohBackend) -> None:
    print(f"seed {SEED}")
    rng = np.random.default_rng(SEED)
    reader, writer = backend.join(Role.OBSERVER), _raw_session(backend.join(Role.OBSERVER, "hostile"))
    subscribers = {
        topic.suffix: reader.subscriber(topic, service=EVERY_SERVICE if "{" in topic.suffix else None)
        for topic in TOPICS
    }
    publishers = {
        topic.suffix: writer.declare_publisher(_key(topic, "mapper"), congestion_control=zenoh.CongestionControl.BLOCK)
        for topic in TOPICS
    }
    assert reader.until(lambda: all(p.matching_status for p in publishers.values()) or None, timeout_s=PATIENCE_S)
    expected: Counter[tuple[str, str]] = Counter()
    sent: Counter[str] = Counter()
    lost: Counter[str] = Counter()
    for number in range(MESSAGES):
        topic = TOPICS[number % len(TOPICS)]
        data = _mutated(rng, topic.message, number)
        sent[topic.suffix] += 1
        expected[topic.suffix, _verdict(topic.message, data, topic.max_bytes)] += 1
        publishers[topic.suffix].put(data)
        if number % IN_FLIGHT == IN_FLIGHT - 1:
            _wait_for_all(reader, subscribers, sent, lost)
    _wait_for_all(reader, subscribers, sent, lost)
    # Zenoh itself drops a message now and then on a busy machine. What did arrive is accounted for, to the last one.
    assert lost.total() <= MESSAGES // 1000
    refused = Counter({key: count for key, count in expected.items() if key[1]})
    counted = reader.rejections()
    assert set(counted) <= set(refused)
    for suffix, subscriber in subscribers.items():
        traffic = subscriber.traffic()
        missing = {key: refused[key] - counted.get(key, 0) for key in refused if key[0] == suffix}
        missing[suffix, ""] = expected[suffix, ""] - traffic.accepted - traffic.repeated
        assert min(missing.values()) >= 0
        assert sum(missing.values()) == lost[suffix]
        assert traffic.arrived == sent[suffix] - lost[suffix]
        assert traffic.rejected == sum(count for key, count in counted.items() if key[0] == suffix)
    assert sum(refused.values()) > MESSAGES // 2
    assert len({reason for _, reason in refused}) >= 7
    for publisher in publishers.values():
        publisher.undeclare()


def _wait_for_a_question(answerer: Bus, queryable: Queryable[Any, Any], querier: zenoh.Querier, request: bytes) -> None:
    """Ask until it arrives: on a busy machine the way may be known to the asker before the hub goes it."""
    for _ in range(int(PATIENCE_S)):
        answers = querier.get(payload=request)
        while (question := answerer.until(queryable.receive, timeout_s=1.0)) is not None:
            question.refuse("a test")  # this one, or one before it that came late
            if any(reply.err is not None for reply in answers):
                return
    raise AssertionError("no question arrived")


@pytest.mark.parametrize("query", QUERIES, ids=lambda query: query.suffix)
def test_refused_questions_and_answers_are_counted(backend: ZenohBackend, query: QueryTopic[Any, Any]) -> None:
    print(f"seed {SEED}")
    rng = np.random.default_rng(SEED)
    answerer = backend.join(min(query.answerers))
    writer = _raw_session(backend.join(Role.OBSERVER, "hostile"))
    queryable = answerer.queryable(query)
    querier = writer.declare_querier(
        query.key("test"), timeout=PATIENCE_S, congestion_control=zenoh.CongestionControl.BLOCK
    )
    assert answerer.until(lambda: querier.matching_status or None, timeout_s=PATIENCE_S)
    _wait_for_a_question(answerer, queryable, querier, _good(np.random.default_rng(SEED), query.request, 0))
    refusals = 0
    expected: Counter[tuple[str, str]] = Counter()
    for number in range(1000):
        data = _mutated(rng, query.request, number)
        verdict = _verdict(query.request, data, query.max_bytes)
        expected[query.suffix, verdict] += 1
        if verdict:
            # A reply may be lost on a busy machine; the asker then gets none, which it must bear with anyway.
            refusals += sum(reply.err is not None for reply in querier.get(payload=data))
            key, count = (query.suffix, verdict), expected[query.suffix, verdict]
            counted = answerer.until(lambda: answerer.rejections().get(key) == count or None, timeout_s=PATIENCE_S)  # noqa: B023
            assert counted, f"question {number}, {verdict}, was not counted"
        else:
            replies = querier.get(payload=data)
            question = answerer.until(queryable.receive, timeout_s=PATIENCE_S)
            assert question is not None
            question.refuse("a test")
            assert len(list(replies)) <= 1
    refused = {key: count for key, count in expected.items() if key[1]}
    assert answerer.rejections() == refused
    assert 0.95 * sum(refused.values()) <= refusals <= sum(refused.values())
    querier.undeclare()


def test_a_refused_answer_is_no_answer_and_counted(backend: ZenohBackend) -> None:
    tracker, writer = backend.join(Role.TRACKER), _raw_session(backend.join(Role.OBSERVER, "hostile"))

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(SECTION_LOAD.key("test"), b"\xc1")

    handler: zenoh.handlers.Callback[zenoh.Query] = zenoh.handlers.Callback(answer, indirect=False)
    request = SectionRequest(section_id=1, reader="tracker")

    def ended() -> str | None:
        tracker.ask(SECTION_LOAD, request, timeout_s=1.0)
        tracker.wait(0.2)
        return "refused" if tracker.rejections() else None

    for _ in range(12):  # on a busy machine the hub may not go the way to one that was just declared
        declared = writer.declare_queryable(SECTION_LOAD.key("test"), handler)
        if tracker.until(ended, timeout_s=PATIENCE_S / 12):
            break
        declared.undeclare()
    assert set(tracker.rejections()) == {("section/load", "not_msgpack")}
    declared.undeclare()

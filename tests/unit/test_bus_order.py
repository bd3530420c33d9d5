"""Messages of one publisher are handed over in order, whatever is lost, late or repeated on the way."""

from collections.abc import Callable

import numpy as np
import pytest
import zenoh
from helpers.bus_backends import zenoh_backend
from helpers.bus_messages import descriptor

from vtslam.common.bus import BusError
from vtslam.common.bus_inbox import Subscriber
from vtslam.common.bus_life import AliveWatcher
from vtslam.common.bus_order import MAX_AGAIN, Arrivals, Gap
from vtslam.common.bus_received import Received
from vtslam.common.messages import FrameDescriptor, encode
from vtslam.common.topics import SENSOR_FRAME, Role

SECOND_NS = 1_000_000_000


class _Reader:
    """Arrivals with what they handed over."""

    def __init__(self, *, begun: bool = False) -> None:
        self.arrivals: Arrivals[FrameDescriptor] = Arrivals(expected=0, begun=begun)
        self.read: list[int] = []
        self.keep: Callable[[Received[FrameDescriptor]], None] = lambda received: self.read.append(received.sequence)

    def take(self, *sequences: int, at_s: float = 0.0) -> None:
        for sequence in sequences:
            if self.arrivals.is_new(sequence):
                received = Received(
                    message=descriptor(sequence),
                    origin=1,
                    sequence=sequence,
                    publish_time_ns=0,
                    arrival_time_ns=int(at_s * SECOND_NS),
                )
                self.arrivals.take(received, self.keep)

    def told(self, oldest: int, newest: int, *, at_s: float = 0.0) -> int:
        return self.arrivals.told(oldest, newest, int(at_s * SECOND_NS), self.keep)

    def first_question_s(self, from_s: float, to_s: float) -> float | None:
        """When it asks, looked at every 50 ms."""
        times = (from_s + 0.05 * step for step in range(round((to_s - from_s) / 0.05)))
        return next((time_s for time_s in times if self.asked(time_s) is not None), None)

    def asked(self, at_s: float) -> tuple[int, int] | None:
        gap = self.arrivals.to_ask_for(1, int(at_s * SECOND_NS))
        return None if gap is None else (gap.first, gap.last)


def test_what_lies_behind_a_gap_waits_until_it_is_filled() -> None:
    reader = _Reader()
    reader.take(0, 1, 4, 5, 4)
    assert reader.read == [0, 1]
    assert reader.asked(1.0) == (2, 3)
    assert reader.asked(1.05) is None
    assert reader.asked(1.2) == (2, 3)
    reader.take(3, 2, 2, 0)
    assert reader.read == [0, 1, 2, 3, 4, 5]


def test_a_late_reader_begins_with_what_the_publisher_still_has() -> None:
    reader = _Reader()
    reader.take(120, 121)
    assert reader.read == []
    assert reader.asked(1.0) == (0, MAX_AGAIN - 1)
    assert reader.told(100, 121) == 0  # what is older is no loss to it
    assert reader.read == []
    reader.take(*range(100, 120))
    assert reader.read == list(range(100, 122))


def test_a_late_reader_that_gets_no_word_begins_with_the_first_it_saw() -> None:
    reader = _Reader()
    reader.take(120, 121)
    assert reader.arrivals.skip_gap(SECOND_NS, reader.keep) == 0
    assert reader.read == [120, 121]


def test_what_the_publisher_no_longer_has_is_counted() -> None:
    reader = _Reader()
    reader.take(0, 3, 7)
    assert reader.told(5, 7) == 3  # 1, 2 and 4
    assert reader.read == [0, 3]
    reader.take(5, 6)
    assert reader.read == [0, 3, 5, 6, 7]


def test_a_distant_claim_costs_nothing() -> None:
    reader = _Reader()
    reader.take(0, 2)
    assert reader.told(2**62, 2**62) == 2**62 - 2
    assert reader.read == [0, 2]


def test_after_a_quiet_moment_the_publisher_is_asked_for_more() -> None:
    reader = _Reader()
    reader.take(0)
    assert reader.asked(0.1) is None
    assert reader.asked(0.3) == (1, MAX_AGAIN)
    assert reader.told(0, 1) == 0
    assert reader.arrivals.lacks
    reader.take(1, at_s=0.4)
    assert reader.asked(0.7) == (2, MAX_AGAIN + 1)
    assert reader.told(0, 1, at_s=0.7) == 0
    assert not reader.arrivals.lacks
    assert reader.asked(1.0) is None


def test_an_answer_does_not_hold_for_ever() -> None:
    reader, now_s, pauses_s = _Reader(), 0.0, []
    reader.take(0)
    for _ in range(9):
        asked_s = reader.first_question_s(now_s, now_s + 30.0)
        assert asked_s is not None
        pauses_s.append(round(asked_s - now_s, 2))
        now_s = asked_s
        reader.told(0, 0, at_s=now_s)
    assert pauses_s == [0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 10.0, 10.0, 10.0]
    reader.told(0, 1, at_s=now_s)  # another one, which got lost
    assert reader.asked(now_s + 10.0) == (1, MAX_AGAIN)
    reader.take(1, at_s=now_s + 10.0)
    assert reader.asked(now_s + 10.2) == (2, MAX_AGAIN + 1)


def test_whoever_was_busy_for_long_asks_before_it_gives_up() -> None:
    reader = _Reader()
    reader.take(0)
    assert reader.asked(60.0) == (1, MAX_AGAIN)
    assert reader.arrivals.lacks
    with_gap = _Reader()
    with_gap.take(0, 2)
    assert not with_gap.arrivals.is_hopeless(60 * SECOND_NS, room=8)
    assert with_gap.asked(60.0) == (1, 1)
    assert not with_gap.arrivals.is_hopeless(64 * SECOND_NS, room=8)
    assert with_gap.arrivals.is_hopeless(66 * SECOND_NS, room=8)


def test_a_gap_has_its_own_patience() -> None:
    reader = _Reader()
    reader.take(0)
    assert reader.asked(1.0) == (1, MAX_AGAIN)
    reader.take(2, at_s=5.9)
    assert not reader.arrivals.is_hopeless(7 * SECOND_NS, room=8)
    assert reader.asked(7.0) == (1, 1)


def test_a_publisher_that_is_gone_is_not_waited_for() -> None:
    reader = _Reader()
    reader.take(0, 2)
    assert reader.asked(1.0) == (1, 1)
    assert not reader.arrivals.is_hopeless(5 * SECOND_NS, room=8)
    assert reader.arrivals.is_hopeless(7 * SECOND_NS, room=8)
    assert reader.arrivals.is_hopeless(SECOND_NS, room=0)
    assert reader.arrivals.skip_gap(7 * SECOND_NS, reader.keep) == 1
    assert reader.read == [0, 2]
    assert reader.asked(8.0) == (3, MAX_AGAIN + 2)
    assert reader.arrivals.lacks
    assert reader.asked(13.1) is None
    assert not reader.arrivals.lacks
    assert reader.first_question_s(13.2, 60.0) == pytest.approx(33.1, abs=0.06)  # it may have been busy


@pytest.mark.parametrize("seed", range(50))
def test_random_losses_are_made_good_as_long_as_the_publisher_has_them(seed: int) -> None:
    rng, reader, count = np.random.default_rng(seed), _Reader(), 200
    for sequence in range(count):
        if rng.random() < 0.7:
            reader.take(sequence)
    now_s = 1.0
    while reader.arrivals.lacks and reader.read != list(range(count)):
        now_s += 0.3
        gap = reader.asked(now_s)
        if gap is None:
            break
        reader.take(*(each for each in range(gap[0], gap[1] + 1) if each < count and rng.random() < 0.7), at_s=now_s)
        if rng.random() < 0.7:
            assert reader.told(0, count - 1) == 0
    assert reader.read == list(range(count))


def test_messages_that_never_reached_the_bus_arrive_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, count = np.random.default_rng(5), 300

    class Lossy:
        """Loses a third, among them the first and the last."""

        def __init__(self, declared: object) -> None:
            self._declared, self._number = declared, 0

        def put(self, data: bytes) -> None:
            self._number += 1
            if self._number not in (1, count) and rng.random() > 0.33:
                self._declared.put(data)  # type: ignore[attr-defined]

        def undeclare(self) -> None:
            self._declared.undeclare()  # type: ignore[attr-defined]

    with zenoh_backend() as backend:
        sensor, tracker = backend.join(Role.SENSOR), backend.join(Role.TRACKER)
        subscriber, publisher = tracker.subscriber(SENSOR_FRAME), sensor.publisher(SENSOR_FRAME)
        monkeypatch.setattr(publisher, "_declared", Lossy(publisher._declared))  # type: ignore[attr-defined]
        for frame_id in range(count):
            publisher.publish(descriptor(frame_id))
        received = (tracker.receive(subscriber, timeout_s=60.0) for _ in range(count))
        assert [each.message.frame_id for each in received if each] == list(range(count))
        assert subscriber.traffic().missed == 0
        assert subscriber.health().valid


def test_what_is_left_after_closing_is_read_without_asking_anybody() -> None:
    now_ns = [0]
    asked: list[Gap] = []
    subscriber = Subscriber(
        SENSOR_FRAME,
        newest_only=False,
        monotonic_ns=lambda: now_ns[0],
        watcher=AliveWatcher(lambda: None),
        notify=lambda: None,
        release=lambda: None,
        ask_again=asked.append,
    )
    for sequence in (0, 2):
        message = descriptor(sequence)
        subscriber.arrived(encode(message, origin=1, sequence=sequence, publish_time_ns=0, max_bytes=8192))
    now_ns[0] = SECOND_NS
    assert subscriber.lacks
    subscriber.close()
    first = subscriber.receive()
    assert first is not None
    assert first.sequence == 0
    assert subscriber.receive() is None
    assert not subscriber.lacks
    assert asked == []


def test_a_message_that_could_not_be_sent_keeps_its_number() -> None:
    class Broken:
        def put(self, data: bytes) -> None:
            raise zenoh.ZError("no")

    with zenoh_backend() as backend:
        sensor, tracker = backend.join(Role.SENSOR), backend.join(Role.TRACKER)
        frames, publisher = tracker.subscriber(SENSOR_FRAME), sensor.publisher(SENSOR_FRAME)
        assert publisher.publish(descriptor(0)) == 0
        whole = publisher._declared  # type: ignore[attr-defined]
        publisher._declared = Broken()  # type: ignore[attr-defined]
        with pytest.raises(BusError, match="sensor/frame: no"):
            publisher.publish(descriptor(1))
        publisher._declared = whole  # type: ignore[attr-defined]
        assert publisher.publish(descriptor(2)) == 2
        read = [tracker.receive(frames, timeout_s=30.0) for _ in range(3)]
        assert [each.message.frame_id for each in read if each is not None] == [0, 1, 2]

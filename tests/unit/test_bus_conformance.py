"""What services rely on, held against the bus between processes and its twin in memory alike."""

from collections.abc import Callable, Iterator

import pytest
from helpers.bus_backends import Backend, MemoryBackend, keep_trying, zenoh_backend
from helpers.bus_messages import descriptor, status

from vtslam.common.bus import Bus, BusError, NoReply, Pending, Queryable, Request
from vtslam.common.bus_inbox import Subscriber
from vtslam.common.messages import (
    Command,
    Control,
    Credit,
    FrameDescriptor,
    LoadOutcome,
    MessageError,
    SectionReply,
    SectionRequest,
)
from vtslam.common.topics import (
    CONTROL,
    EVERY_SERVICE,
    SECTION_LOAD,
    SENSOR_CREDIT,
    SENSOR_FRAME,
    STATUS,
    TRACKER_POSE,
    Role,
)

PATIENCE_S = 30.0


@pytest.fixture(params=["memory", "zenoh"])
def backend(request: pytest.FixtureRequest) -> Iterator[Backend]:
    if request.param == "memory":
        yield MemoryBackend()
    else:
        with zenoh_backend() as opened:
            yield opened


def _credit(limit: int) -> Credit:
    return Credit(acknowledged_frame_id=-1, next_frame_id=0, limit_frame_id=limit, epoch=1)


def _read(bus: Bus, subscriber: Subscriber[FrameDescriptor], count: int) -> list[int]:
    received = (bus.receive(subscriber, timeout_s=PATIENCE_S) for _ in range(count))
    return [each.message.frame_id for each in received if each is not None]


def _wait(bus: Bus, condition: Callable[[], bool]) -> None:
    assert bus.until(lambda: condition() or None, timeout_s=PATIENCE_S)


def _asked(
    tracker: Bus, mapper: Bus, queryable: Queryable[SectionRequest, SectionReply], request: SectionRequest
) -> tuple[Pending[SectionReply], Request[SectionRequest, SectionReply]]:
    """A question that has arrived; asked again as long as the queryable is not known everywhere."""
    for _ in range(100):
        pending = tracker.ask(SECTION_LOAD, request, timeout_s=PATIENCE_S)
        question = mapper.until(queryable.receive, timeout_s=0.2)
        if question is not None:
            assert question.message.section_id == request.section_id
            return pending, question
    raise AssertionError("no question arrived")


class TestBus:
    def test_a_burst_on_a_lossless_topic_arrives_whole_and_in_order(self, backend: Backend) -> None:
        sensor, tracker, mapper = (backend.join(role) for role in (Role.SENSOR, Role.TRACKER, Role.MAPPER))
        readers = [(bus, bus.subscriber(SENSOR_FRAME)) for bus in (tracker, mapper)]
        publisher = sensor.publisher(SENSOR_FRAME)
        count = SENSOR_FRAME.history
        assert [publisher.publish(descriptor(i)) for i in range(count)] == list(range(count))
        for bus, subscriber in readers:
            assert _read(bus, subscriber, count) == list(range(count))
            traffic = subscriber.traffic()
            assert (traffic.accepted, traffic.lost, traffic.missed) == (count, 0, 0)

    def test_a_late_reader_of_a_lossless_topic_gets_the_past_first(self, backend: Backend) -> None:
        publisher = backend.join(Role.SENSOR).publisher(SENSOR_FRAME)
        for i in range(20):
            publisher.publish(descriptor(i))
        tracker = backend.join(Role.TRACKER)
        subscriber = tracker.subscriber(SENSOR_FRAME)
        assert _read(tracker, subscriber, 20) == list(range(20))
        publisher.publish(descriptor(20))
        assert _read(tracker, subscriber, 1) == [20]

    def test_what_a_reader_leaves_unread_beyond_the_history_is_counted_as_lost(self, backend: Backend) -> None:
        supervisor, tracker = backend.join(Role.SUPERVISOR), backend.join(Role.TRACKER)
        subscriber = tracker.subscriber(CONTROL, service="tracker")
        publisher = supervisor.publisher(CONTROL, service="tracker")
        publisher.publish(Control(command=Command.DRAIN, through_frame_id=0, epoch=1))
        _wait(tracker, lambda: subscriber.traffic().accepted == 1)  # from here on the reader is known
        for i in range(1, CONTROL.history + 3):
            publisher.publish(Control(command=Command.DRAIN, through_frame_id=i, epoch=1))
        _wait(tracker, lambda: subscriber.traffic().accepted == CONTROL.history + 3)
        assert subscriber.traffic().lost == 3
        assert subscriber.waiting == CONTROL.history
        assert not subscriber.health().valid

    def test_newest_only_keeps_the_newest_and_counts_the_others(self, backend: Backend) -> None:
        sensor, observer = backend.join(Role.SENSOR), backend.join(Role.OBSERVER)
        frames, out = observer.subscriber(SENSOR_FRAME, newest_only=True), sensor.publisher(SENSOR_FRAME)

        def heard_one() -> bool:
            out.publish(descriptor(0))
            return frames.receive() is not None

        def newest() -> bool:
            assert frames.waiting <= 1
            received = frames.receive()
            return received is not None and received.message.frame_id == 49

        assert keep_trying(observer, heard_one)
        before = frames.traffic().accepted
        for i in range(50):
            out.publish(descriptor(i))
        _wait(observer, lambda: frames.traffic().accepted >= before + 20)
        assert keep_trying(observer, newest)
        traffic = frames.traffic()
        assert traffic.missed == frames.waiting == 0
        assert traffic.accepted - traffic.read == traffic.dropped >= 19

    def test_what_may_be_lost_on_the_way_arrives_when_it_is_repeated(self, backend: Backend) -> None:
        sensor, observer = backend.join(Role.SENSOR), backend.join(Role.OBSERVER)
        credits, out = observer.subscriber(SENSOR_CREDIT), sensor.publisher(SENSOR_CREDIT)
        for i in range(50):
            out.publish(_credit(i))

        def newest() -> bool:
            out.publish(_credit(50))
            assert credits.waiting <= 1
            received = credits.receive()
            return received is not None and received.message.limit_frame_id == 50

        assert keep_trying(observer, newest)
        traffic = credits.traffic()
        assert traffic.accepted == traffic.read + traffic.dropped + credits.waiting

    def test_a_reader_chooses_one_service_or_all(self, backend: Backend) -> None:
        tracker, mapper, supervisor = (backend.join(r) for r in (Role.TRACKER, Role.MAPPER, Role.SUPERVISOR))
        everyone = supervisor.subscriber(STATUS, service=EVERY_SERVICE)
        one = supervisor.subscriber(STATUS, service="mapper")
        tracker_status = tracker.publisher(STATUS, service="tracker")
        mapper_status = mapper.publisher(STATUS, service="mapper")

        def heard() -> bool:
            tracker_status.publish(status("tracker"))
            mapper_status.publish(status("mapper"))
            return one.waiting >= 2 and everyone.waiting >= 6

        assert keep_trying(supervisor, heard)
        services = set()
        while (received := everyone.receive()) is not None:
            services.add(received.message.service)
        assert services == {"tracker", "mapper"}
        while (received := one.receive()) is not None:
            assert received.message.service == "mapper"

    def test_a_role_publishes_only_its_own_topics(self, backend: Backend) -> None:
        with pytest.raises(BusError, match="sensor may not publish tracker/pose; tracker may"):
            backend.join(Role.SENSOR).publisher(TRACKER_POSE)
        with pytest.raises(BusError, match="observer may not answer section/load"):
            backend.join(Role.OBSERVER).queryable(SECTION_LOAD)

    def test_a_refused_message_takes_no_number(self, backend: Backend) -> None:
        publisher = backend.join(Role.SENSOR).publisher(SENSOR_FRAME)
        with pytest.raises(MessageError, match="epoch"):
            publisher.publish(descriptor(0, epoch=-1))
        assert publisher.publish(descriptor(0)) == 0

    def test_questions_are_answered_refused_or_time_out(self, backend: Backend) -> None:
        tracker, mapper = backend.join(Role.TRACKER), backend.join(Role.ARCHIVER)
        request = SectionRequest(section_id=4, reader="tracker")
        with pytest.raises(NoReply, match="section/load"):
            tracker.get(SECTION_LOAD, request, timeout_s=0.2)
        queryable = mapper.queryable(SECTION_LOAD)
        pending, question = _asked(tracker, mapper, queryable, request)
        question.reply(SectionReply(section_id=4, outcome=LoadOutcome.RESIDENT, block="section-000004", generation=9))
        reply = tracker.until(pending.poll, timeout_s=PATIENCE_S)
        assert reply is not None
        assert (reply.section_id, reply.block, reply.generation) == (4, "section-000004", 9)
        pending, question = _asked(tracker, mapper, queryable, request)
        question.refuse("not today")
        with pytest.raises(NoReply, match="refused: not today"):
            tracker.until(pending.poll, timeout_s=PATIENCE_S)
        with pytest.raises(NoReply, match="section/load"):
            tracker.get(SECTION_LOAD, request, timeout_s=0.2)

    def test_open_questions_end_when_the_answering_side_closes(self, backend: Backend) -> None:
        tracker, mapper = backend.join(Role.TRACKER), backend.join(Role.ARCHIVER)
        queryable = mapper.queryable(SECTION_LOAD)
        request = SectionRequest(section_id=4, reader="tracker")
        for _ in range(100):
            pending = tracker.ask(SECTION_LOAD, request, timeout_s=PATIENCE_S)
            if mapper.wait(0.2):
                break
        queryable.close()
        with pytest.raises(NoReply):
            tracker.until(pending.poll, timeout_s=PATIENCE_S)

    def test_who_lives_is_known_to_early_and_late_watchers(self, backend: Backend) -> None:
        supervisor, tracker = backend.join(Role.SUPERVISOR), backend.join(Role.TRACKER, "tracker-1")
        early = supervisor.watch_alive()
        token = tracker.declare_alive()
        came = supervisor.until(early.receive, timeout_s=PATIENCE_S)
        assert came is not None
        assert (came.role, came.name, came.alive) == (Role.TRACKER, "tracker-1", True)
        observer = backend.join(Role.OBSERVER)
        late = observer.watch_alive()
        _wait(observer, lambda: late.names() == {"tracker-1"})
        token.close()
        gone = supervisor.until(early.receive, timeout_s=PATIENCE_S)
        assert gone is not None
        assert (gone.origin, gone.alive) == (came.origin, False)
        _wait(observer, lambda: not late.roles())

    def test_closing_a_session_ends_its_life_and_its_publishers(self, backend: Backend) -> None:
        supervisor, sensor = backend.join(Role.SUPERVISOR), backend.join(Role.SENSOR)
        watcher = supervisor.watch_alive()
        publisher = sensor.publisher(SENSOR_FRAME)
        sensor.declare_alive()
        _wait(supervisor, lambda: watcher.roles() == {Role.SENSOR})
        sensor.close()
        sensor.close()
        _wait(supervisor, lambda: not watcher.roles())
        with pytest.raises(BusError):
            publisher.publish(descriptor(0))
        with pytest.raises(BusError):
            sensor.subscriber(SENSOR_FRAME)

    def test_alive_rate_and_validity_are_separate(self, backend: Backend) -> None:
        sensor, tracker = backend.join(Role.SENSOR), backend.join(Role.TRACKER)
        subscriber = tracker.subscriber(SENSOR_FRAME)
        health = subscriber.health()
        assert (health.alive, health.rate_ok, health.valid, health.silent_s) == (False, None, True, None)
        sensor.declare_alive()
        _wait(tracker, lambda: subscriber.health().alive)
        assert subscriber.health().rate_ok is None
        publisher = sensor.publisher(SENSOR_FRAME)
        for i in range(2):
            publisher.publish(descriptor(i))
        assert _read(tracker, subscriber, 2) == [0, 1]
        assert subscriber.health().rate_hz is not None
        assert subscriber.health().valid
        sensor.close()
        _wait(tracker, lambda: not subscriber.health().alive)
        assert subscriber.health().valid

    def test_waiting_ends_when_nothing_comes(self, backend: Backend) -> None:
        bus = backend.join(Role.OBSERVER)
        subscriber = bus.subscriber(SENSOR_FRAME)
        while bus.wait(0.2):
            pass
        start_ns = bus.clock.monotonic_ns()
        assert bus.receive(subscriber, timeout_s=0.05) is None
        assert bus.clock.monotonic_ns() - start_ns >= 50_000_000

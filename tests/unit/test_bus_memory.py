"""The bus in memory: equal seeds give equal courses, schedules can be tried out one by one, services die anywhere."""

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from helpers.bus_messages import descriptor, status

from vtslam.common.bus import Bus, BusError, Member, Steps
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import (
    KillAt,
    Kills,
    Schedule,
    ScriptedSchedule,
    SeededKills,
    SeededSchedule,
    try_schedules,
)
from vtslam.common.messages import LoadOutcome, SectionReply, SectionRequest, ServiceStatus
from vtslam.common.topics import SECTION_LOAD, SENSOR_FRAME, STATUS, Role

FRAMES, WINDOW = 6, 2
TIMEOUT_S = 600.0  # simulated


def _member(role: Role, name: str = "") -> Member:
    return Member(fleet="test", role=role, name=name)


@dataclass
class Store:
    """What survives a death: the frames committed, in order."""

    frames: list[int] = field(default_factory=list)


class Sender:
    """Sends frames, a window at a time, and again what is not committed after a while."""

    def __init__(self, bus: Bus, store: Store) -> None:
        self._store = store
        self._out = bus.publisher(SENSOR_FRAME)
        self._committed = bus.subscriber(STATUS, service="mapper")
        self._sent = len(store.frames)
        self._clock, self._last_ns = bus.clock, bus.clock.monotonic_ns()

    def step(self) -> float | None:
        while self._committed.receive() is not None:
            self._last_ns = self._clock.monotonic_ns()
        done = len(self._store.frames)
        if done == FRAMES:
            return None
        if self._clock.monotonic_ns() - self._last_ns >= 1_000_000_000:
            self._sent, self._last_ns = done, self._clock.monotonic_ns()
        while self._sent < min(done + WINDOW, FRAMES):
            self._out.publish(descriptor(self._sent))
            self._sent += 1
        return 0.5


class Keeper:
    """Commits each frame once; a ``forgetful`` one knows only from its own memory what it has committed."""

    def __init__(self, bus: Bus, store: Store, point: Callable[[str], None], *, forgetful: bool = False) -> None:
        self._store, self._point, self._forgetful = store, point, forgetful
        self._remembered = 0
        self._frames = bus.subscriber(SENSOR_FRAME)
        self._out = bus.publisher(STATUS, service="mapper")

    def step(self) -> float | None:
        while (received := self._frames.receive()) is not None:
            frame_id = received.message.frame_id
            self._point("commit before")
            if frame_id == (self._remembered if self._forgetful else len(self._store.frames)):
                self._store.frames.append(frame_id)
                self._remembered += 1
            self._point("commit after")
            self._out.publish(status("mapper", last_frame_id=len(self._store.frames) - 1))
        return 1.0


def _run(schedule: Schedule, kills: Kills | None = None, *, forgetful: bool = False) -> tuple[MemoryWorld, Store]:
    store, world = Store(), MemoryWorld(schedule, kills=kills)

    def keeper(bus: Bus) -> Steps:
        return Keeper(bus, store, world.point, forgetful=forgetful)

    world.add_service(_member(Role.SENSOR), lambda bus: Sender(bus, store))
    world.add_service(_member(Role.MAPPER), keeper)
    assert world.run(timeout_s=TIMEOUT_S, done=lambda: len(store.frames) >= FRAMES) or forgetful
    world.close()
    return world, store


def test_equal_seeds_give_equal_courses_and_others_differ() -> None:
    courses = [_run(SeededSchedule(seed), SeededKills(seed, probability=0.1, limit=3))[0] for seed in (1, 1, 2)]
    assert courses[0].course == courses[1].course
    assert courses[0].deaths == courses[1].deaths
    assert courses[0].course != courses[2].course


def test_a_death_at_any_point_loses_and_repeats_nothing() -> None:
    calm, _ = _run(ScriptedSchedule())
    passages = {name: sum(who == name for who, _ in calm.passed) for name in ("sensor", "mapper")}
    assert min(passages.values()) >= 2 * FRAMES
    points = set()
    for name, count in passages.items():
        for passage in range(count):
            world, store = _run(ScriptedSchedule(), KillAt(name, passage))
            assert store.frames == list(range(FRAMES)), (name, passage)
            assert len(world.deaths) == 1
            points |= set(world.deaths)
    assert points == {
        ("sensor", "publish sensor/frame before"),
        ("sensor", "publish sensor/frame after"),
        ("mapper", "commit before"),
        ("mapper", "commit after"),
        ("mapper", "publish status/{service} before"),
        ("mapper", "publish status/{service} after"),
    }


def test_random_courses_with_random_deaths_lose_and_repeat_nothing() -> None:
    deaths = 0
    for seed in range(150):
        world, store = _run(SeededSchedule(seed), SeededKills(seed + 1000, probability=0.05, limit=4))
        assert store.frames == list(range(FRAMES)), f"seed {seed}"
        deaths += len(world.deaths)
    assert deaths > 100


def test_the_search_finds_a_service_that_forgets() -> None:
    def broken(seed: int) -> bool:
        _, store = _run(SeededSchedule(seed), SeededKills(seed, probability=0.2, limit=4), forgetful=True)
        return store.frames != list(range(FRAMES))

    assert any(broken(seed) for seed in range(100))


def test_all_orders_of_two_senders_are_tried() -> None:
    orders = []

    def run(schedule: Schedule) -> None:
        world = MemoryWorld(schedule)
        reader = world.join(_member(Role.OBSERVER))
        heard = reader.subscriber(STATUS, service="*")
        for name in ("one", "two"):
            out = world.join(_member(Role.TRACKER, name)).publisher(STATUS, service=name)
            for i in range(2):
                out.publish(status(name, last_frame_id=i))
        assert world.run(timeout_s=1.0, done=lambda: heard.waiting == 4)
        order = []
        while (received := heard.receive()) is not None:
            order.append((received.message.service, received.message.last_frame_id))
        orders.append(tuple(order))

    assert try_schedules(run, limit=1000) == (6, True)
    assert len(set(orders)) == 6
    for order in orders:
        assert [i for name, i in order if name == "one"] == [0, 1]
    assert try_schedules(run, limit=3) == (3, False)


def test_a_step_may_wait_for_an_answer_while_the_others_go_on() -> None:
    class Asking:
        def __init__(self, bus: Bus) -> None:
            self._bus = bus
            self.reply: SectionReply | None = None

        def step(self) -> float | None:
            request = SectionRequest(section_id=3, reader="tracker")
            self.reply = self._bus.get(SECTION_LOAD, request, timeout_s=5.0)
            return None

    class Answering:
        def __init__(self, bus: Bus) -> None:
            self._questions = bus.queryable(SECTION_LOAD)

        def step(self) -> float | None:
            while (question := self._questions.receive()) is not None:
                section_id = question.message.section_id
                question.reply(
                    SectionReply(section_id=section_id, outcome=LoadOutcome.UNKNOWN, block=None, generation=0)
                )
            return 1.0

    for seed in range(20):
        world = MemoryWorld(SeededSchedule(seed))
        asking: list[Asking] = []

        def start(bus: Bus, made: list[Asking] = asking) -> Steps:
            made.append(Asking(bus))
            return made[-1]

        world.add_service(_member(Role.ARCHIVER), Answering)
        assert world.run(timeout_s=1.0, done=lambda w=world: "step archiver" in w.course)  # type: ignore[misc]
        world.add_service(_member(Role.TRACKER), start)
        assert world.run(timeout_s=10.0, done=lambda made=asking: bool(made and made[0].reply))  # type: ignore[misc]
        assert asking[0].reply is not None
        assert asking[0].reply.outcome is LoadOutcome.UNKNOWN


def test_the_clock_goes_on_only_when_nothing_can_happen() -> None:
    class Beating:
        def __init__(self, bus: Bus) -> None:
            self._out, self._left = bus.publisher(STATUS, service="mapper"), 60

        def step(self) -> float | None:
            self._out.publish(status("mapper"))
            self._left -= 1
            return 10.0 if self._left else None

    world = MemoryWorld(SeededSchedule(0))
    reader = world.join(_member(Role.OBSERVER))
    heard = reader.subscriber(STATUS, service="mapper")
    start_ns = world.clock.monotonic_ns()
    world.add_service(_member(Role.MAPPER), Beating)
    assert world.run(timeout_s=10_000.0)
    assert world.clock.monotonic_ns() - start_ns == pytest.approx(590e9, rel=1e-3)
    rate = heard.health().rate_hz
    assert rate == pytest.approx(0.1, rel=1e-3)
    assert heard.health().rate_ok is False  # too seldom for a heartbeat
    while reader.wait(1000.0):
        pass
    falling = heard.health().rate_hz
    assert falling is not None
    assert rate is not None
    assert falling < rate / 2


def test_a_course_without_end_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Restless:
        def step(self) -> float | None:
            return 0.0

    monkeypatch.setattr("vtslam.common.bus_world._MAX_EVENTS", 100)
    world = MemoryWorld(SeededSchedule(0))
    world.add_service(_member(Role.MAPPER), lambda bus: Restless())
    with pytest.raises(BusError, match="no end after 100 events"):
        world.run(timeout_s=10.0)


def test_a_repeated_number_is_taken_once_and_a_gap_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    world = MemoryWorld(ScriptedSchedule())
    reader = world.join(_member(Role.OBSERVER))
    heard = reader.subscriber(STATUS, service="mapper")
    sent: list[bytes] = []
    out = world.join(_member(Role.MAPPER)).publisher(STATUS, service="mapper")
    spy = world.join(_member(Role.RECORDER)).subscriber(STATUS, service="mapper")
    monkeypatch.setattr(spy, "arrived", sent.append)
    for i in range(4):
        out.publish(status("mapper", last_frame_id=i))
    assert world.run(timeout_s=1.0, done=lambda: len(sent) == 4 and heard.waiting == 4)
    fresh = world.join(_member(Role.OBSERVER, "fresh")).subscriber(STATUS, service="mapper")
    for number in (0, 1, 1, 0, 3):
        fresh.arrived(sent[number])
    traffic = fresh.traffic()
    assert (traffic.arrived, traffic.accepted, traffic.repeated, traffic.missed) == (5, 3, 2, 1)
    read: list[ServiceStatus] = []
    while (received := fresh.receive()) is not None:
        read.append(received.message)
    assert [each.last_frame_id for each in read] == [0, 1, 3]

"""The bus between processes: fleets do not see each other, strangers see nothing, deaths are noticed."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from helpers.bus_backends import keep_trying, short_folder
from helpers.bus_messages import descriptor, status
from helpers.processes import source_environment

from vtslam.common.bus import Bus, Member
from vtslam.common.bus_zenoh import Hub, join
from vtslam.common.topics import SENSOR_FRAME, STATUS, Role

PATIENCE_S = 60.0
ROUNDS = 20

# A program with zenoh's own defaults: finds peers by multicast, listens on TCP, reads and writes everything it can.
STRANGER = """
import json, sys, zenoh
from zenoh import handlers

heard = []
with zenoh.open(zenoh.Config()) as session:
    take = handlers.Callback(lambda sample: heard.append(str(sample.key_expr)), indirect=False)
    for pattern in ("**", "**/@adv/**", "@/**"):
        session.declare_subscriber(pattern, take)
        session.liveliness().declare_subscriber(pattern, take, history=True)
    print("ready", flush=True)
    for line in sys.stdin:
        for fleet in ("one", "two"):
            session.put(f"vtslam/{fleet}/sensor/frame", b"forged")
            session.put(f"vtslam/{fleet}/status/sensor", b"forged")
        print(json.dumps([key for key in heard if key.startswith("vtslam/")]), flush=True)
"""

MEMBER = """
import sys
from pathlib import Path
from vtslam.common.bus import Member
from vtslam.common.bus_zenoh import join
from vtslam.common.topics import SENSOR_FRAME, STATUS, Role

bus = join(Member(fleet="test", role=Role.TRACKER), Path(sys.argv[1]))
bus.subscriber(SENSOR_FRAME), bus.subscriber(STATUS, service="*"), bus.publisher(STATUS, service="tracker")
bus.declare_alive()
print("ready", flush=True)
if sys.argv[2] == "stay":
    sys.stdin.read()
"""

READER = """
import json, sys
from pathlib import Path
from vtslam.common.bus import Member
from vtslam.common.bus_zenoh import join
from vtslam.common.topics import SENSOR_FRAME, Role

with join(Member(fleet="test", role=Role.TRACKER), Path(sys.argv[1])) as bus:
    frames = bus.subscriber(SENSOR_FRAME)
    bus.declare_alive()
    print("ready", flush=True)
    received = (bus.receive(frames, timeout_s=60.0) for _ in range(int(sys.argv[2])))
    print(json.dumps([str(each and each.message.frame_id) for each in received]), flush=True)
"""


@contextmanager
def _process(code: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=source_environment(),
    )
    assert process.stdout is not None
    assert process.stdin is not None
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()


@contextmanager
def _stranger() -> Iterator[subprocess.Popen[str]]:
    """The program above; removes what zenoh by default leaves in /dev/shm when a program ends."""
    left: list[Path] = []
    with _process(STRANGER) as process:
        for row in Path(f"/proc/{process.pid}/maps").read_text().splitlines():
            path = Path(row.split(maxsplit=5)[-1])
            if path.parent == Path("/dev/shm") and path.suffix == ".zenoh":
                left.append(path)
        yield process
    for path in left:
        path.unlink(missing_ok=True)


@pytest.fixture
def folder() -> Iterator[Path]:
    with short_folder() as base:
        yield base


def _ask(process: subprocess.Popen[str]) -> list[str]:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("go\n")
    process.stdin.flush()
    return _line(process)


def _line(process: subprocess.Popen[str]) -> list[str]:
    assert process.stdout is not None
    answer = json.loads(process.stdout.readline())
    assert isinstance(answer, list)
    return answer


class _Fleet:
    """A sensor and a reader with a hub of their own."""

    def __init__(self, stack: ExitStack, base: Path, name: str) -> None:
        stack.enter_context(Hub(base / name, name))
        self.reader: Bus = stack.enter_context(join(Member(fleet=name, role=Role.OBSERVER), base / name))
        sensor = stack.enter_context(join(Member(fleet=name, role=Role.SENSOR, name=f"sensor-{name}"), base / name))
        self.frames = self.reader.subscriber(SENSOR_FRAME)
        self.beats = self.reader.subscriber(STATUS, service="*")
        self.watcher = self.reader.watch_alive()
        self._frame_out, self._beat_out = sensor.publisher(SENSOR_FRAME), sensor.publisher(STATUS, service="sensor")
        sensor.declare_alive()
        self.sent, self._name = 0, name

    def publish(self) -> None:
        self._frame_out.publish(descriptor(self.sent))
        self._beat_out.publish(status(f"sensor-{self._name}"))
        self.sent += 1

    def check_untouched(self) -> None:
        assert self.reader.rejections() == {}
        assert self.frames.traffic().arrived == self.sent
        assert self.watcher.names() == {f"sensor-{self._name}"}
        while (beat := self.beats.receive()) is not None:
            assert beat.message.service == f"sensor-{self._name}"


def test_two_fleets_and_a_stranger_see_nothing_of_each_other(folder: Path) -> None:
    with ExitStack() as stack:
        fleets = [_Fleet(stack, folder, name) for name in ("one", "two")]
        stranger = stack.enter_context(_stranger())
        heard: list[str] = []
        for _ in range(ROUNDS):
            for fleet in fleets:
                fleet.publish()
                assert keep_trying(fleet.reader, lambda f=fleet: f.frames.traffic().arrived == f.sent)  # type: ignore[misc]
            heard = _ask(stranger)
        # The stranger hears itself, four messages a round, and no one else.
        assert heard == [
            f"vtslam/{fleet}/{topic}"
            for _ in range(ROUNDS)
            for fleet in ("one", "two")
            for topic in ("sensor/frame", "status/sensor")
        ]
        for fleet in fleets:
            fleet.check_untouched()


def _network_sockets() -> set[str]:
    """Inodes of this process's TCP and UDP sockets."""
    mine = set()
    for entry in Path("/proc/self/fd").iterdir():
        try:
            target = os.readlink(entry)
        except FileNotFoundError:
            continue
        if target.startswith("socket:["):
            mine.add(target[8:-1])
    network = set()
    for table in ("tcp", "tcp6", "udp", "udp6"):
        rows = Path(f"/proc/net/{table}").read_text().splitlines()[1:]
        network |= {row.split()[9] for row in rows}
    return mine & network


def test_a_fleet_opens_no_network_socket_and_no_shared_memory(folder: Path) -> None:
    before, shared = _network_sockets(), set(os.listdir("/dev/shm"))
    with ExitStack() as stack:
        fleet = _Fleet(stack, folder, "one")
        fleet.publish()
        assert keep_trying(fleet.reader, lambda: fleet.frames.traffic().arrived == 1)
        assert _network_sockets() == before
        assert not {name for name in set(os.listdir("/dev/shm")) - shared if name.endswith(".zenoh")}


def test_a_killed_member_is_noticed(folder: Path) -> None:
    with Hub(folder / "run", "test") as hub, hub.bus(Member(fleet="test", role=Role.SUPERVISOR)) as supervisor:
        watcher = supervisor.watch_alive()
        with _process(MEMBER, str(folder / "run"), "stay") as member:
            assert keep_trying(supervisor, lambda: watcher.names() == {"tracker"})
            member.send_signal(signal.SIGKILL)
            assert keep_trying(supervisor, lambda: not watcher.names())
        changes = []
        while (change := watcher.receive()) is not None:
            changes.append(change.alive)
        assert changes == [True, False]


def test_a_reader_that_was_stopped_for_long_gets_all_it_missed(folder: Path) -> None:
    count = 300
    with Hub(folder / "run", "test") as hub, hub.bus(Member(fleet="test", role=Role.SUPERVISOR)) as supervisor:
        watcher = supervisor.watch_alive()
        with (
            join(Member(fleet="test", role=Role.SENSOR), folder / "run") as sensor,
            _process(READER, str(folder / "run"), str(count)) as reader,
        ):
            publisher = sensor.publisher(SENSOR_FRAME)
            assert keep_trying(supervisor, lambda: watcher.names() == {"tracker"})
            reader.send_signal(signal.SIGSTOP)
            for frame_id in range(count - 1):
                publisher.publish(descriptor(frame_id))
            assert keep_trying(supervisor, lambda: not watcher.names())  # taken for dead: its session was closed
            reader.send_signal(signal.SIGCONT)
            assert keep_trying(supervisor, lambda: watcher.names() == {"tracker"})
            publisher.publish(descriptor(count - 1))
            assert _line(reader) == [str(frame_id) for frame_id in range(count)]


def test_a_process_that_does_not_close_its_session_still_ends(folder: Path) -> None:
    with Hub(folder / "run", "test"), _process(MEMBER, str(folder / "run"), "go") as member:
        assert member.wait(PATIENCE_S) == 0


def test_the_supervisors_own_session_reaches_the_members(folder: Path) -> None:
    with (
        Hub(folder / "run", "test") as hub,
        hub.bus(Member(fleet="test", role=Role.SUPERVISOR)) as supervisor,
        join(Member(fleet="test", role=Role.MAPPER), folder / "run") as mapper,
    ):
        heard = supervisor.subscriber(STATUS, service="mapper")
        out = mapper.publisher(STATUS, service="mapper")

        def beat() -> bool:
            out.publish(status("mapper"))
            return heard.traffic().accepted > 0

        assert keep_trying(supervisor, beat)

"""What a supervisor makes of its processes, in simulated time and without any process."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.fake_processes import FakePopen, fake_processes
from helpers.fleet_world import RUN_INFO
from helpers.shm_sections import frame_of

from vtslam.common.bus import Bus, Member, Publisher
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import ScriptedSchedule
from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.messages import ServiceState, ServiceStatus
from vtslam.common.shm.frame_ring import FrameRingReader, FrameRingWriter
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.ring_layout import RingSpec
from vtslam.common.topics import STATUS, Role
from vtslam.services.frame_journal import JournalReader
from vtslam.services.pacing import Pacing
from vtslam.services.supervisor.errors import FleetError
from vtslam.services.supervisor.processes import PROCESSES, RECORDER
from vtslam.services.supervisor.progress import FleetProgress
from vtslam.services.supervisor.supervisor import Supervisor
from vtslam.storage.run_folder import RunFolder

HANG_S = 50.0


class Fleet:
    """A supervisor with processes that say what they are told to say, each twice a second."""

    def __init__(self, tmp_path: Path, *, pacing: Pacing = Pacing.LOCKSTEP) -> None:
        self.world = MemoryWorld(ScriptedSchedule())
        self.folder = FleetFolder.create("test", base=tmp_path)
        self.processes = (*PROCESSES, RECORDER)
        self.states = {process.name: ServiceState.READY for process in self.processes}
        self.events: list[str] = []
        self.run = RunFolder.create(tmp_path / "run", RUN_INFO)
        self.progress = FleetProgress(
            self.run.catalog,
            JournalReader(self.folder.journal_path),
            MapStore(self.folder.map_path, budget_bytes=1 << 20),
            lambda facts: None,
        )
        for process in self.processes:
            self.folder.reserve_last_words(process.name)
        self.bus: Bus = self.world.join(Member(fleet="test", role=Role.SUPERVISOR))
        self.supervisor = Supervisor(
            self.bus,
            fleet="test",
            folder=self.folder,
            progress=self.progress,
            hang_s=HANG_S,
            processes=self.processes,
            pacing=pacing,
            on_event=self.events.append,
        )
        self._statuses = {process.name: self._joined(process.role) for process in self.processes}

    def _joined(self, role: Role) -> Publisher[ServiceStatus]:
        bus = self.world.join(Member(fleet="test", role=role))
        bus.declare_alive()
        return bus.publisher(STATUS, service=role.value)

    def live(self, seconds: float) -> None:
        """Let time go by."""
        for _ in range(round(2 * seconds)):
            for name, state in self.states.items():
                child = self.supervisor.children[name]
                if child.pid is not None:
                    self._statuses[name].publish(
                        ServiceStatus(service=name, pid=1, epoch=child.epoch, state=state, last_frame_id=-1)
                    )
            self.world.run(timeout_s=0.5, done=lambda: False)
            self.supervisor.step()

    def end(self, name: str, code: int = 0) -> None:
        """Let a process end, which says that it has come to its end if the code is 0."""
        process, child = self.supervisor.children[name]._popen, self.supervisor.children[name]
        assert isinstance(process, FakePopen)
        if code == 0:
            self.folder.write_counts(name, child.epoch, {})
        process.code = code

    @property
    def epochs(self) -> dict[str, int]:
        """How often each was started."""
        return {name: child.epoch for name, child in self.supervisor.children.items()}

    def close(self) -> None:
        self.supervisor.kill_all()
        self.world.close()
        self.run.close()


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    with fake_processes():
        fleet = Fleet(tmp_path)
        yield fleet
        fleet.close()


def with_a_frame(fleet: Fleet) -> None:
    ring = FrameRingWriter.create(fleet.folder.ring_path, RingSpec(width=16, height=12))
    ring.publish_newest(frame_of(0))


def test_a_recorder_that_dies_while_the_rest_is_stored_is_started_again_and_told_to_end_again(fleet: Fleet) -> None:
    fleet.live(1.0)
    for name in ("sensor", "mapper", "tracker"):
        fleet.end(name)
        fleet.live(0.5)
    fleet.end("archiver")
    fleet.live(0.5)
    recorder = fleet.supervisor.children["recorder"]
    assert recorder.is_told_to_end
    fleet.end("recorder", -9)
    fleet.live(1.0)
    assert fleet.events == ["recorder: killed by signal 9 after 0 frames; started again"]
    assert (recorder.finished, recorder.epoch, recorder.is_told_to_end) == (False, 2, True)
    fleet.end("recorder")
    fleet.world.run(timeout_s=0.1, done=lambda: False)
    assert fleet.supervisor.step() is None
    assert recorder.finished


def test_frames_that_nobody_does_anything_about_are_a_hang_and_the_second_time_the_end(fleet: Fleet) -> None:
    with_a_frame(fleet)
    fleet.live(HANG_S - 2.0)
    assert set(fleet.epochs.values()) == {1}
    fleet.live(4.0)
    why = "did nothing for 50 s although frames wait after 0 frames"
    assert fleet.events == [f"{name}: {why}; started again" for name in ("tracker", "mapper")]
    assert fleet.epochs == {"mapper": 2, "tracker": 2, "sensor": 1, "archiver": 1, "recorder": 1}
    with pytest.raises(FleetError, match=f"tracker, mapper: {why}, for the 2nd time"):
        fleet.live(HANG_S + 4.0)


def test_a_commit_in_between_makes_it_the_first_time_again(fleet: Fleet) -> None:
    with_a_frame(fleet)
    fleet.live(HANG_S + 2.0)
    fleet.progress.num_frames = 1
    fleet.live(HANG_S + 2.0)
    assert fleet.epochs["tracker"] == fleet.epochs["mapper"] == 3


@pytest.mark.parametrize("state", [ServiceState.WORKING, ServiceState.DEGRADED])
def test_whoever_works_or_waits_for_memory_does_something(fleet: Fleet, state: ServiceState) -> None:
    with_a_frame(fleet)
    fleet.states["mapper"] = state
    fleet.live(3 * HANG_S)
    assert fleet.supervisor.children["mapper"].deaths == fleet.supervisor.children["tracker"].deaths == 0


def test_without_frames_there_is_nothing_to_do(fleet: Fleet) -> None:
    fleet.live(2 * HANG_S)
    with_a_frame(fleet)
    fleet.live(HANG_S - 2.0)
    FrameRingReader(fleet.folder.ring_path).acknowledge(1)
    fleet.live(2 * HANG_S)
    assert fleet.events == []


def test_in_realtime_frames_may_be_left_out(tmp_path: Path) -> None:
    with fake_processes():
        fleet = Fleet(tmp_path, pacing=Pacing.REALTIME)
        with_a_frame(fleet)
        fleet.live(2 * HANG_S)
        assert fleet.events == []
        fleet.close()

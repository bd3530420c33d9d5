"""When a supervisor takes a process for dead, hung or hopeless; without any process."""

import errno
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.fake_processes import FakePopen, fake_processes

from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.messages import ServiceState, ServiceStatus
from vtslam.services.supervisor.child import REFUSED
from vtslam.services.supervisor.child_process import ChildProcess
from vtslam.services.supervisor.errors import FleetError, ProcessRefused
from vtslam.services.supervisor.processes import MAPPER, SENSOR, Process

HANG_S = 50.0


@pytest.fixture
def child(tmp_path: Path) -> Iterator[ChildProcess]:
    with fake_processes():
        yield started(MAPPER, tmp_path)


def started(process: Process, base: Path) -> ChildProcess:
    folder = FleetFolder.create("a", base=base)
    folder.reserve_last_words(process.name)
    child = ChildProcess(process, fleet="a", folder=folder, hang_s=HANG_S)
    child.start(0.0, 0, {})
    return child


def heartbeat(epoch: int) -> ServiceStatus:
    return ServiceStatus(service="mapper", pid=1, epoch=epoch, state=ServiceState.WORKING, last_frame_id=-1)


def end(child: ChildProcess, code: int) -> None:
    process = child._popen
    assert isinstance(process, FakePopen)
    process.code = code


def test_a_process_that_ends_as_it_was_told_is_not_started_again(child: ChildProcess) -> None:
    assert child.reap(1.0, 0) is None
    child.is_told_to_end = True
    end(child, 0)
    assert child.reap(2.0, 0) is None
    assert child.finished
    assert child.is_ready
    assert not child.is_due(99.0)


def test_a_process_that_ends_without_being_told_to_is_started_again(child: ChildProcess) -> None:
    child._folder.write_counts("mapper", 1, {})
    end(child, 0)
    assert child.reap(1.0, 3) == "mapper: ended without being told to after 3 frames; started again"
    child.is_told_to_end = True
    child.start(2.0, 0, {})
    end(child, 0)
    assert child.reap(3.0, 3) is not None, "the order was for the one before"


def test_a_sensor_ends_itself_when_it_says_that_its_recording_has_ended(child: ChildProcess, tmp_path: Path) -> None:
    sensor = started(SENSOR, tmp_path)
    end(sensor, 0)
    assert sensor.reap(1.0, 3) == "sensor: ended without being told to after 3 frames; started again"
    sensor._folder.write_counts("sensor", 1, {"frames.published": 4})
    sensor.start(2.0, 0, {})
    end(sensor, 0)
    assert sensor.reap(3.0, 3) is not None, "that was the one before"
    sensor.start(4.0, 0, {})
    sensor._folder.write_counts("sensor", 3, {"frames.published": 5})
    end(sensor, 0)
    assert sensor.reap(5.0, 5) is None
    assert sensor.finished
    assert sensor.counters == {"frames.published": 5}


def test_the_wait_before_a_start_grows_and_a_commit_ends_that(child: ChildProcess) -> None:
    waits = []
    for frames in (0, 0, 0, 1):
        end(child, 1)
        assert child.reap(10.0, frames) == f"mapper: ended with status 1 after {frames} frames; started again"
        waits.append(next(wait_s for wait_s in (0.0, 0.2, 0.5, 1.0, 2.0) if child.is_due(10.0 + wait_s)))
        child.start(20.0, 0, {})
    assert waits == [0.0, 0.2, 0.5, 0.0]
    assert (child.deaths, child.epoch, FakePopen.started) == (4, 5, 5)


def test_many_deaths_without_a_commit_are_the_end(child: ChildProcess) -> None:
    for _ in range(5):
        end(child, -11)
        child.reap(1.0, 7)
        child.start(9.0, 0, {})
    end(child, -11)
    with pytest.raises(FleetError, match="mapper: killed by signal 11 after 7 frames, for the 6th time"):
        child.reap(10.0, 7)


def test_a_start_that_the_system_refuses_is_a_death(child: ChildProcess) -> None:
    end(child, 1)
    child.reap(1.0, 7)
    FakePopen.refused = OSError(errno.EAGAIN, "Resource temporarily unavailable")
    refusal = "mapper: could not be started: Resource temporarily unavailable after 7 frames"
    assert child.start(1.0, 7, {}) == f"{refusal}; started again"
    assert not child.is_due(1.1)
    assert child.is_due(1.3)
    FakePopen.refused = None
    assert child.start(1.3, 7, {}) is None
    assert (child.deaths, child.epoch, child.pid) == (2, 3, FakePopen.pid)


def test_a_process_that_says_that_it_is_of_no_use_is_believed(child: ChildProcess) -> None:
    child._folder.write_failure("mapper", "no room for a section")
    end(child, REFUSED)
    with pytest.raises(ProcessRefused, match="no room for a section"):
        child.reap(1.0, 0)
    assert child.finished


def test_heartbeats_of_former_starts_are_nobodys(child: ChildProcess) -> None:
    child.heard(heartbeat(0), 1.0)
    assert not child.is_ready
    child.heard(heartbeat(1), 1.0)
    assert child.is_ready


def test_silence_is_a_hang_after_the_limit_and_a_longer_one_before_the_first_heartbeat(child: ChildProcess) -> None:
    child.seen(on_bus=False, now_s=119.0)
    assert child.kill_if_hung(119.0, 0) is None
    child.heard(heartbeat(1), 120.0)
    child.seen(on_bus=True, now_s=169.0)
    assert child.kill_if_hung(169.0, 0) is None
    child.seen(on_bus=True, now_s=171.0)
    assert child.kill_if_hung(171.0, 0) == "mapper: silent for 50 s after 0 frames; started again"
    assert (child.hangs, child.deaths, child.pid) == (1, 1, None)


def test_a_process_that_leaves_the_bus_but_runs_is_stopped_as_a_whole(child: ChildProcess) -> None:
    child.heard(heartbeat(1), 1.0)
    child.seen(on_bus=True, now_s=5.0)
    child.seen(on_bus=False, now_s=7.9)
    assert child.kill_if_hung(7.9, 3) is None
    assert child.kill_if_hung(8.1, 3) == "mapper: left the bus while it ran after 3 frames; started again"

"""Fleets of processes that are pipelined, or in realtime."""

import signal
from pathlib import Path
from threading import Thread

import pytest
from helpers.fleet_runs import (
    ASSIGNMENTS,
    FRAMES,
    SECTION,
    CutOff,
    Disturbance,
    SmallRecording,
    cut_off_at,
    result_bytes,
    small_plan,
)

from vtslam.common.trajectory_io import read_trajectory
from vtslam.services.cli.__main__ import main
from vtslam.services.run_plan import plan_resume
from vtslam.services.sensor.publisher import FramePublisher
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.live_run import run_live
from vtslam.services.supervisor.supervisor import Supervisor
from vtslam.storage.run_folder import RunFolder

KILL = signal.SIGKILL
PIPELINED = "fleet.pacing=pipelined"


class Counts:
    """What the services of a fleet counted last."""

    def __init__(self) -> None:
        self.found: dict[str, int] = {}

    def look(self, supervisor: Supervisor) -> None:
        for child in supervisor.children.values():
            self.found.update(child.counters)


@pytest.fixture(scope="module")
def pipelined(small: SmallRecording, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What an undisturbed pipelined fleet leaves."""
    run, calm = tmp_path_factory.mktemp("pipelined") / "run", Disturbance()
    small_plan(small.files, PIPELINED).execute_in_fleet(run, calm.hooks())
    assert (calm.frames, calm.events) == (FRAMES, [])
    assert result_bytes(run) != small.undisturbed
    return result_bytes(run)


def test_a_pipelined_run_is_the_same_again_whoever_dies(
    small: SmallRecording, pipelined: dict[str, bytes], tmp_path: Path
) -> None:
    killed = Disturbance(signals=[(3, "tracker", KILL), (8, "mapper", KILL)])
    small_plan(small.files, PIPELINED).execute_in_fleet(tmp_path / "run", killed.hooks())

    assert killed.frames == FRAMES
    assert sum(killed.deaths.values()) == 2
    assert result_bytes(tmp_path / "run") == pipelined


def test_a_pipelined_fleet_goes_on_to_its_own_bytes(
    small: SmallRecording, pipelined: dict[str, bytes], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    with pytest.raises(CutOff):
        small_plan(small.files, PIPELINED).execute_in_fleet(run, FleetHooks(on_frame=cut_off_at(2 * SECTION + 2)))
    done = RunFolder.open(run).catalog.num_frames
    plan_resume(run).resume_in_fleet(run, Disturbance(frames=done).hooks())

    assert done >= SECTION
    assert result_bytes(run) == pipelined


def test_in_realtime_frames_are_mapped_or_counted_as_dropped(small: SmallRecording, tmp_path: Path) -> None:
    counts = Counts()
    plan = small_plan(small.files, "fleet.pacing=realtime", "fleet.replay_hz=60")
    mapped: list[int] = []
    hooks = FleetHooks(on_frame=lambda facts: mapped.append(facts.frame_id), on_step=counts.look)
    plan.execute_in_fleet(tmp_path / "run", hooks)

    assert counts.found["frames.published"] == FRAMES == counts.found["frames.tracked"] + counts.found["frames.dropped"]
    assert 0 < len(mapped) <= counts.found["frames.tracked"]
    assert mapped == sorted(set(mapped))
    assert len(read_trajectory(tmp_path / "run" / "trajectory.txt").poses) == len(mapped)
    with RunFolder.open(tmp_path / "run") as run:
        assert run.read_info().facts.finished
        sections = [run.read_section(section_id) for section_id in run.section_ids()]
    assert [int(frame_id) for section in sections for frame_id in section.frame_ids] == mapped


def test_publishers_are_not_slowed_down_by_the_mapper(small: SmallRecording, tmp_path: Path) -> None:
    source, counts = open_source(small.files.uri), Counts()

    def publish() -> None:
        with FramePublisher("test-realtime") as publisher:
            for index in range(FRAMES):
                publisher.publish(source.frame(index))

    publisher = Thread(target=publish)

    def is_done() -> bool:
        if publisher.ident is None:
            publisher.start()
        return not publisher.is_alive()

    summary = run_live(
        tmp_path / "run",
        FleetHooks(on_step=counts.look, should_stop=is_done),
        fleet="test-realtime",
        preset="fast",
        family="tum",
        assignments=[*ASSIGNMENTS, 'fleet.pacing=""'],  # as it is unless set
    )
    publisher.join()

    assert counts.found["frames.published"] == FRAMES == counts.found["frames.tracked"] + counts.found["frames.dropped"]
    assert 0 < summary.frames <= counts.found["frames.tracked"]


def test_pacing_on_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "sim:room", "--out", "nowhere", "--pacing", "hasty"]) == 2
    assert "fleet.pacing" in capsys.readouterr().err
    assert main(["run", "sim:room", "--out", "nowhere", "--pacing", "pipelined", "--in-process"]) == 2
    assert "--in-process works in lockstep" in capsys.readouterr().err

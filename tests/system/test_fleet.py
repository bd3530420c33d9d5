"""A fleet of processes leaves what one process leaves, whichever of them dies and whenever."""

import os
import signal
from pathlib import Path

import pytest
from helpers.fleet_runs import FRAMES, SECTION, Disturbance, fleet_run, result_bytes, undisturbed

from vtslam.storage.run_folder import RunFolder

KILL = signal.SIGKILL


def is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_a_fleet_gives_the_same_bytes_as_one_process(tmp_path: Path) -> None:
    calm = Disturbance()
    summary = fleet_run(tmp_path / "run", calm)

    assert result_bytes(tmp_path / "run") == undisturbed()
    assert (summary.frames, summary.sections, summary.interrupted) == (FRAMES, 4, False)
    assert calm.events == []
    assert len(calm.pids) == 3
    assert all(is_gone(pid) for pid in calm.pids)
    with RunFolder.open(tmp_path / "run") as run:
        assert run.read_info().facts.finished
        assert [row["frame_id"] for row in run.read_frames()] == list(range(FRAMES))


@pytest.mark.parametrize("name", ["mapper", "tracker", "sensor"])
def test_a_process_that_is_killed_twice_changes_nothing(name: str, tmp_path: Path) -> None:
    killed = Disturbance(signals=[(3, name, KILL), (SECTION + 3, name, KILL)])
    fleet_run(tmp_path / "run", killed)

    assert result_bytes(tmp_path / "run") == undisturbed()
    assert killed.deaths[name] == len(killed.events) == 2
    assert all("killed by signal 9" in event for event in killed.events)
    assert all(is_gone(pid) for pid in killed.pids)

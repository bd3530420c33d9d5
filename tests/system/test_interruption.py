"""Ctrl-C and SIGTERM in the middle of a run."""

import signal
import time
from pathlib import Path

import pytest
from helpers.cli_runs import DEADLINE_S, POLL_S, start_run, wait_for
from helpers.processes import leftovers

from vtslam.common.fleet_folder import sweep_dead_fleets
from vtslam.common.trajectory_io import read_trajectory
from vtslam.services.cli.__main__ import main
from vtslam.services.process_facts import children_of, is_gone
from vtslam.services.supervisor.processes import PROCESSES
from vtslam.storage.run_folder import RunFolder


@pytest.mark.parametrize("mode", [["--in-process"], []], ids=["one process", "fleet"])
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_what_was_begun_is_finished_and_what_was_done_is_kept(
    mode: list[str], number: signal.Signals, status: int, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    process = start_run(out, *mode)
    try:
        wait_for(out / "sections" / "000001.vts", process)
        process.send_signal(number)
        output, _ = process.communicate(timeout=DEADLINE_S)
    finally:
        process.kill()
        process.communicate()

    assert process.returncode == status
    assert "stopped early; what was done is kept" in output
    with RunFolder.open(out) as run:
        facts, rows = run.read_info().facts, run.read_frames()
        poses = read_trajectory(run.trajectory_path).poses
        in_sections = sum(run.read_section(section_id).num_frames for section_id in run.section_ids())
    assert (facts.finished, facts.interrupted) == (False, True)
    assert 6 <= facts.frames == len(rows) == len(poses) == in_sections < 2000
    assert main(["eval", str(out)]) == 0


def test_without_their_supervisor_the_processes_of_a_fleet_end_and_are_swept(tmp_path: Path) -> None:
    out = tmp_path / "run"
    process = start_run(out)
    try:
        wait_for(out / "sections" / "000000.vts", process)
        children = children_of(process.pid)
    finally:
        process.kill()
        process.communicate()

    assert len(children) == len(PROCESSES)
    for _ in range(int(DEADLINE_S / POLL_S)):
        if all(is_gone(pid) for pid in children):
            break
        time.sleep(POLL_S)
    assert all(is_gone(pid) for pid in children)
    swept = sweep_dead_fleets()
    assert any(name.startswith(f"run-{process.pid}-") for name in swept)
    assert leftovers() == []

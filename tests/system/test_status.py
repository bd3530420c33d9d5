"""``vtslam status`` beside a run."""

import json
import signal
from pathlib import Path

import pytest
from helpers.cli_runs import DEADLINE_S, start_run, wait_for

from vtslam.common.fleet_folder import running_fleets
from vtslam.services.cli.__main__ import main


def test_status_shows_each_service_of_a_running_fleet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = tmp_path / "status.json"
    process = start_run(tmp_path / "run")
    try:
        wait_for(tmp_path / "run" / "sections" / "000000.vts", process)
        fleet = next(name for name in running_fleets() if name.startswith(f"run-{process.pid}-"))
        assert main(["status", "--fleet", fleet, "--json", str(found)]) == 0
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 130
    finally:
        process.kill()
        process.communicate()

    services = json.loads(found.read_text())[fleet]
    assert set(services) == {"archiver", "mapper", "sensor", "supervisor", "tracker"}
    assert all(each["alive"] and each["starts"] == 1 for each in services.values())
    assert services["mapper"]["counters"]["frames.committed"] >= 3
    assert services["supervisor"]["counters"]["tracker.deaths"] == 0
    assert f"fleet {fleet}\n  archiver     alive" in capsys.readouterr().out


def test_status_of_a_fleet_that_is_not_there_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", "--fleet", "none-of-that-name"]) == 1
    assert "expected the folder of a fleet, found nothing" in capsys.readouterr().err

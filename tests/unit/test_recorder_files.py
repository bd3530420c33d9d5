"""Where a recording goes: what is refused, and what of an earlier one is given up."""

import os
from pathlib import Path

import pytest
from helpers.small_runs import small_run

from vtslam.common.bus import BusError
from vtslam.common.fleet_folder import FleetFolder
from vtslam.common.settings import RecorderSettings
from vtslam.services.cli import record_command
from vtslam.services.cli.__main__ import main
from vtslam.services.recorder.files import check_way, make_way, open_recording
from vtslam.storage.errors import WriteFailed


def written(*paths: Path) -> None:
    for path in paths:
        path.write_bytes(path.name.encode())


def test_a_check_removes_nothing_and_making_way_removes_all_parts(tmp_path: Path) -> None:
    path, settings = tmp_path / "r.mcap", RecorderSettings(file=str(tmp_path / "r.mcap"))
    parts, others = [path, tmp_path / "r-2.mcap", tmp_path / "r-3.mcap"], [tmp_path / "r-5.mcap", tmp_path / "r-2.txt"]
    written(*parts, *others)
    check_way(settings, overwrite=True)
    make_way(settings, overwrite=False)
    assert all(each.exists() for each in parts)
    make_way(settings, overwrite=True)
    assert sorted(tmp_path.iterdir()) == sorted(others)
    with open_recording(settings, family="tum") as recording:
        assert recording.path == path


def test_a_later_part_alone_is_an_earlier_recording_too(tmp_path: Path) -> None:
    written(tmp_path / "r-2.mcap")
    with pytest.raises(WriteFailed, match=r"r-2\.mcap: expected no recording yet, found a file \(--overwrite gives it"):
        check_way(RecorderSettings(file=str(tmp_path / "r.mcap")), overwrite=False)


def test_folders_and_files_that_are_used_are_refused(tmp_path: Path) -> None:
    path, link = tmp_path / "r.mcap", tmp_path / "other.mcap"
    settings = RecorderSettings(file=str(path))
    path.mkdir()
    with pytest.raises(WriteFailed, match=r"r\.mcap: expected a file to record in, found no regular file"):
        check_way(settings, overwrite=True)
    path.rmdir()
    written(path, tmp_path / "r-2.mcap")
    link.symlink_to(path)
    for used in (path, link, tmp_path / "r-2.mcap"):
        with pytest.raises(WriteFailed, match="expected a file that nobody uses, found one that is read or written"):
            check_way(settings, overwrite=True, used=["", str(tmp_path / "none"), str(used)])
    with pytest.raises(WriteFailed, match=r"nowhere/r\.mcap: expected a folder for the recording, found none"):
        check_way(RecorderSettings(file=str(tmp_path / "nowhere/r.mcap")), overwrite=True)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # to the superuser all can be
    with pytest.raises(WriteFailed, match=r"r\.mcap: expected a folder that can be written, found one that cannot"):
        check_way(RecorderSettings(file=str(tmp_path / "r.mcap")), overwrite=True)


def test_a_fleet_that_cannot_be_joined_costs_no_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*args: object) -> None:
        raise BusError("nobody there")

    path, fleet = tmp_path / "r.mcap", f"test-recorder-{os.getpid()}"
    written(path)
    monkeypatch.setattr(record_command, "join", refuse)
    folder = FleetFolder.create(fleet, run_folder=str(small_run(tmp_path / "run", 1)))
    try:
        assert main(["record", "--fleet", fleet, "--out", str(path), "--overwrite"]) == 1
    finally:
        folder.remove()
    assert "nobody there" in capsys.readouterr().err
    assert path.exists()

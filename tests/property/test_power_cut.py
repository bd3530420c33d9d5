"""A power cut at any moment leaves a run folder that opens, with every section that was durable."""

from pathlib import Path
from random import Random

import pytest
from helpers.power_cut import RecordingDisk, after_power_cut
from helpers.sections import frames_of
from helpers.small_runs import check_whole, result_bytes, section_record, small_run, write_sections

from vtslam.storage import atomic, section_care
from vtslam.storage.run_folder import RunFolder

SECTIONS = 3
CUTS_PER_MOMENT = 2


def recorded(path: Path, monkeypatch: pytest.MonkeyPatch) -> RecordingDisk:
    """Every call of a run that goes on from its first section, and is repacked and finished."""
    small_run(path, 1)
    disk = RecordingDisk(path)
    disk.sections = 1
    with RunFolder.open(path, writable=True) as run, monkeypatch.context() as patch:
        patch.setattr(atomic, "DISK", disk)
        for section_id in range(1, SECTIONS):
            record = section_record(section_id)
            run.write_section(record)
            disk.keep()  # the file is durable, the catalogue does not name it
            run.commit_section(record, frames_of(record), resume=b"after %d" % section_id)
            disk.sections = section_id + 1
        section_care.repack(run, 1, codec="lossless")
        run.write_info(run.read_info())
        disk.keep()
    return disk


def test_no_durable_section_is_ever_lost(folder_in_memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, left = folder_in_memory / "run", folder_in_memory / "left"
    disk = recorded(path, monkeypatch)
    whole, rng, found = result_bytes(path), Random(1), set()
    assert len(disk.moments) > 60
    for moment in disk.moments:
        for _ in range(CUTS_PER_MOMENT):
            after_power_cut(moment, rng, path, left)
            with RunFolder.open(left, writable=True) as run:
                section_care.repair(run)
            sections = check_whole(left, at_least=moment.sections)
            found.add(sections)
            with RunFolder.open(left, writable=True) as run:
                write_sections(run, sections, SECTIONS)
            assert result_bytes(left) == whole
    assert found == {1, 2, 3}


def test_the_catalogue_names_a_section_only_after_its_file_is_durable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run"
    disk = recorded(path, monkeypatch)
    for moment in disk.moments:
        for section_id in range(moment.sections):
            inode = moment.durable[path / "sections" / f"{section_id:06d}.vts"]
            assert not inode.is_loose
            assert inode.content

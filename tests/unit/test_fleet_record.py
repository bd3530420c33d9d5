"""What is written of a fleet that cannot go on, whatever was damaged."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.fleet_world import FRAMES, RUN_INFO, FleetWorld, expected, fleet_world
from helpers.small_map import section_bytes

from vtslam.common.bus_schedule import ScriptedSchedule
from vtslam.services.archiver.fleet_record import FleetRecord
from vtslam.services.frame_journal import JournalReader
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import SectionArchive


@pytest.fixture(scope="module")
def fleet() -> Iterator[FleetWorld]:
    with fleet_world(ScriptedSchedule()) as fleet:
        fleet.run()
        yield fleet


@pytest.mark.parametrize(("damaged", "whole"), [(None, 3), (0, 0), (1, 1), (2, 2)])
def test_sections_before_a_damaged_line_of_the_journal_are_kept(
    damaged: int | None, whole: int, fleet: FleetWorld, tmp_path: Path
) -> None:
    journal = tmp_path / "journal"
    shutil.copytree(fleet._folder / "journal", journal)
    if damaged is not None:
        path = journal / f"{damaged:06d}"
        path.write_bytes(b"\0\n" + path.read_bytes())
    with RunFolder.create(tmp_path / "run", RUN_INFO) as run:
        FleetRecord(run, fleet._store, JournalReader(journal)).finish_broken(seconds=1.0, peak_rss_mb=1.0)
        kept = tuple(section_bytes(SectionArchive(run).read(section_id)) for section_id in run.section_ids())
        assert kept == expected().sections[:whole]
        assert run.catalog.num_frames == min(2 * whole, FRAMES)

"""The map as services read it: candidate views of sections that were never in memory."""

from dataclasses import replace
from pathlib import Path

from helpers.sections import frames_of
from helpers.small_map import room_section
from helpers.small_runs import INFO

from vtslam.common.section import Section
from vtslam.services.section_map import SectionMap
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import SectionArchive, record_of

INTERVAL = 3
LENGTH = 5


class CountingArchive(SectionArchive):
    def __init__(self, run: RunFolder) -> None:
        super().__init__(run)
        self.read_ids: list[int] = []

    def read(self, section_id: int) -> Section:
        self.read_ids.append(section_id)
        return super().read(section_id)


def sections(count: int) -> list[Section]:
    return [room_section(LENGTH * i, LENGTH, section_id=i) for i in range(count)]


def rows_of(section_map: SectionMap) -> bytes:
    return section_map.candidate_views().rows.tobytes()


def run_of(path: Path, count: int) -> RunFolder:
    run = RunFolder.create(path, INFO)
    for section in sections(count):
        record = record_of(section)
        run.write_section(record)
        run.commit_section(record, frames_of(record))
    return run


def test_a_start_takes_the_views_from_the_catalogue_and_they_are_the_same(tmp_path: Path) -> None:
    with run_of(tmp_path / "run", 3) as run:
        archive = CountingArchive(run)
        started = SectionMap(archive, candidate_interval=INTERVAL)
        started.sealed(sections(3)[2])
        assert archive.read_ids == []
        grown = SectionMap(CountingArchive(run), candidate_interval=INTERVAL)
        for section in sections(3):
            grown.committed(section)
            grown.sealed(section)
        assert len(started.candidate_views()) == 6
        assert rows_of(started) == rows_of(grown)
        for section in sections(2):
            for row in (0, INTERVAL):
                expected = section.frames[row].view_depth
                assert expected is not None
                assert started.view_depth(section.section_id, row).tobytes() == expected.tobytes()
                assert started.coarse_depth(section.section_id, row, section.frames[row].frame_id) is not None
        assert archive.read_ids == []


def test_sections_that_are_not_on_disk_yet_are_read_where_they_are(tmp_path: Path) -> None:
    with run_of(tmp_path / "run", 1) as run:

        class HalfArchived(CountingArchive):
            def read(self, section_id: int) -> Section:
                self.read_ids.append(section_id)
                return sections(3)[section_id]

        archive = HalfArchived(run)
        late = SectionMap(archive, candidate_interval=INTERVAL)
        late.committed(replace(sections(3)[2]))
        assert archive.read_ids == [1]
        assert [int(each) for each in late.candidate_views().rows["section_id"]] == [0, 0, 1, 1, 2, 2]

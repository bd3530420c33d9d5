"""Sections to files and back: nothing is lost."""

from pathlib import Path

import pytest
from helpers.sections import assert_same_section, small_section
from helpers.small_map import room_section, section_bytes

from vtslam.storage.errors import StorageError
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.run_info import RunFacts, RunInfo
from vtslam.storage.section_convert import SectionArchive, record_of, section_of


def test_a_mapped_section_comes_back_byte_for_byte_positions_included() -> None:
    section = room_section(0, 4)

    assert section_bytes(section_of(record_of(section))) == section_bytes(section)


@pytest.mark.parametrize(("gaussians", "views"), [(20, 2), (0, 2), (20, 0), (0, 0)])
def test_a_record_survives_being_a_section(gaussians: int, views: int) -> None:
    record = small_section(num_gaussians=gaussians, num_views=views)

    assert_same_section(record_of(section_of(record)), record)


def test_the_archive_gives_back_what_it_was_given(tmp_path: Path) -> None:
    facts = RunFacts(
        created_by="test",
        source="sim:room",
        family="tum",
        preset="fast",
        width=80,
        height=60,
        first_frame=0,
        end_frame=4,
    )
    section = room_section(0, 4, section_id=0)
    with RunFolder.create(tmp_path / "run", RunInfo(facts=facts, settings={})) as run:
        archive = SectionArchive(run)
        archive.write(section)

        assert section_bytes(archive.read(0)) == section_bytes(section)
        with pytest.raises(StorageError, match=r"000001\.vts"):
            archive.read(1)

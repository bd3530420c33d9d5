"""Run folders of small sections that nothing was mapped for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers.sections import frames_of, small_section

from vtslam.storage.run_folder import RunFolder
from vtslam.storage.run_info import RunFacts, RunInfo
from vtslam.storage.section_file import verify_file
from vtslam.storage.section_record import SectionRecord

INFO = RunInfo(
    facts=RunFacts(
        created_by="vtslam 0.1.0",
        source="sim:room?seed=3",
        family="tum",
        preset="fast",
        width=6,
        height=4,
        first_frame=0,
        end_frame=60,
    ),
    settings={"seed": 2},
)


def section_record(section_id: int) -> SectionRecord:
    """A section of 3 frames that follow those of the one before."""
    ids = np.arange(3, dtype=np.int64) + 3 * section_id
    return replace(small_section(section_id=section_id), frame_ids=ids, capture_times_ns=1_000_000_000 * (1 + ids))


def write_sections(run: RunFolder, first: int, end: int) -> None:
    """Write and commit sections ``first`` to ``end - 1``."""
    for section_id in range(first, end):
        record = section_record(section_id)
        run.write_section(record)
        run.commit_section(record, frames_of(record), resume=b"after %d" % section_id)


def small_run(path: Path, sections: int) -> Path:
    """A run folder of so many sections."""
    with RunFolder.create(path, INFO) as run:
        write_sections(run, 0, sections)
    return path


def check_whole(path: Path, *, at_least: int) -> int:
    """Assert that a run folder opens and holds that many sections, whole and in order; how many there are."""
    with RunFolder.open(path, writable=True) as run:
        rows = run.catalog.sections()
        assert [row.section_id for row in rows] == list(range(len(rows)))
        assert len(rows) >= at_least
        for row in rows:
            assert verify_file(run.section_path(row.section_id)) == row.sha256
        assert [frame.frame_id for frame in run.catalog.frames()] == list(range(3 * len(rows)))
        run.drop_sections(len(rows))
        assert len(run.trajectory_path.read_text().splitlines() if rows else []) == 3 * len(rows)
        assert run.section_ids() == list(range(len(rows)))
    return len(rows)


def result_bytes(path: Path) -> dict[str, bytes]:
    """Trajectory and sections of a run, by name."""
    files = [path / "trajectory.txt", *(path / "sections").glob("*")]
    return {file.name: file.read_bytes() for file in files}

"""The journal of committed frames: whole lines, in order, section by section."""

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.facts import frame_facts

from vtslam.common.messages import SectionArchived, TrackerHistory
from vtslam.common.shm.errors import SharedMemoryFull
from vtslam.common.shm.map_store import MapStore
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.frame_facts import CommittedFrame
from vtslam.services.frame_journal import JournalReader, JournalWriter
from vtslam.services.supervisor.progress import FleetProgress
from vtslam.storage.catalog import Catalog

LENGTH = 3


def facts_of(frame_id: int) -> CommitFacts:
    about = frame_facts(frame_id, section_id=frame_id // LENGTH, is_head=frame_id % LENGTH == 0)
    T = np.eye(4)
    T[0, 3] = 0.1 * frame_id
    return CommitFacts(
        num_frames=frame_id + 1,
        num_tracked=frame_id + 1,
        sequence=frame_id + 1,
        iterations=3,
        frame=CommittedFrame(facts=about, capture_time_ns=frame_id, T_world_camera=T),
        T_world_previous=None,
        history=TrackerHistory(color_losses=(0.1,), depth_losses_m=(0.2,), largest_mean_depths_m=(2.5,)),
        pixels_crc32=7,
    )


def append(writer: JournalWriter, *frame_ids: int) -> None:
    for frame_id in frame_ids:
        writer.append(facts_of(frame_id), section_ended=frame_id % LENGTH == LENGTH - 1)


def new_ids(reader: JournalReader) -> list[int]:
    return [line.frame.facts.frame_id for line in reader.new_lines()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "journal"


def test_lines_are_read_once_and_in_order_over_many_sections(folder: Path) -> None:
    reader = JournalReader(folder)
    assert new_ids(reader) == []
    writer = JournalWriter(folder)
    append(writer, 0, 1)
    assert new_ids(reader) == [0, 1]
    append(writer, 2, 3, 4, 5, 6, 7)
    lines = list(reader.new_lines())
    assert [line.frame.facts.frame_id for line in lines] == [2, 3, 4, 5, 6, 7]
    assert [line.ended is not None for line in lines] == [True, False, False, True, False, False]
    ended = lines[3].ended
    assert ended is not None
    assert ended.packed() == facts_of(5).packed()
    assert new_ids(reader) == []
    writer.close()


def test_a_line_that_was_cut_is_written_anew(folder: Path) -> None:
    writer, reader = JournalWriter(folder), JournalReader(folder)
    append(writer, 0, 1)
    writer.close()
    path = folder / "000000"
    path.write_bytes(path.read_bytes()[:-5])
    assert new_ids(reader) == [0]
    writer = JournalWriter(folder)
    append(writer, 1, 2)
    assert new_ids(reader) == [1, 2]
    writer.close()


def test_what_lies_before_a_damaged_line_is_read_once_and_the_damage_told_each_time(folder: Path) -> None:
    writer, reader = JournalWriter(folder), JournalReader(folder)
    append(writer, 0, 1, 2, 3)
    writer.close()
    path = folder / "000000"
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(lines[0] + b"\0\n" + lines[2])
    read: list[int] = []
    for _ in range(2):
        with pytest.raises(ValueError, match="Expecting value"):
            read.extend(line.frame.facts.frame_id for line in reader.new_lines())
    assert read == [0]


def test_a_line_that_does_not_fit_leaves_nothing_and_can_be_tried_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, reader = JournalWriter(folder), JournalReader(folder)
    append(writer, 0)
    real, calls = os.write, []

    def full_after_some_bytes(fd: int, data: bytes) -> int:
        calls.append(len(data))
        if len(calls) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(fd, data[:10])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full_after_some_bytes)
        with pytest.raises(SharedMemoryFull, match=r"journal/000000: \d+ bytes of shared memory wanted"):
            append(writer, 1)
    append(writer, 2)
    writer.close()

    assert len(calls) == 2
    assert new_ids(reader) == [0, 2]


def test_durable_sections_are_forgotten_also_if_they_are_announced_again(folder: Path) -> None:
    writer, reader = JournalWriter(folder), JournalReader(folder)
    append(writer, *range(7))
    assert len(new_ids(reader)) == 7
    reader.forget_before(2)
    assert [path.name for path in folder.iterdir()] == ["000002"]
    writer.close()
    again = JournalWriter(folder)
    append(again, 5, 7, 8)
    assert new_ids(reader) == [7, 8]
    again.close()


def test_facts_survive_exactly() -> None:
    facts = replace(facts_of(1), T_world_previous=np.full((4, 4), 1 / 3))
    again = CommitFacts.unpacked(facts.packed())
    assert again.packed() == facts.packed()
    assert again.T_world_previous is not None
    assert again.T_world_previous.tobytes() == np.full((4, 4), 1 / 3).tobytes()


def test_lines_are_deleted_once_they_are_durable_and_counted(tmp_path: Path) -> None:
    writer, seen = JournalWriter(tmp_path / "journal"), list[int]()
    catalog, store = Catalog.create(tmp_path / "catalog.sqlite"), MapStore(tmp_path / "map", budget_bytes=1 << 20)
    journal = JournalReader(tmp_path / "journal")
    progress = FleetProgress(catalog, journal, store, lambda facts: seen.append(facts.frame_id))
    append(writer, 0, 1, 1, 2, 2, 3)
    digest = "0" * 64
    progress.archived(SectionArchived(section_id=0, file_name="000000.vts", file_bytes=1, sha256=digest, epoch=1))
    progress.step()

    assert (seen, progress.num_frames) == ([0, 1, 2, 3], 4)
    assert sorted(path.name for path in (tmp_path / "journal").iterdir()) == ["000001"]
    append(writer, 3, 4)
    progress.step()
    assert seen == [0, 1, 2, 3, 4]
    catalog.close()


def test_facts_come_back_exactly_also_those_of_an_earlier_version() -> None:
    facts = replace(facts_of(4), history=TrackerHistory(largest_mean_depths_m=(0.1 + 0.2,), ignores_priors=True))
    assert CommitFacts.unpacked(facts.packed()).history == facts.history
    plain = json.loads(facts.packed())
    del plain["history"]["ignores_priors"]
    assert CommitFacts.unpacked(json.dumps(plain).encode()).history == replace(facts.history, ignores_priors=False)

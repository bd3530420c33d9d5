"""Sections that left memory come back, or are read otherwise."""

import os
from pathlib import Path

import pytest
from helpers.recordings import cut_in_half
from helpers.small_runs import section_record, small_run, write_sections

from vtslam.common.bus import Member
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import ScriptedSchedule
from vtslam.common.messages import LoadOutcome
from vtslam.common.section import Section
from vtslam.common.settings import StorageSettings
from vtslam.common.shm.blocks import aligned
from vtslam.common.shm.map_store import MapStore
from vtslam.common.topics import FLEET_EVENT, SECTION_LOAD, Role
from vtslam.services.archiver.archived import ArchivedSections
from vtslam.services.archiver.packing import Packing
from vtslam.services.archiver.resident_sections import ResidentSections
from vtslam.services.map_follower import StoreArchive
from vtslam.services.section_loader import SectionLoader
from vtslam.services.section_map import ReadsSections
from vtslam.services.service_link import ServiceLink
from vtslam.storage.errors import RunLocked
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_care import repack_all
from vtslam.storage.section_convert import SectionArchive, record_of, section_of

SECTIONS = 4


def test_a_question_that_nobody_answers_ends_and_is_told() -> None:
    world = MemoryWorld(ScriptedSchedule())
    reader = world.join(Member(fleet="test", role=Role.TRACKER))
    events = world.join(Member(fleet="test", role=Role.OBSERVER)).subscriber(FLEET_EVENT)
    link = ServiceLink(reader, 1)
    loader = SectionLoader(reader, link, timeout_s=2.0)
    assert not loader.load(7)
    questions = world.join(Member(fleet="test", role=Role.ARCHIVER)).queryable(SECTION_LOAD)
    before_ns = world.clock.now_ns
    assert not loader.load(8)

    assert 2e9 <= world.clock.now_ns - before_ns < 3e9
    assert link.counters == {"sections.read": 2}
    assert questions.receive() is not None
    world.run(timeout_s=1.0, done=lambda: False)
    told = [received.message for _ in range(2) if (received := events.receive()) is not None]
    assert [(event.service, event.kind) for event in told] == [("tracker", "load")] * 2
    assert told[0].text == "section/load: nobody answered; section 7 is read from its file instead"
    assert told[1].text.startswith("section/load: no")
    assert told[1].text.endswith("; section 8 is read from its file instead")


class OnDisk(ReadsSections):
    def __init__(self) -> None:
        self.read_ids: list[int] = []

    def read(self, section_id: int) -> Section:
        self.read_ids.append(section_id)
        return section_of(section_record(section_id))


def test_what_was_loaded_is_read_from_memory_and_what_leaves_at_once_from_disk(tmp_path: Path) -> None:
    store, disk, asked = MapStore(tmp_path / "map", budget_bytes=1 << 20), OnDisk(), list[int]()

    def load(section_id: int) -> bool:
        asked.append(section_id)
        if section_id == 1:
            store.put_sealed(section_of(section_record(1)))
        return section_id != 3

    archive = StoreArchive(store, disk, load=load)
    assert archive.read(1).section_id == 1
    assert (asked, disk.read_ids) == ([1], [])
    assert archive.read(2).section_id == 2  # said to be there, and gone again each time
    assert archive.read(3).section_id == 3  # refused
    assert (asked, disk.read_ids) == ([1, 2, 2, 2, 3], [2, 3])


def _residents(run: RunFolder, store: MapStore) -> ResidentSections:
    return ResidentSections(store, run, ArchivedSections(run.catalog))


def test_a_section_comes_back_as_it_left_and_damage_is_named(tmp_path: Path) -> None:
    with RunFolder.open(small_run(tmp_path / "run", SECTIONS), writable=True) as run:
        store = MapStore(tmp_path / "map", budget_bytes=1 << 20)
        residents = _residents(run, store)
        assert residents.bring(1, SECTIONS, spared=()) == (LoadOutcome.RESIDENT, "")
        assert residents.bring(1, SECTIONS, spared=()) == (LoadOutcome.RESIDENT, "")
        held = store.pinned_sealed(1, verify=True)
        assert record_of(held.section.retied()).columns().keys() == section_record(1).columns().keys()
        for name, column in record_of(held.section).columns().items():
            assert column.tobytes() == section_record(1).columns()[name].tobytes()
        held.release()

        assert residents.bring(SECTIONS, SECTIONS, spared=())[0] is LoadOutcome.UNKNOWN
        cut_in_half(run.section_path(2))
        outcome, why = residents.bring(2, SECTIONS, spared=())
        assert outcome is LoadOutcome.DAMAGED
        assert "000002.vts" in why
        run.section_path(0).write_bytes(run.section_path(3).read_bytes())
        outcome, why = residents.bring(0, SECTIONS, spared=())
        assert outcome is LoadOutcome.DAMAGED
        assert "expected" in why
        assert store.sealed_ids() == [1]


def test_a_section_comes_back_only_where_there_is_room(tmp_path: Path) -> None:
    with RunFolder.open(small_run(tmp_path / "run", SECTIONS), writable=True) as run:
        wanted = ArchivedSections(run.catalog).num_bytes(0)
        size = aligned(wanted)
        store = MapStore(tmp_path / "map", budget_bytes=int(3.5 * size))
        store.put_sealed(section_of(section_record(3)))
        residents = _residents(run, store)
        residents.keep_room(SECTIONS, squeeze=False, spared=())  # a section and a quarter stay free
        assert store.used_bytes() == size
        assert residents.bring(0, SECTIONS, spared=())[0] is LoadOutcome.RESIDENT
        assert residents.bring(1, SECTIONS, spared=())[0] is LoadOutcome.RESIDENT
        assert store.sealed_ids() == [1, 3]
        assert not residents.has_room_for(2, SECTIONS, spared=[1])
        assert residents.has_room_for(2, SECTIONS, spared=[2])
        held = store.pinned_sealed(1)
        outcome, why = residents.bring(2, SECTIONS, spared=())
        assert (outcome, why) == (LoadOutcome.NO_ROOM, f"no room for {wanted} bytes beside what mapping needs")
        held.release()


def test_what_is_known_without_reading_is_the_same_from_catalogue_and_sections(tmp_path: Path) -> None:
    with RunFolder.open(small_run(tmp_path / "run", 2), writable=True) as run:
        told = ArchivedSections(run.catalog)
        for section_id in range(2, SECTIONS):
            told.add(section_record(section_id))
        write_sections(run, 2, SECTIONS)
        found = ArchivedSections(run.catalog)
    assert [told.num_bytes(i) for i in range(SECTIONS)] == [found.num_bytes(i) for i in range(SECTIONS)]
    assert told.places.section_ids.tolist() == found.places.section_ids.tolist()
    assert len(told.places.section_ids) > SECTIONS
    assert told.places.positions_m.tobytes() == found.places.positions_m.tobytes()
    assert told.places.directions.tobytes() == found.places.directions.tobytes()


@pytest.mark.parametrize("is_damaged", [False, True])
def test_what_is_packed_ahead_takes_the_place_of_the_files_at_the_end(is_damaged: bool, tmp_path: Path) -> None:
    with RunFolder.open(small_run(tmp_path / "one", SECTIONS), writable=True) as run:
        repack_all(run, "fast")
        expected = [run.section_path(i).read_bytes() for i in range(SECTIONS)]
    with RunFolder.open(small_run(tmp_path / "run", SECTIONS), writable=True) as run:
        lossless = run.section_path(0).read_bytes()
        packing = Packing(run, StorageSettings(codec="fast"))
        assert packing.step(2)
        assert Packing(run, StorageSettings(codec="fast")).step(2)  # goes on after a restart
        assert not packing.step(2)
        assert not Packing(run, StorageSettings()).step(2)
        assert run.section_path(0).read_bytes() == lossless
        assert run.packed_path(0).read_bytes() == expected[0]
        if is_damaged:
            cut_in_half(run.packed_path(0))
        repack_all(run, "fast")
        assert [run.section_path(i).read_bytes() for i in range(SECTIONS)] == expected
        assert not run.packed_path(0).parent.exists()
        assert SectionArchive(run).read(1).section_id == 1
        assert {row.codec for row in run.catalog.sections()} == {"fast"}


def test_what_is_dropped_is_dropped_packed_too(tmp_path: Path) -> None:
    with RunFolder.open(small_run(tmp_path / "run", SECTIONS), writable=True) as run:
        packing = Packing(run, StorageSettings(codec="fast"))
        while packing.step(SECTIONS):
            pass
        run.drop_sections(2)
        assert [run.packed_path(i).exists() for i in range(SECTIONS)] == [True, True, False, False]


def test_the_lock_outlives_the_one_who_was_handed_it(tmp_path: Path) -> None:
    path = small_run(tmp_path / "run", 1)
    with RunFolder.open(path, writable=True) as run:
        assert run.lock is not None
        with RunFolder.open(path, writable=True, lock=os.dup(run.lock)) as other:
            write_sections(other, 1, 2)
        assert len(run.catalog.sections()) == 2
        with pytest.raises(RunLocked):
            RunFolder.open(path, writable=True)

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.shm_sections import MAX_FRAMES, SmallSection, frame_bytes, frame_of, sealed_section, section_bytes, spec_of

from vtslam.common.shm.errors import (
    DamagedBlock,
    GenerationGone,
    MapStoreFull,
    NoFreePin,
    SectionNotResident,
    SectionPinned,
    SharedMemoryError,
    WriterAlive,
)
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.process_identity import PID_BITS

_SMALL = SmallSection(section_id=1)


@pytest.fixture
def store(tmp_path: Path) -> MapStore:
    return MapStore(tmp_path / "map", budget_bytes=1 << 26, pins=3)


def test_an_empty_store(store: MapStore) -> None:
    assert (store.active_id(), store.sealed_ids(), store.last_commit(), store.used_bytes()) == (None, [], None, 0)
    assert store.adopt_active() is None
    with pytest.raises(SectionNotResident):
        store.pinned_sealed(1)
    with pytest.raises(SectionNotResident):
        store.pinned_active(1)


def test_what_readers_get_cannot_be_changed(store: MapStore) -> None:
    writer = store.create_active(spec_of(1))
    writer.commit(_SMALL.commit(1))
    active = store.pinned_active(1).state
    sealed = sealed_section(SmallSection(section_id=5), 2)
    store.put_sealed(sealed)
    for section in (active.section, store.pinned_sealed(5).section):
        g = section.gaussians
        for values in (g.pixel, g.depth, g.frame_index, g.subpixel, g.colors, g.log_radii, g.opacity_logits):
            assert not values.flags.writeable
            assert values.base is not None
    assert active.moments is None  # readers have no use for it
    assert not active.frames[0].rgb.flags.writeable


def test_a_commit_that_does_not_continue_the_last_is_refused(store: MapStore) -> None:
    writer = store.create_active(spec_of(1, with_moments=False))
    small = replace(_SMALL, with_moments=False)
    writer.commit(small.commit(1))
    good = small.commit(2)
    moved = replace(good.section.frames[0], T_section_frame=np.zeros((4, 4)))
    for bad, text in (
        (replace(good, section=small.section(1)), "expected 1 frames, the new ones"),
        (replace(good, section=replace(good.section, section_id=2)), "of section 2"),
        (replace(good, section=replace(good.section, frames=(moved, good.section.frames[1]))), "have changed"),
        (replace(good, facts=bytes(70_000)), "at most 61440 bytes of facts"),
        (replace(good, neighbour_ids=tuple(range(9))), "8 neighbours, got 2 and 9|got 200 and 9"),
        (replace(good, moments=SmallSection(section_id=1).moments(2)), "without optimiser state"),
        (replace(good, new_frames=small.commit(1).new_frames), "is not that of the frame table"),
        (replace(good, section=replace(good.section, gaussians=small.section(0).gaussians)), "expected 50 to"),
    ):
        with pytest.raises(ValueError, match=text):
            writer.commit(bad)
    assert writer.generation == 1
    assert writer.commit(good) == 2


def test_one_active_section_and_no_second_sealing(store: MapStore) -> None:
    writer = store.create_active(spec_of(1))
    with pytest.raises(SharedMemoryError, match="expected no active section"):
        store.create_active(spec_of(2))
    with pytest.raises(ValueError, match="not what was committed last"):
        store.seal(writer, _SMALL.section(1), b"")
    writer.commit(_SMALL.commit(1))
    store.seal(writer, sealed_section(_SMALL, 1), b"")
    with pytest.raises(SharedMemoryError, match="no sealed section 1"):
        store.create_active(spec_of(1))
    with pytest.raises(SharedMemoryError, match="never changes"):
        store.put_sealed(sealed_section(_SMALL, 1))
    assert len(list(store_files(store))) == 2


def store_files(store: MapStore) -> list[str]:
    return sorted(path.name for path in store._folder.iterdir())


def test_generations_by_number(store: MapStore) -> None:
    writer = store.create_active(spec_of(1, kept_generations=2))
    for frames in (1, 2, 3):
        writer.commit(_SMALL.commit(frames))
    assert [store.pinned_active(1, n).state.generation for n in (2, 3)] == [2, 3]
    for gone in (1, 4, 0):
        with pytest.raises(GenerationGone):
            store.pinned_active(1, gone)
    store.pinned_active(1)
    with pytest.raises(NoFreePin):
        store.pinned_active(1)


def test_buffers_are_given_back(store: MapStore) -> None:
    writer = store.create_active(spec_of(1, with_moments=False))
    small = replace(_SMALL, with_moments=False)
    held = []
    for frames in (1, 2, 3, 4):
        writer.commit(small.commit(frames))
        held += [store.pinned_active(1)] if frames < 4 else []
    folder = store._folder / "active-000001"
    assert len(list(folder.glob("learned-*"))) == 4
    for pin in held:
        pin.release()
    writer.commit(small.commit(5))
    assert len(list(folder.glob("learned-*"))) == 2


def test_what_the_next_commit_takes_is_reserved_before(store: MapStore) -> None:
    few = replace(_SMALL, rows=0)
    writer = store.create_active(spec_of(1))
    for frames in (1, 2, 3):  # until both files of moments and the spare buffer are there
        writer.commit(few.commit(frames))
    ready = []
    for frames in (4, 5):
        writer.make_ready()
        ready.append(store.used_bytes())
        writer.make_ready()
        assert store.used_bytes() == ready[-1]
        writer.commit(few.commit(frames))
        assert store.used_bytes() == ready[-1]
    assert ready[1] > ready[0]


def test_room_that_is_not_there_is_for_the_commit_to_miss(tmp_path: Path) -> None:
    store = MapStore(tmp_path / "map", budget_bytes=1 << 26, pins=3)
    writer = store.create_active(spec_of(1))
    writer.commit(_SMALL.commit(1))
    used = store.budget_bytes = store.used_bytes()
    writer.make_ready()
    assert store.used_bytes() == used
    with pytest.raises(MapStoreFull):
        writer.commit(_SMALL.commit(2))
    store.budget_bytes = 1 << 26
    assert writer.commit(_SMALL.commit(2)) == 2


def test_no_image_is_reserved_beyond_the_last(store: MapStore) -> None:
    writer = store.create_active(spec_of(1))
    for frames in range(1, MAX_FRAMES + 1):
        writer.commit(_SMALL.commit(frames))
    used = store.used_bytes()
    writer.make_ready()
    assert store.used_bytes() == used


def test_only_verified_and_unpinned_sections_leave(store: MapStore) -> None:
    store.put_sealed(sealed_section(_SMALL, 2))
    with pytest.raises(SharedMemoryError, match="not verified"):
        store.unlink_sealed(1, verified_on_disk=False)
    held = store.pinned_sealed(1)
    assert [r.pinned_by != () for r in store.residents()] == [True]
    with pytest.raises(SectionPinned):
        store.unlink_sealed(1, verified_on_disk=True)
    held.release()
    assert store.residents()[0].pinned_by == ()
    store.unlink_sealed(1, verified_on_disk=True)
    store.unlink_sealed(1, verified_on_disk=True)
    assert store.used_bytes() == 0
    assert section_bytes(held.section) == section_bytes(sealed_section(_SMALL, 2))  # mapped, so still there


def test_a_section_without_gaussians(store: MapStore) -> None:
    small = SmallSection(section_id=3, rows=0)
    writer = store.create_active(spec_of(3))
    writer.commit(small.commit(1))
    store.seal(writer, sealed_section(small, 1), b"x" * 61440)
    assert section_bytes(store.pinned_sealed(3, verify=True).section) == section_bytes(sealed_section(small, 1))
    last = store.last_commit()
    assert last is not None
    assert len(last.facts) == 61440


def test_damage_is_noticed(store: MapStore) -> None:
    store.put_sealed(sealed_section(_SMALL, 2))
    with open(store._folder / "sealed-000001", "r+b") as file:
        file.seek(5000)
        file.write(b"\x99")
    store.pinned_sealed(1).release()
    with pytest.raises(DamagedBlock, match="checksum of the columns"):
        store.pinned_sealed(1, verify=True)
    writer = store.create_active(spec_of(2))
    writer.commit(SmallSection(section_id=2).commit(1))
    with open(store._folder / "active-000002" / "learned-0", "r+b") as file:
        file.seek(20)
        file.write(b"\x99")
    with pytest.raises(DamagedBlock, match="checksum of the commit record"):
        store.pinned_active(2)
    with pytest.raises(DamagedBlock):
        store.adopt_active()


def test_a_living_writer_is_not_taken_over(store: MapStore) -> None:
    store.create_active(spec_of(1))
    control = np.memmap(store._folder / "active-000001" / "control", np.uint64, "r+")
    control[4] = 1 | int(Path("/proc/1/stat").read_text().rpartition(")")[2].split()[19]) << PID_BITS
    with pytest.raises(WriterAlive):
        store.adopt_active()


def test_sealed_sections_with_a_leftover_of_their_making_stay(store: MapStore) -> None:
    store.put_sealed(sealed_section(_SMALL, 2))
    (store._folder / "active-000001").mkdir()
    with pytest.raises(SectionPinned, match="active block has to be removed first"):
        store.unlink_sealed(1, verified_on_disk=True)
    assert store.adopt_active() is None
    store.unlink_sealed(1, verified_on_disk=True)
    assert store_files(store) == []


@pytest.mark.parametrize("change", [{"max_frames": 0}, {"max_gaussians": 0}, {"section_id": -1}])
def test_impossible_sections_are_refused(change: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="an active section needs"):
        replace(spec_of(1), **change)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="1 to 4 kept generations"):
        replace(spec_of(1), kept_generations=5)


def test_a_store_begins_with_a_section_from_disk(store: MapStore) -> None:
    section = sealed_section(SmallSection(section_id=4), 2)
    store.restore(section, frame_of(9), b"facts")
    last = store.last_commit()
    assert last is not None
    assert (last.section_id, last.frame_index, last.facts, last.is_sealed) == (4, 1, b"facts", True)
    assert frame_bytes(last.frame) == frame_bytes(frame_of(9))
    assert section_bytes(store.pinned_sealed(4, verify=True).section) == section_bytes(section)
    assert (store.active_id(), store.adopt_active()) == (None, None)
    assert store.create_active(spec_of(5)).section_id == 5

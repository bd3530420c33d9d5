"""Copies of the map store without pins: whole, or refused."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from helpers.shm_sections import SmallSection, frame_bytes, sealed_section, section_bytes, spec_of, state_bytes

from vtslam.common.shm import active_reader
from vtslam.common.shm.active_layout import read_record
from vtslam.common.shm.errors import DamagedBlock, GenerationGone, SectionNotResident
from vtslam.common.shm.map_store import MapStore

_SMALL = SmallSection(section_id=1, with_moments=False)


@pytest.fixture
def store(tmp_path: Path) -> MapStore:
    return MapStore(tmp_path / "map", budget_bytes=1 << 26, pins=3)


def test_a_copy_is_the_last_commit_and_stays_what_it_was(store: MapStore) -> None:
    writer = store.create_active(spec_of(1, with_moments=False))
    reader = store.active_reader(1)
    with pytest.raises(SectionNotResident, match="nothing was committed"):
        reader.copied()
    writer.commit(_SMALL.commit(1))
    writer.commit(_SMALL.commit(2))
    copied, held = reader.copied(), reader.pinned()
    expected = state_bytes(held.state)
    held.release()
    for frames in range(3, 7):
        writer.commit(_SMALL.commit(frames))
    assert state_bytes(copied) == expected


@pytest.mark.parametrize(("kept", "meanwhile", "is_whole"), [(1, 0, True), (1, 1, False), (3, 2, True), (3, 3, False)])
def test_a_copy_is_refused_once_the_writer_may_have_overtaken_it(
    kept: int, meanwhile: int, is_whole: bool, store: MapStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = store.create_active(spec_of(1, with_moments=False, kept_generations=kept))
    writer.commit(_SMALL.commit(1))

    def overtaken(path: Path, learned: npt.NDArray[np.uint8]) -> object:
        found = read_record(path, learned)
        for frames in range(2, 2 + meanwhile):
            writer.commit(_SMALL.commit(frames))
        return found

    monkeypatch.setattr(active_reader, "read_record", overtaken)
    if is_whole:
        assert store.active_reader(1).copied().generation == 1
    else:
        with pytest.raises(GenerationGone, match="generation 1 was overwritten"):
            store.active_reader(1).copied()


def test_a_record_that_was_torn_by_the_writer_is_gone_and_not_damaged(
    store: MapStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = store.create_active(spec_of(1, with_moments=False))
    writer.commit(_SMALL.commit(1))
    reader = store.active_reader(1)

    def torn(path: Path, learned: object) -> object:
        for frames in (2, 3, 4):
            writer.commit(_SMALL.commit(frames))
        raise DamagedBlock("the checksum does not fit")

    monkeypatch.setattr(active_reader, "read_record", torn)
    with pytest.raises(GenerationGone):
        reader.copied()
    monkeypatch.setattr(active_reader, "read_record", read_record)
    assert reader.copied().generation == 4


def test_a_copy_of_a_sealed_section_holds_nothing_and_outlives_it(store: MapStore) -> None:
    section = sealed_section(_SMALL, 2)
    store.put_sealed(section)
    used_ns = store.residents()[0].last_used_ns
    copied = store.copied_sealed(1)
    assert store.residents()[0].pinned_by == ()
    assert store.residents()[0].last_used_ns == used_ns
    store.unlink_sealed(1, verified_on_disk=True)
    assert section_bytes(copied) == section_bytes(section)
    with pytest.raises(SectionNotResident):
        store.copied_sealed(1)


def test_the_last_commit_of_a_sealed_section(store: MapStore) -> None:
    assert store.last_sealed_commit() is None
    writer = store.create_active(spec_of(1, with_moments=False))
    writer.commit(_SMALL.commit(1))
    assert store.last_sealed_commit() is None
    store.seal(writer, sealed_section(_SMALL, 1), b"facts")
    last = store.last_sealed_commit()
    assert last is not None
    assert (last.section_id, last.frame_index, last.facts, last.is_sealed) == (1, 0, b"facts", True)
    assert frame_bytes(last.frame) == frame_bytes(_SMALL.frame(0))

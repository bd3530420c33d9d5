"""Which sealed sections leave the map store of a fleet."""

from pathlib import Path

from helpers.shm_sections import SmallSection, sealed_section

from vtslam.common.shm.map_store import MapStore
from vtslam.services.supervisor.residency import Residency

SECTIONS = 6


def _filled(folder: Path) -> tuple[MapStore, int]:
    """A store with a few sections and no room for more; bytes of one."""
    probe = MapStore(folder / "probe", budget_bytes=1 << 26)
    probe.put_sealed(sealed_section(SmallSection(section_id=1), 2))
    size = probe.used_bytes()
    store = MapStore(folder / "map", budget_bytes=SECTIONS * size)
    for section_id in range(1, SECTIONS + 1):
        store.put_sealed(sealed_section(SmallSection(section_id=section_id), 2))
    return store, size


def test_the_section_used_least_recently_leaves_so_that_the_next_fits(tmp_path: Path) -> None:
    store, size = _filled(tmp_path)
    store.pinned_sealed(1).release()
    residency = Residency(store)
    residency.step(SECTIONS, squeeze=False)

    assert store.sealed_ids() == [1, 4, 5, 6]  # two, for one and a quarter
    assert store.free_bytes() >= 1.25 * size
    assert (residency.peak_bytes, residency.sealed_bytes) == (SECTIONS * size, SECTIONS * size)
    residency.step(SECTIONS, squeeze=False)
    assert store.sealed_ids() == [1, 4, 5, 6]


def test_what_is_pinned_or_not_on_disk_stays(tmp_path: Path) -> None:
    store, _ = _filled(tmp_path)
    held = store.pinned_sealed(2)
    Residency(store).step(4, squeeze=True)
    assert store.sealed_ids() == [2, 4, 5, 6]
    held.release()


def test_all_but_the_last_leave_when_mapping_waits(tmp_path: Path) -> None:
    store, _ = _filled(tmp_path)
    Residency(store).step(SECTIONS, squeeze=True)
    assert store.sealed_ids() == [SECTIONS]

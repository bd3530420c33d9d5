"""Which finished sections of a fleet are in memory."""

import numpy as np

from vtslam.common.shm.residency import ResidentFacts, ViewPlaces
from vtslam.services.archiver.core import CameraAt, Residency, Residents, StoreFacts, sections_ahead

SECTIONS, SIZE = 6, 100
MAPPING = 40  # beside the sections


Facts = tuple[StoreFacts, Residents]


def _facts(present: list[int], *, pinned: int = -1, durable: int = SECTIONS + 1, mapping: int = 0) -> Facts:
    """Sections of equal size, used in their order, in a store of six of them."""
    residents = tuple(
        ResidentFacts(section_id=i, num_bytes=SIZE, last_used=i, is_pinned=i == pinned, is_verified=i < durable)
        for i in present
    )
    used = SIZE * len(residents) + mapping
    sealed = (SIZE,) * len(residents)
    return StoreFacts(used_bytes=used, free_bytes=SECTIONS * SIZE - used, sealed_bytes=sealed), lambda: residents


def _after(facts: Facts) -> Residency:
    residency = Residency()
    residency.observe(facts[0])
    return residency


def test_sections_leave_so_that_the_next_one_fits() -> None:
    full = _facts([1, 2, 3, 4, 5, 6])
    assert _after(full).leaving(*full, squeeze=False) == (1, 2)  # two, for one and a quarter
    assert _after(full).leaving(*_facts([3, 4, 5, 6]), squeeze=False) == ()
    assert _after(full).leaving(*full, squeeze=False, spared=[1, 3]) == (2, 4)


def test_what_mapping_took_is_kept_free_for_the_next_section() -> None:
    residency = _after(_facts([1, 2, 3, 4, 5], mapping=MAPPING))
    assert residency.leaving(*_facts([1, 2, 3, 4, 5]), squeeze=False) == (1,)  # 175 of 100 are wanted
    assert residency.leaving(*_facts([1, 2, 3, 4, 5], mapping=MAPPING), squeeze=False) == (1,)


def test_what_is_pinned_or_not_on_disk_stays() -> None:
    full = _facts([1, 2, 3, 4, 5, 6], pinned=2, durable=4)
    assert _after(full).leaving(*full, squeeze=True) == (1, 3)


def test_all_but_the_last_leave_when_mapping_waits() -> None:
    full = _facts([1, 2, 3, 4, 5, 6])
    assert _after(full).leaving(*full, squeeze=True) == (1, 2, 3, 4, 5)


def test_a_section_comes_back_only_beside_what_mapping_needs() -> None:
    residency = _after(_facts([1, 2, 3, 4], mapping=MAPPING))  # 175 stay free
    assert residency.room_for(*_facts([1, 2, 3]), SIZE) == ()
    assert residency.room_for(*_facts([1, 2, 3, 4]), SIZE) == (1,)
    assert residency.room_for(*_facts([1, 2, 3, 4]), SIZE, spared=[1]) == (2,)
    assert residency.room_for(*_facts([1, 2, 3, 4], durable=1), SIZE) is None
    assert residency.room_for(*_facts([4]), 5 * SIZE) is None


def test_nobody_is_looked_at_while_there_is_room() -> None:
    def look() -> tuple[ResidentFacts, ...]:
        raise AssertionError("a look at each section takes a while")

    few, _ = _facts([1, 2, 3])
    residency = _after((few, look))
    assert residency.leaving(few, look, squeeze=False) == ()
    assert residency.room_for(few, look, SIZE) == ()


def test_sections_ahead_are_those_near_to_where_the_next_head_will_be() -> None:
    places = ViewPlaces(
        section_ids=np.arange(10),
        positions_m=np.stack([np.zeros(10), np.zeros(10), 10.0 * np.arange(10)], axis=1),
        directions=np.tile([0.0, 0.0, 1.0], (10, 1)),
    )

    def seen(frame_id: int, z_m: float) -> CameraAt:
        T = np.eye(4)
        T[2, 3] = z_m
        return CameraAt(frame_id=frame_id, frame_index=frame_id % 10, T_world_camera=T)

    # One metre a frame, six frames to the next head: at 30 m; ten metres to a section.
    assert sections_ahead(places, seen(20, 20.0), seen(24, 24.0), section_length=10, at_most=9) == [3, 2, 4]
    assert sections_ahead(places, seen(20, 20.0), seen(24, 24.0), section_length=10, at_most=1) == [3]
    assert sections_ahead(places, seen(20, 30.0), seen(24, 30.0), section_length=10, at_most=9) == [3]
    assert sections_ahead(places, seen(20, 35.0), seen(24, 35.0), section_length=10, at_most=9) == []

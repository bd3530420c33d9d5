import numpy as np

from vtslam.common.shm.residency import (
    Admission,
    ResidentFacts,
    ViewPlaces,
    make_room,
    predicted_position_m,
    to_prefetch,
    wanted_soon,
)


def _facts(section_id: int, last_used: int, *, pinned: bool = False, verified: bool = True) -> ResidentFacts:
    return ResidentFacts(
        section_id=section_id, num_bytes=10, last_used=last_used, is_pinned=pinned, is_verified=verified
    )


def test_what_fits_needs_no_room() -> None:
    plan = make_room([_facts(1, 1)], wanted_bytes=5, used_bytes=10, budget_bytes=15)
    assert (plan.admission, plan.leaving, plan.missing_bytes) == (Admission.OPEN, (), 0)


def test_the_least_recently_used_leave_first_and_no_more_than_needed() -> None:
    residents = [_facts(1, 30), _facts(2, 10), _facts(3, 20)]
    plan = make_room(residents, wanted_bytes=11, used_bytes=30, budget_bytes=30)
    assert plan.leaving == (2, 3)
    assert plan.admission is Admission.OPEN


def test_those_wanted_soon_leave_last() -> None:
    residents = [_facts(1, 1), _facts(2, 2), _facts(3, 3)]
    assert make_room(residents, wanted_bytes=10, used_bytes=30, budget_bytes=30, wanted_soon=[1]).leaving == (2,)
    plan = make_room(residents, wanted_bytes=30, used_bytes=30, budget_bytes=30, wanted_soon=[1])
    assert plan.leaving == (2, 3, 1)


def test_pinned_and_unverified_sections_stay_and_admission_stops() -> None:
    residents = [_facts(1, 1, pinned=True), _facts(2, 2, verified=False), _facts(3, 3)]
    plan = make_room(residents, wanted_bytes=20, used_bytes=30, budget_bytes=30)
    assert (plan.admission, plan.leaving, plan.missing_bytes) == (Admission.STOPPED, (), 10)
    assert make_room(residents, wanted_bytes=10, used_bytes=30, budget_bytes=30).leaving == (3,)


def test_more_than_the_budget_never_fits() -> None:
    assert make_room([], wanted_bytes=31, used_bytes=0, budget_bytes=30).admission is Admission.IMPOSSIBLE
    assert make_room([], wanted_bytes=30, used_bytes=1, budget_bytes=30).admission is Admission.STOPPED


def test_ties_in_time_are_broken_by_id() -> None:
    residents = [_facts(2, 1), _facts(1, 1)]
    assert make_room(residents, wanted_bytes=10, used_bytes=20, budget_bytes=20).leaving == (1,)


def test_sections_near_the_predicted_position_nearest_first() -> None:
    at_m = np.stack([np.arange(20) / 2.0, np.zeros(20), np.zeros(20)], axis=1)  # two views a section
    looks = np.tile([0.0, 0.0, 1.0], (20, 1))
    looks[14:16] = [0.0, 0.0, -1.0]
    places = ViewPlaces(section_ids=np.arange(20) // 2, positions_m=at_m, directions=looks)
    ahead = predicted_position_m(at_m[6], at_m[8], frames_ahead=2)
    assert ahead.tolist() == [6.0, 0.0, 0.0]
    along = np.array([0.0, 0.0, 1.0])
    assert wanted_soon(places, ahead, along, radius_m=1.2, at_most=10) == [6, 5]  # 7 looks back
    assert wanted_soon(places, ahead, -along, radius_m=1.2, at_most=10) == [7]
    assert wanted_soon(places, ahead, along, radius_m=1.2, at_most=1) == [6]
    assert to_prefetch([6, 5, 7], resident=[5], loading=[7]) == [6]

"""How many threads the processes of a fleet work with."""

import os

import pytest

from vtslam.common.preset_loading import load_settings
from vtslam.services.engines import fleet_threads


@pytest.mark.parametrize(
    ("own", "is_realtime", "splat_threads", "expected"),
    [(0, False, 0, 0), (0, True, 0, 3), (5, True, 0, 5), (0, True, 4, 0), (2, False, 4, 2)],
)
def test_in_realtime_tracker_and_mapper_share_the_cores_unless_threads_are_set(
    own: int, is_realtime: bool, splat_threads: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(6)))
    settings = load_settings(preset="fast", family="tum", file=None, assignments=[f"splat.threads={splat_threads}"])
    assert fleet_threads(settings, own, is_realtime=is_realtime) == expected


def test_a_single_core_still_works_with_one_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    settings = load_settings(preset="fast", family="tum", file=None, assignments=[])
    assert fleet_threads(settings, 0, is_realtime=True) == 1

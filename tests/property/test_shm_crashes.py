"""Processes that die inside writes to shared memory, at every fail point and anywhere else."""

import pytest
from helpers.forks import run_script

from vtslam.common import failpoints


def test_ring_after_every_fail_point() -> None:
    passages = run_script("shm_crashes", "ring", "points")
    assert set(passages) >= {name for name in failpoints.NAMES if name.startswith("shm.ring.")}
    assert all(count >= 1 for count in passages.values()), passages


def test_map_store_after_every_fail_point() -> None:
    passages = run_script("shm_crashes", "store", "points")
    assert set(passages) == {
        name for name in failpoints.NAMES if name.startswith("shm.") and not name.startswith(("shm.ring.", "shm.put."))
    }
    assert all(count >= 1 for count in passages.values()), passages


@pytest.mark.parametrize("what", ["ring", "store"])
def test_kills_at_any_instruction(what: str) -> None:
    assert run_script("shm_crashes", what, "anywhere", "5") >= 12

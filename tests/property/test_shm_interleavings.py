"""A writer beside readers in other processes, some of which stop or die while they hold something."""

from helpers.forks import run_script


def test_ring_that_overwrites() -> None:
    counted = run_script("shm_interleavings", "ring")
    assert counted["published"] > 0
    assert counted["lost"] > 0  # nothing was acknowledged, so every frame that went is counted
    assert counted["lost"] <= counted["published"]


def test_ring_that_waits_loses_nothing() -> None:
    counted = run_script("shm_interleavings", "ring-waiting")
    assert counted["published"] >= 150
    assert counted["lost"] == 0


def test_map_store_generations() -> None:
    counted = run_script("shm_interleavings", "store")
    assert counted["generations"] > 1
    assert counted["buffers"] <= 5 + 2 + 1  # pins, kept generations, the one being written

"""What is told of a fleet's processor time and memory, from looks at known values."""

from array import array

import pytest

from vtslam.services.bench.fleet_watch import FleetWatch


def watch_of(at_frames: list[int], cpu_s: list[float], rss_mb: list[float]) -> FleetWatch:
    cpu, rss = array("d", cpu_s), array("d", rss_mb)
    return FleetWatch(frames=16, at_frames=array("q", at_frames), cpu_s={"mapper": cpu}, rss_mb={"mapper": rss})


def test_growth_of_memory_is_that_from_the_second_to_the_last_quarter() -> None:
    watch = watch_of([0, 4, 7, 8, 12, 16], [0.0] * 6, [900.0, 40.0, 50.0, 800.0, 30.0, 60.0])
    assert watch.rss_growth() == {"mapper": pytest.approx(1.2)}


def test_growth_is_unknown_where_nobody_looked() -> None:
    assert watch_of([0, 16], [0.0] * 2, [40.0, 50.0]).rss_growth() == {"mapper": None}


def test_processor_time_of_frames_between_looks_is_shared_out() -> None:
    watch = watch_of([0, 8, 16], [1.0, 3.0, 7.0], [40.0] * 3)
    assert watch.cpu_s_per_frame((4, 8)) == {"mapper": pytest.approx(0.25)}
    assert watch.cpu_s_per_frame((4, 16)) == {"mapper": pytest.approx(5.0 / 12.0)}

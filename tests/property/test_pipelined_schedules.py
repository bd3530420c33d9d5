"""A pipelined fleet under any order of events and any deaths: the result is always the same."""

from functools import lru_cache

import pytest
from helpers.fleet_world import Result, Stream, run_world, settings_of

from vtslam.common.bus_schedule import KillAt, ScriptedSchedule, SeededKills, SeededSchedule
from vtslam.services.pacing import Pace, Pacing

_SECTION, _FRAMES = 5, 7  # a whole section and the beginning of one
_PATH, _SIZE = 96, (32, 24)  # motion that tracking can follow
_SEEDS = 12


def stream(lead: int) -> Stream:
    pacing = Pacing.PIPELINED if lead else Pacing.LOCKSTEP
    return Stream(
        frames=_FRAMES, path=_PATH, size=_SIZE, settings=settings_of(_SECTION), pace=Pace(pacing=pacing, lead=lead)
    )


@lru_cache(maxsize=3)
def undisturbed(lead: int) -> Result:
    return run_world(ScriptedSchedule(), stream=stream(lead))[0]


def test_frames_are_tracked_against_an_older_map_where_they_may_be_ahead() -> None:
    lockstep, pipelined = undisturbed(0), undisturbed(1)
    assert pipelined.poses[:2] == lockstep.poses[:2]  # a head, and the frame after it, wait for the one before
    assert all(ahead != waited for ahead, waited in zip(pipelined.poses[2:_SECTION], lockstep.poses[2:], strict=False))
    assert undisturbed(2) not in (lockstep, pipelined)


@pytest.mark.parametrize("name", ["tracker", "mapper"])
def test_a_death_at_every_point_of_a_service(name: str) -> None:
    _, calm = run_world(ScriptedSchedule(), stream=stream(1))
    points = [point for service, point in calm.passed if service == name]
    for point in sorted(set(points)):
        passages = [passage for passage, passed in enumerate(points) if passed == point]
        passage = passages[len(passages) // 2]  # somewhere within the stream
        result, world = run_world(ScriptedSchedule(), KillAt(name, passage), stream=stream(1))
        assert world.deaths == [(name, points[passage])]
        assert result == undisturbed(1), f"{name} killed at {points[passage]}, passage {passage}"


@pytest.mark.parametrize("lead", [1, 2])
def test_any_order_with_any_deaths(lead: int) -> None:
    for seed in range(_SEEDS):
        result, world = run_world(
            SeededSchedule(seed), SeededKills(seed, probability=0.03, limit=6), stream=stream(lead)
        )
        assert result == undisturbed(lead), f"seed {seed}, deaths {world.deaths}"

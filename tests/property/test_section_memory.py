"""Sections that end because the map store could hold no more: the same for all, in any order and with any deaths."""

from functools import lru_cache

import pytest
from helpers.fleet_world import (
    Archiving,
    FewFrames,
    Result,
    Stream,
    fleet_world,
    in_one_process,
    run_world,
    settings_of,
)

from vtslam.common.bus_schedule import ScriptedSchedule, SeededKills, SeededSchedule
from vtslam.common.settings import Settings
from vtslam.services.pacing import Pace, Pacing

_FRAMES, _LENGTH, _PATH = 14, 12, 24
_BUDGETS_MB = {0: 3, 1: 4, 2: 5}  # by lead: of some such frames
_SIZE = (40, 30)
_SEEDS = 3


def settings_for(lead: int) -> Settings:
    return settings_of(_LENGTH, f"fleet.map_budget_mb={_BUDGETS_MB[lead]}")


def stream(lead: int) -> Stream:
    return Stream(
        frames=_FRAMES,
        path=_PATH,
        size=_SIZE,
        settings=settings_for(lead),
        pace=Pace(pacing=Pacing.PIPELINED if lead else Pacing.LOCKSTEP, lead=lead),
        archiver=Archiving(budget_bytes=_BUDGETS_MB[lead] * 10**6),
    )


@lru_cache(maxsize=3)
def undisturbed(lead: int) -> Result:
    if lead == 0:
        return in_one_process(FewFrames(_FRAMES, _PATH, _SIZE), settings_for(0))[0]
    return run_world(ScriptedSchedule(), stream=stream(lead))[0]


@pytest.mark.parametrize("lead", [0, 1, 2])
def test_a_section_ends_before_memory_does(lead: int) -> None:
    with fleet_world(ScriptedSchedule(), stream=stream(lead)) as fleet:
        assert fleet.run() == undisturbed(lead)
        assert fleet.degraded == {}
    num_sections = len(undisturbed(lead).sections)
    assert -(-_FRAMES // _LENGTH) < num_sections < _FRAMES


@pytest.mark.parametrize("lead", [0, 1, 2])
def test_any_order_with_any_deaths(lead: int) -> None:
    for seed in range(_SEEDS):
        kills = SeededKills(seed, probability=0.02, limit=5)
        result, world = run_world(SeededSchedule(seed), kills, stream=stream(lead))
        assert result == undisturbed(lead), f"seed {seed}, deaths {world.deaths}"

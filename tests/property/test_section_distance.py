"""Sections that end after a distance: the same in one process and in a fleet, in any order and with any deaths."""

from functools import lru_cache

import pytest
from helpers.fleet_world import FewFrames, Result, Sections, Stream, in_one_process, run_world, settings_of

from vtslam.common.bus_schedule import ScriptedSchedule, SeededKills, SeededSchedule
from vtslam.common.section_end import SectionEnd, poses_in
from vtslam.services.pacing import Pace, Pacing

_FRAMES, _LENGTH, _LENGTH_M = 11, 4, 0.04
_PATH, _SIZE = 96, (32, 24)  # motion that tracking can follow
_SETTINGS = settings_of(_LENGTH, f"section.length_m={_LENGTH_M}")
_SEEDS = 5


def stream(lead: int) -> Stream:
    pacing = Pacing.PIPELINED if lead else Pacing.LOCKSTEP
    return Stream(frames=_FRAMES, path=_PATH, size=_SIZE, settings=_SETTINGS, pace=Pace(pacing=pacing, lead=lead))


@lru_cache(maxsize=1)
def alone() -> tuple[Result, Sections]:
    return in_one_process(FewFrames(_FRAMES, _PATH, _SIZE), _SETTINGS)


@lru_cache(maxsize=3)
def undisturbed(lead: int) -> Result:
    return alone()[0] if lead == 0 else run_world(ScriptedSchedule(), stream=stream(lead))[0]


def test_sections_end_by_frames_or_by_metres() -> None:
    _, sections = alone()
    lengths = [len(section.frames) for section in sections.written.values()]
    assert sum(lengths) == _FRAMES
    assert max(lengths) == _LENGTH > min(lengths[:-1])
    for section in list(sections.written.values())[:-1]:
        poses, end = poses_in(section), SectionEnd.of(_SETTINGS, section.camera)
        assert end.is_reached_by_poses(poses)
        assert not end.is_reached_by_poses(poses[:-1])


@pytest.mark.parametrize("lead", [0, 1, 2])
def test_any_order_with_any_deaths(lead: int) -> None:
    assert run_world(ScriptedSchedule(), stream=stream(lead))[0] == undisturbed(lead)
    for seed in range(_SEEDS):
        kills = SeededKills(seed, probability=0.02, limit=5)
        result, world = run_world(SeededSchedule(seed), kills, stream=stream(lead))
        assert result == undisturbed(lead), f"seed {seed}, deaths {world.deaths}"

"""A fleet in realtime with a source of 60 frames a second and a mapper that manages about 3: simulated time."""

import tempfile
from pathlib import Path

import pytest
from helpers.fleet_world import PRIORS, settings_of
from helpers.realtime_world import RealtimeResult, RealtimeWorld

from vtslam.common import failpoints
from vtslam.common.bus_schedule import Kills, NoKills, SeededKills, SeededSchedule
from vtslam.common.fleet_folder import shared_memory_folder

_SERVICES = ("sensor", "tracker", "mapper")
_FRAMES, _SECTION = 80, 3
_SECONDS = {"tracker": 0.04, "mapper": 0.15}  # a frame is mapped in two steps: mapping and commit
_LATE_S = 2 * _SECONDS["tracker"] + 2 / 60  # one frame at work, another one that came meanwhile


class _OneDeathEach:
    """Each service dies at most once: a simulated death leaves its pins in the ring, unlike a process's."""

    def __init__(self, seed: int) -> None:
        self._kills = {name: SeededKills(seed + i, probability=0.01, limit=1) for i, name in enumerate(_SERVICES)}

    def dies(self, service: str, point: str) -> bool:
        return service in self._kills and self._kills[service].dies(service, point)


def realtime_run(seed: int, kills: Kills, priors: tuple[int, ...] = PRIORS) -> RealtimeResult:
    with tempfile.TemporaryDirectory(dir=shared_memory_folder()) as name, pytest.MonkeyPatch.context() as patch:
        fleet = RealtimeWorld(
            Path(name),
            SeededSchedule(seed),
            settings_of(_SECTION),
            frames=_FRAMES,
            seconds=_SECONDS,
            kills=kills,
            priors=priors,
        )
        patch.setattr(failpoints, "reach", fleet.world.point)
        try:
            return fleet.run()
        finally:
            fleet.world.close()


@pytest.mark.parametrize("seed", range(2))
def test_a_fast_source_and_a_slow_mapper(seed: int) -> None:
    result = realtime_run(seed, NoKills())

    assert result.published == _FRAMES == result.tracked + result.dropped
    assert 0 < len(result.mapped) < result.tracked < _FRAMES
    assert result.mapped == [frame_id for section in result.sections for frame_id in section]
    assert all(len(section) == _SECTION for section in result.sections[:-1])
    waited_s, *ages_s = result.ages_s  # after its first frame the tracker waits for a map
    assert waited_s < 1.0
    assert max(ages_s) < _LATE_S


def test_frames_are_counted_once_whoever_dies() -> None:
    deaths = 0
    for seed in range(5):
        result = realtime_run(seed, _OneDeathEach(seed))
        deaths += len(result.deaths)
        assert result.published == _FRAMES == result.tracked + result.dropped, f"seed {seed}, {result.deaths}"
        assert result.mapped == [frame_id for section in result.sections for frame_id in section], f"seed {seed}"
    assert deaths > 6


def test_poses_that_begin_after_the_first_frame_are_ignored_and_counted() -> None:
    assert realtime_run(0, NoKills(), tuple(range(_FRAMES))).ignored == 0
    late = realtime_run(0, NoKills(), tuple(range(1, _FRAMES)))
    assert late.ignored == late.tracked - 1

"""A fleet with an archiver in little memory, under any order of events and any deaths: the result of one process."""

import re

import pytest
from helpers.fleet_world import Archiving, Stream, expected, fleet_world, run_world, settings_of

from vtslam.common.bus_schedule import Kills, ScriptedSchedule, SeededKills, SeededSchedule
from vtslam.services.mapper.service import MapperService

_FRAMES, _FEW = 15, 11
_SETTINGS = settings_of(2, "mapper.keep_moments=false", "tracker.overlap.max_sections=5", "storage.codec='dense'")
_TIGHT_BYTES = 596_000  # a section while it is mapped, the one before it, and few more
_WRITING = {f"run.section.{point}" for point in ("before_write", "after_write", "after_catalog", "after_trajectory")}
_WRITING |= {"publish section/archived before", "publish section/archived after"}
_LOADING = {"shm.sealed.after_reserve", "shm.sealed.after_columns", "shm.put.after_write", "shm.put.after_link"}
_LOADING |= {"reply section/load before", "reply section/load after"}
_SEEDS = 4


def _stream(archiving: Archiving) -> Stream:
    return Stream(frames=_FRAMES, settings=_SETTINGS, archiver=archiving)


class OnlyOf:
    """Some kills, of one service alone."""

    def __init__(self, service: str, kills: Kills) -> None:
        self._service, self._kills = service, kills

    def dies(self, service: str, point: str) -> bool:
        return service == self._service and self._kills.dies(service, point)


class KillAtEach:
    """The archiver dies once at each of some points."""

    def __init__(self, points: set[str]) -> None:
        self._points = set(points)

    def dies(self, service: str, point: str) -> bool:
        if service != "archiver" or point not in self._points:
            return False
        self._points.remove(point)
        return True


def test_sections_leave_and_come_back() -> None:
    with fleet_world(ScriptedSchedule(), stream=_stream(Archiving(budget_bytes=_TIGHT_BYTES))) as fleet:
        assert fleet.run() == expected(_SETTINGS, _FRAMES)
        assert fleet.count("archiver", "sections.archived") == 8
        assert fleet.count("archiver", "sections.reloaded") > fleet.count("archiver", "sections.prefetched") > 0
        assert fleet.count("archiver", "sections.packed") > 0
        assert fleet.degraded == {}
        assert fleet.events() == []


def test_the_mapper_hears_of_archived_sections_also_while_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    real, unread = MapperService.step, []

    def step(mapper: MapperService) -> float | None:
        patience_s = real(mapper)
        unread.append(mapper._archived.waiting)
        return patience_s

    monkeypatch.setattr(MapperService, "step", step)
    result, _ = run_world(ScriptedSchedule(), stream=_stream(Archiving(budget_bytes=1 << 30)))
    assert result == expected(_SETTINGS, _FRAMES)
    assert max(unread) == 0


@pytest.mark.parametrize("points", [_WRITING, *({point} for point in sorted(_LOADING))])
def test_the_archiver_dies_at_each_point_of_its_work(points: set[str]) -> None:
    stream = _stream(Archiving(budget_bytes=_TIGHT_BYTES))
    result, world = run_world(ScriptedSchedule(), KillAtEach(points), stream=stream)
    assert {point for _, point in world.deaths} == points
    assert result == expected(_SETTINGS, _FRAMES), world.deaths


def test_the_archiver_dies_anywhere_in_any_order() -> None:
    for seed in range(_SEEDS):
        kills = OnlyOf("archiver", SeededKills(seed, probability=0.1, limit=8))
        result, world = run_world(SeededSchedule(seed), kills, stream=_stream(Archiving(budget_bytes=_TIGHT_BYTES)))
        assert result == expected(_SETTINGS, _FRAMES), f"seed {seed}, deaths {world.deaths}"


def test_any_order_with_any_deaths() -> None:
    for seed in range(_SEEDS):
        kills = SeededKills(seed, probability=0.03, limit=8)
        # In one process the pins of the dead stay, and what they hold.
        result, world = run_world(SeededSchedule(seed), kills, stream=_stream(Archiving(budget_bytes=1 << 30)))
        assert result == expected(_SETTINGS, _FRAMES), f"seed {seed}, deaths {world.deaths}"


def test_mapping_waits_for_a_slow_disk_however_long() -> None:
    slow = Archiving(budget_bytes=540_000, step_s=70.0)  # longer than waiting is in vain
    stream = Stream(frames=_FEW, settings=_SETTINGS, archiver=slow)
    with fleet_world(ScriptedSchedule(), stream=stream) as fleet:
        assert fleet.run() == expected(_SETTINGS, _FEW)
        assert fleet.degraded["mapper"].startswith("waits: ")
        assert "of the map store's 540000 bytes are in use" in fleet.degraded["mapper"]
        assert re.fullmatch(
            r"mapping waits for memory: \d finished sections are not on disk yet", fleet.degraded["archiver"]
        )

"""A fleet's services under any order of events and any deaths: the result is always that of one process."""

import pytest
from helpers.fleet_world import FRAMES, SETTINGS, FewFrames, Stream, expected, fleet_world, in_one_process, run_world

from vtslam.common.bus_schedule import KillAt, ScriptedSchedule, SeededKills, SeededSchedule
from vtslam.common.messages import TrackedPose
from vtslam.common.shm.errors import SharedMemoryFull
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.frame_journal import JournalWriter
from vtslam.services.mapper.pose_intake import EveryPose

_SERVICES = ("sensor", "tracker", "mapper")
_SEEDS = 60


def test_undisturbed() -> None:
    result, world = run_world(ScriptedSchedule())
    assert result == expected()
    assert world.deaths == []


def test_a_journal_without_room_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    real, refused = JournalWriter.append, []

    def append(journal: JournalWriter, facts: CommitFacts, *, section_ended: bool) -> None:
        frame_id = facts.frame.facts.frame_id
        if frame_id > 1 and frame_id not in refused:  # some section is sealed, so that room may come
            refused.append(frame_id)
            raise SharedMemoryFull("journal", wanted_bytes=700, free_bytes=0)
        real(journal, facts, section_ended=section_ended)

    monkeypatch.setattr(JournalWriter, "append", append)
    result, _ = run_world(ScriptedSchedule())
    assert refused == list(range(2, FRAMES))
    assert result == expected()


def test_a_pose_that_gets_lost_is_said_again(monkeypatch: pytest.MonkeyPatch) -> None:
    real, lost = EveryPose.take, []

    def take(intake: EveryPose, num_frames: int) -> TrackedPose | None:
        pose = real(intake, num_frames)
        if pose is None or pose.frame_id in lost:
            return pose
        lost.append(pose.frame_id)
        return None

    monkeypatch.setattr(EveryPose, "take", take)
    with fleet_world(ScriptedSchedule()) as fleet:
        assert fleet.run() == expected()
        assert lost == list(range(FRAMES))
        assert fleet.count("tracker", "frames.tracked") == fleet.count("tracker", "poses.repeated") == FRAMES


@pytest.mark.parametrize("name", _SERVICES)
def test_a_death_at_every_point_of_a_service(name: str) -> None:
    _, calm = run_world(ScriptedSchedule())
    points = [point for service, point in calm.passed if service == name]
    for passage in range(len(points)):
        result, world = run_world(ScriptedSchedule(), KillAt(name, passage))
        assert world.deaths == [(name, points[passage])]
        assert result == expected(), f"{name} killed at {points[passage]}, passage {passage}"


def test_any_order_with_any_deaths() -> None:
    for seed in range(_SEEDS):
        result, world = run_world(SeededSchedule(seed), SeededKills(seed, probability=0.03, limit=6))
        assert result == expected(), f"seed {seed}, deaths {world.deaths}"


def test_poses_that_come_after_the_first_frame_are_ignored_whoever_dies() -> None:
    alone, _ = in_one_process(FewFrames(priors=()), SETTINGS)
    assert in_one_process(FewFrames(priors=(1, 3)), SETTINGS)[0] == alone
    for seed in range(6):
        kills = SeededKills(seed, probability=0.03, limit=6)
        with fleet_world(SeededSchedule(seed), kills, stream=Stream(priors=(1, 3))) as fleet:
            assert fleet.run() == alone, f"seed {seed}, deaths {fleet.world.deaths}"
            assert fleet.count("tracker", "priors.ignored") >= 1

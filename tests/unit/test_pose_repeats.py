"""A pose that the mapper may have missed is said again, and what is said again is not kept for ever."""

from dataclasses import replace

import numpy as np
from helpers.bus_messages import tracked_pose

from vtslam.common.bus import Member
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import ScriptedSchedule
from vtslam.common.bus_world import SimulatedClock
from vtslam.common.messages import TrackedPose
from vtslam.common.topics import TRACKER_POSE, Role
from vtslam.services.mapper.pose_intake import EveryPose
from vtslam.services.tracker.untaken_poses import UntakenPoses


def pose(frame_id: int) -> TrackedPose:
    return replace(tracked_pose(np.random.default_rng(1)), frame_id=frame_id)


def test_the_next_pose_is_said_again_ever_more_seldom_until_it_is_committed() -> None:
    clock = SimulatedClock()
    untaken = UntakenPoses(clock)
    for frame_id in (4, 5):
        untaken.add(pose(frame_id))
    start_ns, said = clock.now_ns, []
    for num_frames in (4, 5, 6):
        for _ in range(40):
            repeated = untaken.to_repeat(num_frames)
            if repeated is not None:
                said.append((repeated.frame_id, round(1e-9 * (clock.now_ns - start_ns))))
            clock.now_ns += 500_000_000
    assert [(frame_id, second) for frame_id, second in said if frame_id == 4] == [(4, 2), (4, 6), (4, 14)]
    assert [frame_id for frame_id, _ in said] == [4, 4, 4, 5, 5, 5]


def test_a_pose_that_comes_again_while_it_is_mapped_is_forgotten() -> None:
    world = MemoryWorld(ScriptedSchedule())
    intake = EveryPose(world.join(Member(fleet="test", role=Role.MAPPER)))
    out = world.join(Member(fleet="test", role=Role.TRACKER)).publisher(TRACKER_POSE)

    def say(frame_id: int, num_frames: int) -> None:
        out.publish(pose(frame_id))
        world.run(timeout_s=0.1, done=lambda: False)
        intake.listen(num_frames, 0, section_id=0, row=0)

    say(0, 0)
    assert intake.take(0) is not None
    say(0, 0)
    say(1, 1)
    assert list(intake._poses) == [1]
    say(0, 1)
    assert list(intake._poses) == [1]

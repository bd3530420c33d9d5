"""The sensors of a fleet as services: what they count, and what they take of publishers."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.fleet_world import FewFrames
from helpers.small_map import room_frame

from vtslam.common.bus import Member, Steps
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import ScriptedSchedule
from vtslam.common.messages import FramePixels, MessageError
from vtslam.common.shm.frame_ring import FrameRingReader
from vtslam.common.topics import SENSOR_PIXELS, Role
from vtslam.services.sensor.live import LiveSensor
from vtslam.services.sensor.service import RecordingSensor
from vtslam.services.service_link import ServiceLink

DAY_NS = 24 * 60 * 60 * 10**9


@pytest.fixture
def world() -> Iterator[MemoryWorld]:
    world = MemoryWorld(ScriptedSchedule())
    yield world
    world.close()


def sensor_of(world: MemoryWorld, ring: Path, *, live: bool, epoch: int = 1) -> tuple[Steps, ServiceLink]:
    bus = world.join(Member(fleet="test", role=Role.SENSOR))
    link = ServiceLink(bus, epoch)
    sensor = LiveSensor(bus, link, ring) if live else RecordingSensor(bus, link, FewFrames(), ring)
    return sensor, link


def pixels(frame_id: int, capture_time_ns: int) -> FramePixels:
    frame = room_frame(frame_id, 48, (20, 15))
    return FramePixels(
        stream="frames",
        frame_id=frame_id,
        capture_time_ns=capture_time_ns,
        depth_scale_m=frame.depth_scale_m,
        camera=frame.camera,
        rgb=frame.rgb,
        depth=frame.depth,
    )


def test_a_sensor_that_starts_again_says_at_once_how_many_frames_there_were(world: MemoryWorld, tmp_path: Path) -> None:
    sensor, link = sensor_of(world, tmp_path / "ring", live=False)
    for _ in range(3):
        sensor.step()
    assert link.counters == {"frames.published": 2}
    again, link = sensor_of(world, tmp_path / "ring", live=False, epoch=2)
    again.step()
    assert link.counters == {"frames.published": 2}


def test_times_far_ahead_are_refused_and_counted(world: MemoryWorld, tmp_path: Path) -> None:
    sensor, link = sensor_of(world, tmp_path / "ring", live=True)
    out = world.join(Member(fleet="test", role=Role.REMOTE_SENSOR)).publisher(SENSOR_PIXELS)
    for frame_id, time_ns in ((0, 1000), (1, 1001 + DAY_NS), (1, 2**62), (1, 1000 + DAY_NS)):
        out.publish(pixels(frame_id, time_ns))
        world.run(timeout_s=0.1, done=lambda: False)
        sensor.step()
    sensor.step()
    assert link.counters == {"frames.published": 2, "frames.other_time": 2}
    again, link = sensor_of(world, tmp_path / "ring", live=True, epoch=2)
    again.step()
    assert link.counters == {"frames.published": 2}
    ring = FrameRingReader(tmp_path / "ring")
    assert [ring.copied(each).capture_time_ns for each in ring.unacknowledged()] == [1000, 1000 + DAY_NS]


def test_the_last_time_that_is_taken_leaves_room_for_what_follows_it(world: MemoryWorld, tmp_path: Path) -> None:
    sensor, link = sensor_of(world, tmp_path / "ring", live=True)
    out = world.join(Member(fleet="test", role=Role.REMOTE_SENSOR)).publisher(SENSOR_PIXELS)
    for frame_id in (0, 1):
        out.publish(pixels(frame_id, 2**62))
        world.run(timeout_s=0.1, done=lambda: False)
        sensor.step()
    assert link.counters["frames.clock_jumped"] == 1
    with pytest.raises(MessageError, match="an integer in 0"):
        out.publish(replace(pixels(2, 0), capture_time_ns=2**62 + 1))

"""How long descriptors of frames are under way, and when that counts."""

from helpers.bus_messages import descriptor

from vtslam.common.bus import Member
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import ScriptedSchedule
from vtslam.common.topics import SENSOR_FRAME, Role
from vtslam.services.service_link import ServiceLink
from vtslam.services.tracker.descriptors import Descriptors


def test_latencies_of_start_up_do_not_count() -> None:
    world = MemoryWorld(ScriptedSchedule())
    sensor = world.join(Member(fleet="test", role=Role.SENSOR)).publisher(SENSOR_FRAME)
    tracker = world.join(Member(fleet="test", role=Role.TRACKER))
    link = ServiceLink(tracker, 1)
    descriptors = Descriptors(tracker, link)

    def say(frame_id: int) -> None:
        sensor.publish(descriptor(frame_id))
        world.run(timeout_s=0.5, done=lambda: False)

    say(0)
    descriptors.listen(started=False)
    say(1)
    descriptors.listen(started=True)  # said while it was not known that start-up was over
    assert "descriptor_p50_ms" not in link.gauges
    say(2)
    descriptors.listen(started=True)
    assert 0.0 <= link.gauges["descriptor_p50_ms"] <= link.gauges["descriptor_p99_ms"] < 1000.0
    assert [descriptors.published_ns(frame_id) is not None for frame_id in range(4)] == [True, True, True, False]

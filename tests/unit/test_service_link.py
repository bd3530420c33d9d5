"""When services say what they do."""

from vtslam.common.bus import Member
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import ScriptedSchedule
from vtslam.common.messages import ServiceState
from vtslam.common.topics import STATUS, Role
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink


def test_changes_are_told_at_once_but_not_every_turn_of_working_and_waiting() -> None:
    world = MemoryWorld(ScriptedSchedule())
    heard = world.join(Member(fleet="test", role=Role.SUPERVISOR)).subscriber(STATUS, service="tracker")
    link = ServiceLink(world.join(Member(fleet="test", role=Role.TRACKER)), 1)

    def told(state: ServiceState, *, after_s: float = 0.0) -> list[ServiceState]:
        world.run(timeout_s=after_s, done=lambda: False)
        link.tell(state, 0)
        world.run(timeout_s=0.001, done=lambda: False)
        states = []
        while (received := heard.receive()) is not None:
            states.append(received.message.state)
        return states

    assert told(ServiceState.READY) == [ServiceState.READY]
    assert told(ServiceState.WORKING) == []
    assert told(ServiceState.READY) == []
    assert told(ServiceState.WORKING, after_s=HEARTBEAT_S) == [ServiceState.WORKING]
    assert told(ServiceState.DEGRADED) == [ServiceState.DEGRADED]
    assert told(ServiceState.DEGRADED) == []
    assert told(ServiceState.WORKING) == [ServiceState.WORKING]
    assert told(ServiceState.FINISHED) == [ServiceState.FINISHED]
    world.close()

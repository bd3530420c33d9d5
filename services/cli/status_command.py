"""``vtslam status``: the services of running fleets, as they say themselves."""

from argparse import Namespace
from dataclasses import dataclass
from typing import Any

from vtslam.common.bus import BusError, Member
from vtslam.common.bus_zenoh import join
from vtslam.common.fleet_folder import FleetFolder, running_fleets
from vtslam.common.messages import ServiceStatus
from vtslam.common.topics import EVERY_SERVICE, STATUS, Role
from vtslam.services.cli.console import Console

_PATIENCE_S = 5.0  # several heartbeats: a step of work may take that long


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceReport:
    """A service as seen from outside.

    Attributes:
        name: The service.
        alive: Whether it is on the bus.
        status: What it said while we listened; None if nothing.
    """

    name: str
    alive: bool
    status: ServiceStatus | None

    def as_plain(self) -> dict[str, Any]:
        """The report as JSON has it."""
        status = self.status
        if status is None:
            return {"alive": self.alive, "state": None}
        return {
            "alive": self.alive,
            "state": status.state.value,
            "pid": status.pid,
            "starts": status.epoch,
            "last_frame_id": status.last_frame_id,
            "counters": status.counters,
            "gauges": status.gauges,
            "detail": status.detail,
        }

    def text(self) -> str:
        """The report as one line."""
        status = self.status
        if status is None:
            return f"  {self.name:12s} {'alive' if self.alive else 'gone':6s} silent"
        counters = " ".join(f"{name}={count}" for name, count in sorted(status.counters.items()))
        line = f"  {self.name:12s} {'alive' if self.alive else 'gone':6s} {status.state.value:10s}"
        return (
            f"{line} pid {status.pid}  start {status.epoch}  frame {status.last_frame_id}  {counters} {status.detail}"
        )


def status_command(args: Namespace) -> int:
    """Print the status of one fleet or of all; 0 if there are any and all their services are alive and talk."""
    console = Console(args.json)
    names = [args.fleet] if args.fleet else running_fleets()
    if not names:
        console.print("no fleet is running")
    fleets = {}
    for name in names:
        reports = listened(name)
        console.print("\n".join([f"fleet {name}", *(report.text() for report in reports)]))
        fleets[name] = reports
    console.result({name: {each.name: each.as_plain() for each in reports} for name, reports in fleets.items()})
    sound = [each.alive and each.status is not None for reports in fleets.values() for each in reports]
    return 0 if sound and all(sound) else 1


def listened(fleet: str) -> list[ServiceReport]:
    """What the services of a fleet say within a few heartbeats; raises BusError if the fleet's bus is not there.

    Raises:
        SharedMemoryError: There is no such fleet.
    """
    folder = FleetFolder.open(fleet)
    heard: dict[str, ServiceStatus] = {}
    with join(Member(fleet=fleet, role=Role.OBSERVER), folder.path, timeout_s=2.0) as bus:
        watcher, heartbeats = bus.watch_alive(), bus.subscriber(STATUS, service=EVERY_SERVICE)

        def all_heard() -> bool | None:
            while (received := heartbeats.receive()) is not None:
                heard[received.message.service] = received.message
            names = watcher.names()
            return True if names and names <= heard.keys() else None

        bus.until(all_heard, timeout_s=_PATIENCE_S)
        alive = watcher.names()
        if not alive and not heard:
            raise BusError(f"fleet {fleet}: nobody is on its bus")
    return [ServiceReport(name=n, alive=n in alive, status=heard.get(n)) for n in sorted(alive | heard.keys())]

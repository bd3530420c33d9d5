"""A fleet in realtime on the bus in memory: a source that does not wait, services that take their time."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from helpers.fleet_watching import Slow, Watched
from helpers.fleet_world import ENGINE, PRIORS, FewFrames, Sections

from vtslam.common.bus import Bus, Member, Steps
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import Kills, Schedule
from vtslam.common.messages import Command, Control, ServiceStatus, TrackedPose
from vtslam.common.settings import Settings
from vtslam.common.shm.map_store import MapStore
from vtslam.common.topics import CONTROL, EVERY_SERVICE, STATUS, TRACKER_POSE, Role
from vtslam.services.frame_journal import JournalReader
from vtslam.services.map_follower import MapFollower, StoreArchive
from vtslam.services.mapper.service import FleetPaths, MapperService
from vtslam.services.pacing import Pace, Pacing
from vtslam.services.sensor.replay import ReplaySensor
from vtslam.services.service_link import ServiceLink
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.realtime import RealtimeTracker

RATE_HZ = 60.0
_TIMEOUT_S = 600.0  # simulated
_ORDER = ("sensor", "tracker", "mapper")


class _Conductor:
    """Ends sensor, tracker and mapper in this order, as the supervisor does in realtime, and keeps what was said."""

    def __init__(self, bus: Bus, epochs: dict[str, int], ended: set[str], last_frame_id: int) -> None:
        self._bus, self._epochs, self._ended, self._last = bus, epochs, ended, last_frame_id
        self._ordered: set[tuple[str, int]] = set()
        self._orders = {name: bus.publisher(CONTROL, service=name) for name in _ORDER}
        self._heartbeats = bus.subscriber(STATUS, service=EVERY_SERVICE)
        self._poses = bus.subscriber(TRACKER_POSE)
        self.statuses: dict[str, ServiceStatus] = {}
        self.poses: list[tuple[int, TrackedPose]] = []  # with when they came

    def step(self) -> float | None:
        while (status := self._heartbeats.receive()) is not None:
            self.statuses[status.message.service] = status.message
        while (pose := self._poses.receive()) is not None:
            self.poses.append((pose.arrival_time_ns, pose.message))
        running = [name for name in _ORDER if name not in self._ended]
        if not running:
            return None
        if running[0] != "sensor":
            self._order(running[0])
        return 0.05

    def _order(self, name: str) -> None:
        epoch = self._epochs[name]
        if (name, epoch) not in self._ordered:
            self._ordered.add((name, epoch))
            self._orders[name].publish(Control(command=Command.DRAIN, through_frame_id=self._last, epoch=epoch))


@dataclass(frozen=True, slots=True, kw_only=True)
class RealtimeResult:
    """What a run came to.

    Attributes:
        published, tracked, dropped: As the services counted.
        mapped: Frames in the map, in order.
        sections: Frames of each sealed section.
        ages_s: Age of the pose before, whenever a new one came.
        ignored: Poses that came with frames and did not count.
        deaths: Of services.
    """

    published: int
    tracked: int
    dropped: int
    mapped: list[int]
    sections: list[list[int]]
    ages_s: list[float]
    ignored: int
    deaths: list[tuple[str, str]]


class RealtimeWorld:
    """A world with a realtime fleet in it.

    Args:
        folder: Of the shared memory.
        schedule: Chooses what happens next.
        settings: Of the services.
        frames: Frames of the source, at 60 a second.
        seconds: That a working step of a service takes, by name.
        kills: Decides who dies where.
        priors: Frames that come with a pose.
    """

    def __init__(
        self,
        folder: Path,
        schedule: Schedule,
        settings: Settings,
        *,
        frames: int,
        seconds: dict[str, float],
        kills: Kills | None = None,
        priors: tuple[int, ...] = PRIORS,
    ) -> None:
        self.world = MemoryWorld(schedule, kills=kills)
        self._folder, self._settings, self._seconds = folder, settings, seconds
        self._source = FewFrames(frames, frames, (32, 24), priors)
        self._store = MapStore(folder / "map", budget_bytes=1 << 30, pins=24)
        self._ended: set[str] = set()
        self._epochs = dict.fromkeys(_ORDER, 0)
        self._conductor: _Conductor | None = None
        makers = {Role.SENSOR: self._sensor, Role.TRACKER: self._tracker, Role.MAPPER: self._mapper}
        for role, make in makers.items():
            self._add(role, make)
        self.world.add_service(Member(fleet="test", role=Role.SUPERVISOR), self._conducted)

    def run(self) -> RealtimeResult:
        """Let the fleet run to its end."""
        assert self.world.run(timeout_s=_TIMEOUT_S), f"no end; deaths {self.world.deaths}"
        assert self._conductor is not None
        said, poses = self._conductor.statuses, self._conductor.poses
        captured = [pose.frame_id / RATE_HZ for _, pose in poses]
        start_s = poses[0][0] * 1e-9 - captured[0]  # the first pose comes at once
        sealed = [self._store.pinned_sealed(i).section for i in self._store.sealed_ids()]
        lines = JournalReader(self._folder / "journal").new_lines()
        return RealtimeResult(
            published=said["sensor"].counters["frames.published"],
            tracked=said["tracker"].counters["frames.tracked"],
            dropped=said["tracker"].counters["frames.dropped"],
            mapped=sorted({line.frame.facts.frame_id for line in lines}),
            sections=[[frame.frame_id for frame in section.frames] for section in sealed],
            ages_s=[
                float(now_ns * 1e-9 - start_s - before)
                for (now_ns, _), before in zip(poses[1:], captured, strict=False)
            ],
            ignored=said["tracker"].counters.get("priors.ignored", 0),
            deaths=self.world.deaths,
        )

    def _add(self, role: Role, make: Callable[[Bus, ServiceLink], Steps]) -> None:
        def start(bus: Bus) -> Steps:
            self._epochs[role.value] += 1
            link = ServiceLink(bus, self._epochs[role.value])
            slow = Slow(make(bus, link), self._seconds.get(role.value, 0.0), bus)
            return Watched(role.value, slow, self._ended)

        self.world.add_service(Member(fleet="test", role=role), start)

    def _conducted(self, bus: Bus) -> Steps:
        self._conductor = _Conductor(bus, self._epochs, self._ended, len(self._source) - 1)
        return self._conductor

    def _sensor(self, bus: Bus, link: ServiceLink) -> Steps:
        return ReplaySensor(bus, link, self._source, self._folder / "ring", rate_hz=RATE_HZ)

    def _tracker(self, bus: Bus, link: ServiceLink) -> Steps:
        interval = self._settings.section.candidate_interval
        follower = MapFollower(self._store, StoreArchive(self._store, Sections()), candidate_interval=interval)
        core = Tracker(settings=self._settings.tracker, engine=ENGINE, threads=1)
        return RealtimeTracker(bus, link, core, follower, self._folder / "ring")

    def _mapper(self, bus: Bus, link: ServiceLink) -> Steps:
        return MapperService(
            bus,
            link,
            self._settings,
            ENGINE,
            self._store,
            StoreArchive(self._store, Sections()),
            FleetPaths(ring=self._folder / "ring", journal=self._folder / "journal"),
            Pace(pacing=Pacing.REALTIME),
        )

"""The services of a fleet on the bus in memory: any order of events, and deaths at any message or write."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import room_frame, section_bytes

from vtslam.common import failpoints
from vtslam.common.bus import Bus, Member, Steps
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import Kills, Schedule
from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.messages import Command, Control
from vtslam.common.preset_loading import load_settings
from vtslam.common.section import Section
from vtslam.common.shm.map_store import MapStore
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.common.topics import CONTROL, Role
from vtslam.services.frame_journal import JournalReader
from vtslam.services.map_follower import MapFollower, StoreArchive
from vtslam.services.mapper.service import FleetPaths, MapperService
from vtslam.services.section_map import ReadsSections
from vtslam.services.sensor.service import RecordingSensor
from vtslam.services.service_link import ServiceLink
from vtslam.services.system import System
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.service import TrackerService

FRAMES, SIZE = 5, (20, 15)
TIMEOUT_S = 600.0  # simulated
SETTINGS = load_settings(
    preset="fast",
    assignments=[
        "section.length=2",
        "section.candidate_interval=1",
        "mapper.iterations_head=2",
        "mapper.iterations_regular=1",
        "mapper.iterations_seal=1",
        "mapper.keep_moments=true",
    ],
)
ENGINE = NativeEngine(threads=1)


class FewFrames:
    """A source in memory."""

    uri, family = "few:", "tum"

    def __len__(self) -> int:
        return FRAMES

    def frame(self, index: int) -> Frame:
        return room_frame(index, 48, SIZE)

    @property
    def camera(self) -> Camera:
        return self.frame(0).camera

    @property
    def depth_scale_m(self) -> float:
        return self.frame(0).depth_scale_m

    def ground_truth(self) -> npt.NDArray[np.float64] | None:
        return None


@dataclass(frozen=True, slots=True)
class Result:
    """What a run comes to: the bytes of its sections and its poses."""

    sections: tuple[bytes, ...]
    poses: tuple[bytes, ...]


class Sections(ReadsSections):
    def __init__(self) -> None:
        self.written: dict[int, Section] = {}

    def write(self, section: Section) -> None:
        self.written[section.section_id] = section

    def read(self, section_id: int) -> Section:
        return self.written[section_id]


@lru_cache(maxsize=1)
def expected() -> Result:
    """The result of one process."""
    sections, source = Sections(), FewFrames()
    system = System(SETTINGS, ENGINE, sections, threads=1)
    reports = [system.process(source.frame(index)) for index in range(FRAMES)]
    system.finish()
    return Result(
        tuple(section_bytes(section) for section in sections.written.values()),
        tuple(report.commit.T_world_camera.tobytes() for report in reports),
    )


@dataclass(slots=True)
class _Watched:
    """A service whose end is noted, as a supervisor notes that of a process."""

    name: str
    steps: Steps
    ended: set[str]

    def step(self) -> float | None:
        patience_s = self.steps.step()
        if patience_s is None:
            self.ended.add(self.name)
        return patience_s


class _Conductor:
    """Ends the fleet in order, as its supervisor does."""

    def __init__(self, bus: Bus, epochs: dict[str, int], ended: set[str]) -> None:
        self._epochs, self._ended = epochs, ended
        self._ordered: set[tuple[str, int]] = set()
        self._orders = {name: bus.publisher(CONTROL, service=name) for name in ("mapper", "tracker")}

    def step(self) -> float | None:
        if "tracker" in self._ended:
            return None
        if "sensor" in self._ended:
            self._order("mapper", Command.DRAIN)
        if "mapper" in self._ended:
            self._order("tracker", Command.STOP)
        return 0.1

    def _order(self, name: str, command: Command) -> None:
        epoch = self._epochs[name]
        if (name, epoch) not in self._ordered:
            self._ordered.add((name, epoch))
            self._orders[name].publish(Control(command=command, through_frame_id=FRAMES - 1, epoch=epoch))


class FleetWorld:
    """A world with the services of a fleet in it, its shared memory in a folder.

    Args:
        folder: Of the shared memory.
        schedule: Chooses what happens next.
        kills: Decides who dies where.
    """

    def __init__(self, folder: Path, schedule: Schedule, kills: Kills | None = None) -> None:
        self.world = MemoryWorld(schedule, kills=kills)
        self._folder = folder
        self._store = MapStore(folder / "map", budget_bytes=1 << 30, pins=24)
        self._ended: set[str] = set()
        self._epochs = {name: 0 for name in ("sensor", "tracker", "mapper")}
        for role, start in ((Role.SENSOR, self._sensor), (Role.TRACKER, self._tracker), (Role.MAPPER, self._mapper)):
            self._add(role, start)
        self.world.add_service(
            Member(fleet="test", role=Role.SUPERVISOR), lambda bus: _Conductor(bus, self._epochs, self._ended)
        )

    def _add(self, role: Role, start: Callable[[Bus], Steps]) -> None:
        def watched(bus: Bus) -> Steps:
            return _Watched(role.value, start(bus), self._ended)

        self.world.add_service(Member(fleet="test", role=role), watched)

    def run(self) -> Result:
        """Let the fleet run to its end."""
        assert self.world.run(timeout_s=TIMEOUT_S), f"no end; deaths {self.world.deaths}"
        sections = [self._store.pinned_sealed(section_id).section.retied() for section_id in self._store.sealed_ids()]
        frames = {line.frame.facts.frame_id: line.frame for line in JournalReader(self._folder / "journal").new_lines()}
        assert sorted(frames) == list(range(FRAMES))
        return Result(
            tuple(section_bytes(section) for section in sections),
            tuple(frames[index].T_world_camera.tobytes() for index in range(FRAMES)),
        )

    def _link(self, bus: Bus) -> ServiceLink:
        self._epochs[bus.member.name] += 1
        return ServiceLink(bus, self._epochs[bus.member.name])

    def _sensor(self, bus: Bus) -> Steps:
        return RecordingSensor(bus, self._link(bus), FewFrames(), self._folder / "ring")

    def _tracker(self, bus: Bus) -> Steps:
        follower = MapFollower(
            self._store, StoreArchive(self._store, Sections()), candidate_interval=SETTINGS.section.candidate_interval
        )
        core = Tracker(settings=SETTINGS.tracker, engine=ENGINE, threads=1)
        return TrackerService(
            bus,
            self._link(bus),
            core,
            follower,
            self._folder / "ring",
            section_length=SETTINGS.section.length,
        )

    def _mapper(self, bus: Bus) -> Steps:
        return MapperService(
            bus,
            self._link(bus),
            SETTINGS,
            ENGINE,
            self._store,
            StoreArchive(self._store, Sections()),
            FleetPaths(ring=self._folder / "ring", journal=self._folder / "journal"),
        )


def run_world(schedule: Schedule, kills: Kills | None = None) -> tuple[Result, MemoryWorld]:
    """A whole run in a folder of its own; points within writes to shared memory count as points of the world."""
    with tempfile.TemporaryDirectory(prefix="vts-", dir="/dev/shm") as name, pytest.MonkeyPatch.context() as patch:
        fleet = FleetWorld(Path(name), schedule, kills)
        patch.setattr(failpoints, "reach", fleet.world.point)
        try:
            return fleet.run(), fleet.world
        finally:
            fleet.world.close()

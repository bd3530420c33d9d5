"""The services of a fleet on the bus in memory: any order of events, and deaths at any message or write."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import room_frame, room_pose, section_bytes

from vtslam.common import failpoints
from vtslam.common.bus import Bus, Member, Steps
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import Kills, Schedule
from vtslam.common.external_pose import ExternalPose
from vtslam.common.fleet_folder import shared_memory_folder
from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.messages import Command, Control
from vtslam.common.preset_loading import load_settings
from vtslam.common.section import Section
from vtslam.common.settings import Settings
from vtslam.common.shm.map_store import MapStore
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.common.topics import CONTROL, Role
from vtslam.services.frame_journal import JournalReader
from vtslam.services.map_follower import MapFollower, StoreArchive
from vtslam.services.mapper.service import FleetPaths, MapperService
from vtslam.services.pacing import Pace
from vtslam.services.section_map import ReadsSections
from vtslam.services.sensor.service import RecordingSensor
from vtslam.services.service_link import ServiceLink
from vtslam.services.system import System
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.service import TrackerService

FRAMES, SIZE = 5, (20, 15)
TIMEOUT_S = 600.0  # simulated


def settings_of(section_length: int, *, length_m: float = 0.0) -> Settings:
    """Of a small map."""
    return load_settings(
        preset="fast",
        assignments=[
            f"section.length={section_length}",
            f"section.length_m={length_m}",
            "section.candidate_interval=1",
            "mapper.iterations_head=2",
            "mapper.iterations_regular=1",
            "mapper.iterations_seal=1",
            "mapper.keep_moments=true",
        ],
    )


SETTINGS = settings_of(2)
ENGINE = NativeEngine(threads=1)


class FewFrames:
    """A source in memory; some frames have a pose prior."""

    uri, family = "few:", "tum"

    def __init__(self, frames: int = FRAMES, path: int = 48, size: tuple[int, int] = SIZE) -> None:
        self._frames, self._path, self._size = frames, path, size

    def __len__(self) -> int:
        return self._frames

    def frame(self, index: int) -> Frame:
        frame = room_frame(index, self._path, self._size)
        prior = ExternalPose(T_world_camera=room_pose(index, self._path), covariance=1e-4 * np.eye(6))
        return replace(frame, pose_prior=prior if index in (0, 1, 3) else None)

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

    def __init__(self, bus: Bus, epochs: dict[str, int], ended: set[str], last_frame_id: int) -> None:
        self._epochs, self._ended, self._last = epochs, ended, last_frame_id
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
            self._orders[name].publish(Control(command=command, through_frame_id=self._last, epoch=epoch))


@dataclass(frozen=True, slots=True, kw_only=True)
class Stream:
    """What goes through a fleet: frames of a closed path of ``path`` ones, how they are mapped, and at which pace."""

    frames: int = FRAMES
    path: int = 48
    size: tuple[int, int] = SIZE
    settings: Settings = SETTINGS
    pace: Pace = field(default_factory=Pace)


class FleetWorld:
    """A world with the services of a fleet in it, its shared memory in a folder.

    Args:
        folder: Of the shared memory.
        schedule: Chooses what happens next.
        kills: Decides who dies where.
        stream: Its frames, settings and pace.
    """

    def __init__(
        self, folder: Path, schedule: Schedule, kills: Kills | None = None, *, stream: Stream | None = None
    ) -> None:
        stream = stream or Stream()
        self._pace, self._settings = stream.pace, stream.settings
        self._source = FewFrames(stream.frames, stream.path, stream.size)
        self.world = MemoryWorld(schedule, kills=kills)
        self._folder = folder
        self._store = MapStore(folder / "map", budget_bytes=1 << 30, pins=24)
        self._ended: set[str] = set()
        self._epochs = {name: 0 for name in ("sensor", "tracker", "mapper")}
        for role, start in ((Role.SENSOR, self._sensor), (Role.TRACKER, self._tracker), (Role.MAPPER, self._mapper)):
            self._add(role, start)
        self.world.add_service(
            Member(fleet="test", role=Role.SUPERVISOR),
            lambda bus: _Conductor(bus, self._epochs, self._ended, len(self._source) - 1),
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
        assert sorted(frames) == list(range(len(self._source)))
        return Result(
            tuple(section_bytes(section) for section in sections),
            tuple(frames[index].T_world_camera.tobytes() for index in range(len(self._source))),
        )

    def _link(self, bus: Bus) -> ServiceLink:
        self._epochs[bus.member.name] += 1
        return ServiceLink(bus, self._epochs[bus.member.name])

    def _sensor(self, bus: Bus) -> Steps:
        return RecordingSensor(bus, self._link(bus), self._source, self._folder / "ring", credit=self._pace.credit)

    def _tracker(self, bus: Bus) -> Steps:
        follower = MapFollower(
            self._store,
            StoreArchive(self._store, Sections()),
            candidate_interval=self._settings.section.candidate_interval,
        )
        core = Tracker(settings=self._settings.tracker, engine=ENGINE, threads=1)
        return TrackerService(
            bus,
            self._link(bus),
            core,
            follower,
            self._folder / "ring",
            section=self._settings.section,
            lead=self._pace.lead,
        )

    def _mapper(self, bus: Bus) -> Steps:
        return MapperService(
            bus,
            self._link(bus),
            self._settings,
            ENGINE,
            self._store,
            StoreArchive(self._store, Sections()),
            FleetPaths(ring=self._folder / "ring", journal=self._folder / "journal"),
            self._pace,
        )


def run_world(
    schedule: Schedule, kills: Kills | None = None, *, stream: Stream | None = None
) -> tuple[Result, MemoryWorld]:
    """A whole run in a folder of its own; points within writes to shared memory count as points of the world."""
    with tempfile.TemporaryDirectory(dir=shared_memory_folder()) as name, pytest.MonkeyPatch.context() as patch:
        fleet = FleetWorld(Path(name), schedule, kills, stream=stream)
        patch.setattr(failpoints, "reach", fleet.world.point)
        try:
            return fleet.run(), fleet.world
        finally:
            fleet.world.close()

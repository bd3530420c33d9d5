"""The services of a fleet on the bus in memory: any order of events, and deaths at any message or write."""

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from helpers.fleet_watching import Conductor, Observer, Slow, Watched
from helpers.small_map import room_frame, room_pose, section_bytes

from vtslam.common import failpoints
from vtslam.common.bus import Bus, Member, Steps
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import Kills, Schedule
from vtslam.common.external_pose import ExternalPose
from vtslam.common.fleet_folder import shared_memory_folder
from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.preset_loading import load_settings
from vtslam.common.section import Section
from vtslam.common.settings import Settings
from vtslam.common.shm.map_store import MapStore
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.common.topics import Role
from vtslam.services.archiver.service import ArchiverService
from vtslam.services.frame_journal import JournalReader
from vtslam.services.map_follower import MapFollower, StoreArchive
from vtslam.services.mapper.service import FleetPaths, MapperService
from vtslam.services.pacing import Pace
from vtslam.services.section_loader import SectionLoader
from vtslam.services.section_map import ReadsSections
from vtslam.services.sensor.service import RecordingSensor
from vtslam.services.service_link import ServiceLink
from vtslam.services.system import System
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.service import TrackerService
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.run_info import RunFacts, RunInfo
from vtslam.storage.section_convert import SectionArchive

FRAMES, SIZE = 5, (20, 15)
PRIORS = (0, 1, 3)  # frames that come with a pose
TIMEOUT_S = 600.0  # simulated


def settings_of(section_length: int, *assignments: str) -> Settings:
    """Of a small map."""
    return load_settings(
        preset="fast",
        assignments=[
            f"section.length={section_length}",
            "section.candidate_interval=1",
            "mapper.iterations_head=2",
            "mapper.iterations_regular=1",
            "mapper.iterations_seal=1",
            "mapper.keep_moments=true",
            *assignments,
        ],
    )


SETTINGS = settings_of(2)
LOAD_TIMEOUT_S = 5.0  # simulated
RUN_INFO = RunInfo(
    facts=RunFacts(
        created_by="test",
        source="few:",
        family="tum",
        preset="fast",
        width=SIZE[0],
        height=SIZE[1],
        first_frame=0,
        end_frame=0,
    ),
    settings={},
    versions={},
)
ENGINE = NativeEngine(threads=1)


class FewFrames:
    """A source in memory; the frames ``priors`` have a pose prior."""

    uri, family = "few:", "tum"

    def __init__(
        self, frames: int = FRAMES, path: int = 48, size: tuple[int, int] = SIZE, priors: tuple[int, ...] = PRIORS
    ) -> None:
        self._frames, self._path, self._size, self._priors = frames, path, size, priors

    def __len__(self) -> int:
        return self._frames

    def frame(self, index: int) -> Frame:
        frame = room_frame(index, self._path, self._size)
        prior = ExternalPose(T_world_camera=room_pose(index, self._path), covariance=1e-4 * np.eye(6))
        return replace(frame, pose_prior=prior if index in self._priors else None)

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


@lru_cache(maxsize=2)
def expected(settings: Settings = SETTINGS, frames: int = FRAMES) -> Result:
    """The result of one process."""
    return in_one_process(FewFrames(frames), settings)[0]


def in_one_process(source: "FewFrames", settings: Settings) -> tuple[Result, Sections]:
    """The result of one process, and its sections."""
    sections = Sections()
    system = System(settings, ENGINE, sections, threads=1)
    reports = [system.process(source.frame(index)) for index in range(len(source))]
    system.finish()
    written = tuple(section_bytes(section) for section in sections.written.values())
    return Result(written, tuple(report.commit.T_world_camera.tobytes() for report in reports)), sections


@dataclass(frozen=True, slots=True, kw_only=True)
class Stream:
    """What goes through a fleet: frames of a closed path of ``path`` ones, how they are mapped, and at which pace.

    Sections stay in memory unless there is an archiver.
    """

    frames: int = FRAMES
    path: int = 48
    size: tuple[int, int] = SIZE
    priors: tuple[int, ...] = PRIORS
    settings: Settings = SETTINGS
    pace: Pace = field(default_factory=Pace)
    archiver: "Archiving | None" = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Archiving:
    """A fleet with an archiver, in so much memory; its steps that do something take some simulated seconds."""

    budget_bytes: int
    step_s: float = 0.0


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
        self._source = FewFrames(stream.frames, stream.path, stream.size, stream.priors)
        self.world = MemoryWorld(schedule, kills=kills)
        self._folder = folder
        self._archiving = stream.archiver
        budget_bytes = 1 << 30 if stream.archiver is None else stream.archiver.budget_bytes
        self._store = MapStore(folder / "map", budget_bytes=budget_bytes, pins=24)
        self._ended: set[str] = set()
        starts = {Role.SENSOR: self._sensor, Role.TRACKER: self._tracker, Role.MAPPER: self._mapper}
        if stream.archiver is not None:
            starts[Role.ARCHIVER] = self._archiver
            self._run = RunFolder.create(folder / "run", RUN_INFO)
        self._epochs = {role.value: 0 for role in starts}
        self.counters: dict[str, list[dict[str, int]]] = {role.value: [] for role in starts}  # of each start
        self.degraded: dict[str, str] = {}  # what a service said when it did not work as it should
        for role, start in starts.items():
            self._add(role, start)
        self.world.add_service(
            Member(fleet="test", role=Role.SUPERVISOR),
            lambda bus: Conductor(bus, self._epochs, self._ended, len(self._source) - 1),
        )
        if stream.archiver is not None:
            self.world.add_service(Member(fleet="test", role=Role.OBSERVER), self._observer)

    def _add(self, role: Role, start: Callable[[Bus], Steps]) -> None:
        def watched(bus: Bus) -> Steps:
            return Watched(role.value, start(bus), self._ended)

        # Whoever asks an archiver while it is started again reads the file instead: that should not be all of them.
        restart_s = 0.0 if role is Role.ARCHIVER else 0.1
        self.world.add_service(Member(fleet="test", role=role), watched, restart_s=restart_s)

    def run(self) -> Result:
        """Let the fleet run to its end."""
        assert self.world.run(timeout_s=TIMEOUT_S), f"no end; deaths {self.world.deaths}"
        sections = self._sections()
        frames = {line.frame.facts.frame_id: line.frame for line in JournalReader(self._folder / "journal").new_lines()}
        assert sorted(frames) == list(range(len(self._source)))
        return Result(
            tuple(section_bytes(section) for section in sections),
            tuple(frames[index].T_world_camera.tobytes() for index in range(len(self._source))),
        )

    def close(self) -> None:
        """Give everything back."""
        self.world.close()
        if self._archiving is not None:
            self._run.close()

    def events(self) -> list[str]:
        """What the archiver noted."""
        return [event.text for event in self._run.catalog.events()]

    def _sections(self) -> list[Section]:
        if self._archiving is None:
            return [self._store.pinned_sealed(i).section.retied() for i in self._store.sealed_ids()]
        run = RunFolder.open(self._run.path)
        return [SectionArchive(run).read(row.section_id) for row in run.catalog.sections()]

    def _archive(self, bus: Bus, link: ServiceLink) -> StoreArchive:
        if self._archiving is None:
            return StoreArchive(self._store, Sections())
        loader = SectionLoader(bus, link, timeout_s=LOAD_TIMEOUT_S)
        return StoreArchive(self._store, SectionArchive(RunFolder.open(self._run.path)), load=loader.load)

    def _observer(self, bus: Bus) -> Steps:
        return Observer(bus, self.degraded, self._ended, len(self._epochs))

    def _archiver(self, bus: Bus) -> Steps:
        assert self._archiving is not None
        assert self._run.lock is not None
        link = self._link(bus)
        run = RunFolder.open(self._run.path, writable=True, lock=os.dup(self._run.lock))
        journal = JournalReader(self._folder / "journal")
        service = ArchiverService(bus, link, self._settings, self._store, run, journal)
        return Slow(service, self._archiving.step_s, bus)

    def _link(self, bus: Bus) -> ServiceLink:
        self._epochs[bus.member.name] += 1
        link = ServiceLink(bus, self._epochs[bus.member.name])
        self.counters[bus.member.name].append(link.counters)
        return link

    def count(self, service: str, what: str) -> int:
        """What all starts of a service counted together."""
        return sum(counters.get(what, 0) for counters in self.counters[service])

    def _sensor(self, bus: Bus) -> Steps:
        return RecordingSensor(bus, self._link(bus), self._source, self._folder / "ring", credit=self._pace.credit)

    def _tracker(self, bus: Bus) -> Steps:
        link = self._link(bus)
        follower = MapFollower(
            self._store,
            self._archive(bus, link),
            candidate_interval=self._settings.section.candidate_interval,
        )
        core = Tracker(settings=self._settings.tracker, engine=ENGINE, threads=1)
        return TrackerService(
            bus,
            link,
            core,
            follower,
            self._folder / "ring",
            settings=self._settings,
            lead=self._pace.lead,
        )

    def _mapper(self, bus: Bus) -> Steps:
        link = self._link(bus)
        return MapperService(
            bus,
            link,
            self._settings,
            ENGINE,
            self._store,
            self._archive(bus, link),
            FleetPaths(ring=self._folder / "ring", journal=self._folder / "journal"),
            self._pace,
        )


def run_world(
    schedule: Schedule, kills: Kills | None = None, *, stream: Stream | None = None
) -> tuple[Result, MemoryWorld]:
    """A whole run in a folder of its own; points within writes to shared memory count as points of the world."""
    with fleet_world(schedule, kills, stream=stream) as fleet:
        return fleet.run(), fleet.world


@contextlib.contextmanager
def fleet_world(
    schedule: Schedule, kills: Kills | None = None, *, stream: Stream | None = None
) -> Iterator[FleetWorld]:
    """The world of :func:`run_world`, to look at it afterwards."""
    with (
        tempfile.TemporaryDirectory(prefix="vts-", dir=shared_memory_folder()) as name,
        pytest.MonkeyPatch.context() as patch,
    ):
        fleet = FleetWorld(Path(name), schedule, kills, stream=stream)
        patch.setattr(failpoints, "reach", fleet.world.point)
        try:
            yield fleet
        finally:
            fleet.close()

"""The entry of a fleet's processes: ``python -m vtslam.services.supervisor.child NAME FLEET ...``, by the supervisor.

Settings and source come from ``run.toml`` in the run folder that the fleet's folder names.
"""

import argparse
import ctypes
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vtslam.common.fleet_folder import FleetFolder, read_owner

if TYPE_CHECKING:
    from vtslam.common.bus import Bus, Steps
    from vtslam.common.settings import Settings
    from vtslam.common.shm.map_store import MapStore
    from vtslam.services.map_follower import StoreArchive
    from vtslam.services.pacing import Pace
    from vtslam.services.service_link import ServiceLink
    from vtslam.services.viewer.core import Poses
    from vtslam.storage.run_folder import RunFolder

REFUSED = 3  # exit status: the input or the machine cannot be used; trying again would not help
_PR_SET_PDEATHSIG = 1
_SWITCH_S = 0.0005  # after which Python code makes way for a message that has come; usually 5 ms


@dataclass(frozen=True, slots=True)
class _Parts:
    """What a service is built from."""

    bus: "Bus"
    link: "ServiceLink"
    folder: FleetFolder
    run: "RunFolder"
    settings: "Settings"
    source: str
    run_lock: int | None

    @property
    def is_live(self) -> bool:
        """Whether frames come from publishers."""
        from vtslam.services.supervisor.processes import LIVE_SOURCE

        return self.source == LIVE_SOURCE

    @property
    def pace(self) -> "Pace":
        """The pace of the fleet."""
        from vtslam.services.pacing import pace_of

        return pace_of(self.settings.fleet, live=self.is_live)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one service to its end; 0 if it came to one, `REFUSED` with the reason in the fleet's folder."""
    words = argparse.ArgumentParser()
    words.add_argument("name")
    words.add_argument("fleet")
    words.add_argument("--base", type=Path, required=True)
    words.add_argument("--epoch", type=int, required=True)
    words.add_argument("--parent", type=int, required=True)
    words.add_argument("--run-lock", type=int)
    args = words.parse_args(argv)
    _leave_ending_to_the_supervisor(args.parent)
    folder = FleetFolder.open(args.fleet, base=args.base)
    return _run(args, folder)


def _leave_ending_to_the_supervisor(parent: int) -> None:
    """Be killed when it dies, also if that happened before this call, and heed no request to end but its orders.

    SIGTERM comes to all processes of a service that systemd stops: a fleet without its mapper could finish nothing.
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _run(args: argparse.Namespace, folder: FleetFolder) -> int:
    from vtslam.common.bus import Member, run_steps
    from vtslam.common.bus_zenoh import join
    from vtslam.common.config import load
    from vtslam.common.scheduling import yield_to_others
    from vtslam.common.settings import Settings
    from vtslam.common.shm.errors import MapStoreFull, SharedMemoryFull
    from vtslam.services.free_memory import keep_large_arrays_apart
    from vtslam.services.sensor.sources.base import SourceError
    from vtslam.services.service_link import ServiceLink
    from vtslam.services.supervisor.processes import process_named
    from vtslam.services.viewer.errors import ViewerError
    from vtslam.storage.errors import StorageError
    from vtslam.storage.run_folder import RunFolder

    keep_large_arrays_apart()
    sys.setswitchinterval(_SWITCH_S)
    name: str = args.name
    owner = read_owner(folder.path)
    assert owner is not None
    run = RunFolder.open(Path(owner.run_folder))
    info = run.read_info()
    settings = load(Settings, [(str(run.path), info.settings)])
    process = process_named(name)
    if process.is_expendable and settings.viewer.idle:
        yield_to_others()  # before there are threads, which take it on
    member = Member(fleet=args.fleet, role=process.role, name=name)
    with join(member, folder.path) as bus:
        link = ServiceLink(bus, args.epoch)
        try:
            parts = _Parts(bus, link, folder, run, settings, info.facts.source, args.run_lock)
            run_steps(_BUILDERS[name](parts), bus)
            folder.write_counts(name, args.epoch, link.counters)
        except (SourceError, StorageError, MapStoreFull, SharedMemoryFull, ViewerError) as error:
            folder.write_failure(name, str(error))
            return REFUSED
    return 0


def _sensor(parts: _Parts) -> "Steps":
    from vtslam.common.scheduling import answer_at_once, give_way
    from vtslam.services.sensor.live import LiveSensor
    from vtslam.services.sensor.replay import ReplaySensor
    from vtslam.services.sensor.service import RecordingSensor
    from vtslam.services.sensor.sources.registry import open_source

    bus, link, ring_path, pace = parts.bus, parts.link, parts.folder.ring_path, parts.pace
    is_recorded = bool(parts.settings.recorder.file)
    if parts.is_live:
        credit = None if pace.is_realtime else pace.credit
        return LiveSensor(bus, link, ring_path, credit=credit, is_recorded=is_recorded)
    source = open_source(parts.source)
    if pace.is_realtime:
        sensor = ReplaySensor(bus, link, source, ring_path, rate_hz=pace.replay_hz)
        answer_at_once()  # as a camera's driver would; the thread that reads has started
        return sensor
    give_way()  # it reads ahead
    durable = parts.run.catalog.num_frames  # when the sensor starts for the first time, these are all
    return RecordingSensor(
        bus, link, source, ring_path, credit=pace.credit, frames_before=durable, is_recorded=is_recorded
    )


def _tracker(parts: _Parts) -> "Steps":
    from vtslam.common.scheduling import give_way
    from vtslam.services.engines import fleet_threads, make_engine, thread_count, with_threads
    from vtslam.services.map_follower import MapFollower
    from vtslam.services.supervisor.store import map_store
    from vtslam.services.tracker.core import Tracker
    from vtslam.services.tracker.realtime import RealtimeTracker
    from vtslam.services.tracker.service import TrackerService

    settings, store = parts.settings, map_store(parts.folder, parts.settings)
    follower = MapFollower(
        store,
        _archive(parts, store),
        candidate_interval=settings.section.candidate_interval,
    )
    threads = fleet_threads(settings, settings.fleet.tracker_threads, is_realtime=parts.pace.is_realtime)
    splat = with_threads(settings.splat, threads)
    core = Tracker(settings=settings.tracker, engine=make_engine(splat), threads=thread_count(splat))
    bus, link, ring_path, pace = parts.bus, parts.link, parts.folder.ring_path, parts.pace
    if pace.is_realtime:
        return RealtimeTracker(bus, link, core, follower, ring_path)
    if pace.lead:
        give_way()  # its pose is wanted when the mapper is done with the frame before
    return TrackerService(bus, link, core, follower, ring_path, settings=settings, lead=pace.lead)


def _mapper(parts: _Parts) -> "Steps":
    from vtslam.common.scheduling import give_way
    from vtslam.services.engines import fleet_threads, make_engine, with_threads
    from vtslam.services.mapper.service import FleetPaths, MapperService
    from vtslam.services.supervisor.store import map_store

    if parts.pace.is_realtime:
        give_way()  # a pose of now comes before the map
    store, settings = map_store(parts.folder, parts.settings), parts.settings
    threads = fleet_threads(settings, settings.fleet.mapper_threads, is_realtime=parts.pace.is_realtime)
    return MapperService(
        parts.bus,
        parts.link,
        settings,
        make_engine(with_threads(settings.splat, threads)),
        store,
        _archive(parts, store),
        FleetPaths(ring=parts.folder.ring_path, journal=parts.folder.journal_path),
        parts.pace,
    )


def _archive(parts: _Parts, store: "MapStore") -> "StoreArchive":
    """Sealed sections: the map store's, where the archiver brings back those that left it."""
    from vtslam.services.map_follower import StoreArchive
    from vtslam.services.section_loader import SectionLoader
    from vtslam.storage.section_convert import SectionArchive

    settings = parts.settings
    timeout_s = min(settings.archiver.load_timeout_s, settings.fleet.hang_s / 2)
    loader = SectionLoader(parts.bus, parts.link, timeout_s=timeout_s)
    return StoreArchive(store, SectionArchive(parts.run), load=loader.load)


def _archiver(parts: _Parts) -> "Steps":
    from vtslam.common.scheduling import give_way
    from vtslam.services.archiver.service import ArchiverService
    from vtslam.services.frame_journal import JournalReader
    from vtslam.services.free_memory import keep_large_arrays_apart
    from vtslam.services.supervisor.store import map_store
    from vtslam.storage.run_folder import RunFolder

    give_way()
    keep_large_arrays_apart(rare=True)  # it has a section in hand when one comes or goes, and nothing between
    return ArchiverService(
        parts.bus,
        parts.link,
        parts.settings,
        map_store(parts.folder, parts.settings),
        RunFolder.open(parts.run.path, writable=True, lock=parts.run_lock),
        JournalReader(parts.folder.journal_path),
    )


def _recorder(parts: _Parts) -> "Steps":
    from vtslam.services.recorder.files import open_recording
    from vtslam.services.recorder.service import RecorderService

    family = parts.run.read_info().facts.family
    recording = open_recording(parts.settings.recorder, family=family)
    return RecorderService(parts.bus, parts.link, parts.folder, recording)


def _viewer(parts: _Parts) -> "Steps":
    from vtslam.services.supervisor.store import map_store
    from vtslam.services.viewer.fleet_view import FleetView
    from vtslam.services.viewer.rerun_sink import Outlets, RerunSink
    from vtslam.services.viewer.service import ViewerService
    from vtslam.storage.section_convert import SectionArchive

    settings = parts.settings.viewer
    view = FleetView(
        map_store(parts.folder, parts.settings),
        SectionArchive(parts.run),
        settings=settings,
        splat=parts.settings.splat,
        truth=_truth(parts),
    )
    sink = RerunSink(Outlets.of(settings), title=parts.run.path.name, is_live=True)
    return ViewerService(parts.bus, parts.link, view, sink, cpu_share=settings.cpu_share)


def _truth(parts: _Parts) -> "Poses | None":
    """True poses of the recording, if it is one and has them."""
    from vtslam.services.sensor.sources.registry import open_source

    return None if parts.is_live else open_source(parts.source).ground_truth()


_BUILDERS: dict[str, Callable[[_Parts], "Steps"]] = {
    "sensor": _sensor,
    "tracker": _tracker,
    "mapper": _mapper,
    "archiver": _archiver,
    "recorder": _recorder,
    "viewer": _viewer,
}

if __name__ == "__main__":
    sys.exit(main())

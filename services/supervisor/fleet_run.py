"""Runs a recording through a private fleet, and leaves a run folder."""

import os
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from vtslam.common.bus import Bus, Member
from vtslam.common.bus_zenoh import Hub
from vtslam.common.fleet_folder import FleetFolder, sweep_dead_fleets
from vtslam.common.settings import Settings
from vtslam.common.topics import Role
from vtslam.services.archiver.fleet_record import FleetRecord
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.frame_journal import JournalReader
from vtslam.services.network import Door
from vtslam.services.pacing import pace_of
from vtslam.services.process_facts import peak_rss_mb
from vtslam.services.resume import ResumePoint
from vtslam.services.run_record import RunSummary
from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.supervisor.metrics import FleetMetrics, metrics_server
from vtslam.services.supervisor.processes import LIVE_SOURCE, processes_of
from vtslam.services.supervisor.progress import FleetProgress
from vtslam.services.supervisor.store import map_store
from vtslam.services.supervisor.supervisor import Environment, Supervisor
from vtslam.storage.errors import WriteFailed
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import SectionArchive


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetHooks:
    """What the caller of a fleet run is told and asked.

    Attributes:
        on_frame: Called after each committed frame.
        on_event: Told, in words, when a process died and was started again.
        should_stop: Asked about ten times a second; True ends the run in order, and what was done is kept.
        on_step: Called as often with the supervisor, by experiments.
        environment: Further variables of a process by name, at its n-th start.
    """

    on_frame: Callable[[FrameFacts], None] = lambda facts: None
    on_event: Callable[[str], None] = lambda text: None
    should_stop: Callable[[], bool] = lambda: False
    on_step: Callable[[Supervisor], None] = lambda supervisor: None
    environment: Environment = field(default=lambda name, epoch: {})


def run_in_fleet(
    run: RunFolder,
    settings: Settings,
    hooks: FleetHooks,
    *,
    resume: ResumePoint | None = None,
    fleet: str = "",
    base: Path | None = None,
    door: Door | None = None,
) -> RunSummary:
    """Run the source that ``run.toml`` names, each service a process of its own.

    Args:
        run: A run folder, open for writing, empty unless ``resume`` is given; settings and source are read from its
            ``run.toml``.
        settings: The same settings.
        hooks: What the caller is told and asked.
        resume: Where to go on; from the beginning if None.
        fleet: Name of the fleet; one of its own unless given.
        base: Where the fleet's shared memory lies, if not where it usually does.
        door: How it is opened to other hosts; closed unless given.

    Raises:
        SourceError: A frame cannot be read; what was done before it is kept.
        FleetError: A process cannot be kept alive, or the port for metrics is taken; the poses of all committed frames
            and the sealed sections are kept.
        SharedMemoryError, BusError, PrivateFolderError: Shared memory or bus cannot be set up.
        StorageError: The run folder cannot be written.
    """
    start_s = time.perf_counter()
    sweep_dead_fleets(base=base)
    fleet = fleet or f"run-{os.getpid()}-{secrets.token_hex(3)}"
    folder = FleetFolder.create(fleet, run_folder=str(run.path.resolve()), base=base)
    try:
        store, metrics = map_store(folder, settings), FleetMetrics()

        def on_frame(facts: FrameFacts) -> None:
            metrics.observe(facts)
            hooks.on_frame(facts)

        if resume is not None:
            store.restore(SectionArchive(run).read(resume.section_id), resume.frame, resume.facts.packed())
        # From here on the archiver writes the run folder, until all processes have ended.
        progress = FleetProgress(run.catalog, JournalReader(folder.journal_path), store, on_frame)
        access = None if door is None else door.access_of(folder.path)
        with Hub(folder.path, fleet, access) as hub, hub.bus(Member(fleet=fleet, role=Role.SUPERVISOR)) as bus:
            supervisor = _supervisor(bus, fleet, folder, progress, run, settings, hooks)
            with metrics_server(settings.fleet.metrics_port, metrics, supervisor.children, store):
                try:
                    interrupted = _supervised(supervisor, bus, hooks)
                except Exception as error:
                    if not isinstance(error, WriteFailed):  # whatever it is, what is in memory alone would go with it
                        record = FleetRecord(run, store, JournalReader(folder.journal_path))
                        seconds = time.perf_counter() - start_s
                        record.finish_broken(seconds=seconds, peak_rss_mb=_peak_rss_mb(supervisor))
                    raise
        summary = FleetRecord(run, store, JournalReader(folder.journal_path)).finish(
            finished=not interrupted and supervisor.refusal is None,
            interrupted=interrupted,
            seconds=time.perf_counter() - start_s,
            peak_rss_mb=_peak_rss_mb(supervisor),
        )
    finally:
        folder.remove()
    if supervisor.refusal is not None:
        raise SourceError(str(supervisor.refusal))
    return summary


def _supervisor(
    bus: Bus,
    fleet: str,
    folder: FleetFolder,
    progress: FleetProgress,
    run: RunFolder,
    settings: Settings,
    hooks: FleetHooks,
) -> Supervisor:
    """The supervisor of a run, which has started nothing yet."""
    processes = processes_of(settings)
    for process in processes:
        folder.reserve_last_words(process.name)

    return Supervisor(
        bus,
        fleet=fleet,
        folder=folder,
        processes=processes,
        progress=progress,
        hang_s=settings.fleet.hang_s,
        run_lock=run.lock,
        pacing=pace_of(settings.fleet, live=run.read_info().facts.source == LIVE_SOURCE).pacing,
        on_event=hooks.on_event,
        environment=hooks.environment,
    )


def _peak_rss_mb(supervisor: Supervisor) -> float:
    return peak_rss_mb() + sum(child.peak_rss_mb for child in supervisor.children.values())


def _supervised(supervisor: Supervisor, bus: Bus, hooks: FleetHooks) -> bool:
    """Run the fleet to its end; whether it was asked to stop early."""
    interrupted = False
    try:
        while (patience_s := supervisor.step()) is not None:
            if not interrupted and hooks.should_stop():
                interrupted = True
                supervisor.stop()
            hooks.on_step(supervisor)
            bus.wait(patience_s)
    finally:
        supervisor.kill_all()
    return interrupted

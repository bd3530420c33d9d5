"""``vtslam view``: a finished run or a running fleet to look at."""

import os
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from vtslam.common.bus import Member
from vtslam.common.bus_zenoh import join
from vtslam.common.config import ConfigError, load
from vtslam.common.fleet_folder import FleetFolder, read_owner, running_fleets
from vtslam.common.scheduling import yield_to_others
from vtslam.common.settings import Settings
from vtslam.common.shm.errors import SharedMemoryError
from vtslam.common.topics import Role
from vtslam.services.cli.arguments import WEB_PORT
from vtslam.services.cli.console import Console, Progress
from vtslam.services.cli.record_command import follow
from vtslam.services.cli.stop_request import StopRequest
from vtslam.services.film import write_film
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.run_view import show_run
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.service_link import ServiceLink
from vtslam.services.supervisor.processes import LIVE_SOURCE
from vtslam.services.supervisor.store import map_store
from vtslam.services.viewer.core import Poses
from vtslam.services.viewer.errors import ViewerError
from vtslam.services.viewer.rerun_process import page_url
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import SectionArchive

if TYPE_CHECKING:
    from vtslam.services.viewer.rerun_sink import Outlets

_WAIT_S = 0.2


def view_command(args: Namespace) -> int:
    """Show what the arguments say; the exit status."""
    if (args.run is None) == (not args.live):
        raise ConfigError("view: expected either RUN or --live")
    _check_options(args)
    console = Console(None)
    if args.live:
        return _view_live(args, console)
    run = RecordedRun(args.run)
    if args.film is not None:
        return _film(args, console, run)
    return _view_run(args, console, run)


def _check_options(args: Namespace) -> None:
    """Refuse options that would do nothing."""
    if args.run is not None and args.fleet is not None:
        raise ConfigError(f"--fleet {args.fleet}: expected --live beside it, found the run {args.run}")
    if args.port is not None and not args.web:
        raise ConfigError(f"--port {args.port}: expected --web beside it, found none")
    if not 0 < _port(args) < 65535:
        raise ConfigError(f"--port: expected 1 to 65534, found {args.port}")
    if args.film is not None and (args.web or args.save is not None):
        raise ConfigError(f"--film {args.film}: expected alone, found {'--web' if args.web else '--save'} beside it")


def _port(args: Namespace) -> int:
    """The port of the page."""
    return WEB_PORT if args.port is None else int(args.port)


def _film(args: Namespace, console: Console, run: RecordedRun) -> int:
    with Progress(None, what="filming", unit="picture") as progress:
        write_film(args.film, run, on_picture=progress.step)
    console.print(f"written to {args.film} ({args.film.stat().st_size / 1e6:.1f} MB)")
    return 0


def _view_run(args: Namespace, console: Console, run: RecordedRun) -> int:
    from vtslam.services.viewer.rerun_sink import RerunSink

    sink, limits = RerunSink(_outlets(args), title=run.folder.path.name, is_live=False), run.settings.viewer
    try:
        with Progress(len(run.section_ids()), what="reading", unit="section") as progress, StopRequest() as stop:
            show_run(
                run,
                sink,
                section_gaussians=limits.section_gaussians,
                gaussians=limits.gaussians,
                on_section=progress.step,
            )
            sink.close()
            _say_where(args, console)
            while not stop() and not sink.wait(_WAIT_S):
                pass
    finally:
        sink.end()
    return 0


def _view_live(args: Namespace, console: Console) -> int:
    if args.film is not None:
        raise ConfigError("--film: expected a finished RUN, found --live")
    folder = FleetFolder.open(_fleet(args))
    owner = read_owner(folder.path)
    if owner is None:
        raise SharedMemoryError(f"{folder.path}: expected a running fleet, found one that is gone")
    with RunFolder.open(Path(owner.run_folder)) as run:
        info = run.read_info()
        settings: Settings = load(Settings, [(str(run.path), info.settings)])
        if settings.viewer.idle:
            yield_to_others()  # before there are threads, which take it on
        from vtslam.services.viewer.fleet_view import FleetView
        from vtslam.services.viewer.rerun_sink import RerunSink
        from vtslam.services.viewer.service import ViewerService

        store, archive, truth = map_store(folder, settings), SectionArchive(run), _truth(info.facts.source)
        view = FleetView(store, archive, settings=settings.viewer, splat=settings.splat, truth=truth)
        sink = RerunSink(_outlets(args), title=owner.fleet, is_live=True)
        try:
            _say_where(args, console)
            member = Member(fleet=owner.fleet, role=Role.VIEWER, name=f"viewer-{os.getpid()}")
            with join(member, folder.path) as bus, StopRequest() as stop:
                link = ServiceLink(bus, 1)
                service = ViewerService(bus, link, view, sink, cpu_share=settings.viewer.cpu_share)
                follow(service, bus, link, folder, stop)
                shown = link.counters.get("updates.shown", 0)
                console.print(f"fleet {owner.fleet}: {shown} updates shown, the last of frame {view.last_frame_id}")
                while not stop() and not sink.wait(_WAIT_S):
                    pass
        finally:
            sink.end()
    return 0


def _outlets(args: Namespace) -> "Outlets":
    from vtslam.services.viewer.rerun_sink import Outlets

    return Outlets(web_port=_port(args) if args.web else 0, save=args.save, window=not args.web and args.save is None)


def _say_where(args: Namespace, console: Console) -> None:
    if args.web:
        console.print(f"open {page_url(_port(args))}   (Ctrl-C ends it)")
    if args.save is not None:
        console.print(f"written to {args.save}   (to look at: rerun {args.save})")


def _fleet(args: Namespace) -> str:
    """The fleet that was named, or the only one."""
    if args.fleet is not None:
        return str(args.fleet)
    fleets = running_fleets()
    if len(fleets) != 1:
        found = ", ".join(fleets) if fleets else "none"
        raise ViewerError(f"--live: expected one running fleet, or --fleet NAME, found {found}")
    return fleets[0]


def _truth(source: str) -> Poses | None:
    return None if source == LIVE_SOURCE else open_source(source).ground_truth()

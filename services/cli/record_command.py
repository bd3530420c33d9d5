"""``vtslam record``: what a running fleet sees and finds, in a file."""

import os
from argparse import Namespace
from pathlib import Path

from vtslam.common.bus import Bus, BusError, Member, Steps
from vtslam.common.bus_zenoh import join
from vtslam.common.fleet_folder import FleetFolder, read_owner
from vtslam.common.settings import RecorderSettings
from vtslam.common.shm.errors import DamagedBlock, SharedMemoryError
from vtslam.common.topics import Role
from vtslam.services.cli.console import Console
from vtslam.services.cli.stop_request import StopRequest
from vtslam.services.recorder.files import check_way, make_way, open_recording
from vtslam.services.recorder.service import RecorderService
from vtslam.services.sensor.sources.base import SourceUri
from vtslam.services.service_link import ServiceLink
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.run_info import RunInfo


def record_command(args: Namespace) -> int:
    """Record a fleet until it ends or somebody asks to stop, both of which are normal ends; the exit status."""
    console, folder = Console(args.json), FleetFolder.open(args.fleet)
    settings = RecorderSettings(file=str(args.out), color=args.color)
    info = _run_info(folder)
    check_way(settings, overwrite=args.overwrite, used=_files_of(info))
    member = Member(fleet=args.fleet, role=Role.RECORDER, name=f"recorder-{os.getpid()}")
    with join(member, folder.path) as bus:
        make_way(settings, overwrite=args.overwrite)
        with open_recording(settings, family=info.facts.family) as recording:
            console.print(f"recording fleet {args.fleet} in {args.out}   (Ctrl-C ends it)")
            link = ServiceLink(bus, 1)
            service = RecorderService(bus, link, folder, recording)
            with StopRequest() as stop:
                follow(service, bus, link, folder, stop)
            missed = link.counters.get("frames.missed", 0)
            console.print(f"{recording.num_frames} frames recorded, {missed} missed: {args.out}")
    console.result({"file": str(args.out.resolve()), "frames": recording.num_frames, "missed": missed})
    return 0


def follow(service: Steps, bus: Bus, link: ServiceLink, folder: FleetFolder, stop: StopRequest) -> None:
    """Run a service beside a fleet until that ends, or somebody asks to stop."""
    try:
        while (patience_s := service.step()) is not None:
            link.stopping = link.stopping or stop() or _is_gone(folder)
            bus.wait(patience_s)
    except BusError:
        if not _is_gone(folder):  # else this is how fleets end
            raise


def _is_gone(folder: FleetFolder) -> bool:
    try:
        owner = read_owner(folder.path)
    except DamagedBlock:
        return True
    return owner is None or not owner.is_alive


def _run_info(folder: FleetFolder) -> RunInfo:
    owner = read_owner(folder.path)
    if owner is None:
        raise SharedMemoryError(f"{folder.path}: expected a running fleet, found one that is gone")
    with RunFolder.open(Path(owner.run_folder)) as run:
        return run.read_info()


def _files_of(info: RunInfo) -> list[str]:
    """The files that a fleet reads, and the one it records in itself."""
    return [*SourceUri.parse(info.facts.source).files(), str(info.settings.get("recorder", {}).get("file", ""))]

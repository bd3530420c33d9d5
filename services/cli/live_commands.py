"""``vtslam up`` and ``vtslam publish``: a fleet that waits for frames, and a recording sent to one."""

import json
import sys
from argparse import Namespace
from contextlib import ExitStack
from dataclasses import asdict

from vtslam.common.bus import Bus
from vtslam.common.config import ConfigError
from vtslam.services.cli.arguments import VIEW_ASSIGNMENT, WEB_PORT
from vtslam.services.cli.console import Console, Progress
from vtslam.services.cli.frame_watch import FrameWatch
from vtslam.services.cli.run_command import recording_of, summary_text
from vtslam.services.cli.stop_request import StopRequest
from vtslam.services.network import Door, join_from_elsewhere, read_door
from vtslam.services.sensor.publisher import FramePublisher
from vtslam.services.sensor.sources.base import LiveCamera, live_camera
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.live_run import run_live
from vtslam.services.viewer.rerun_process import page_url


def up_command(args: Namespace) -> int:
    """Run a fleet until Ctrl-C or SIGTERM, which is its normal end; the exit status."""
    console, door = Console(args.json), _door(args)
    console.print(
        f"fleet {args.fleet}: send frames with  vtslam publish SOURCE --fleet {args.fleet}   (Ctrl-C ends it)"
    )
    if VIEW_ASSIGNMENT in args.assignments:
        console.print(f"viewer: {page_url(WEB_PORT)}")
    with StopRequest() as stop, Progress(None, what="mapping", unit="frame") as progress:
        summary = run_live(
            args.out,
            FleetHooks(on_frame=FrameWatch(progress), on_event=progress.note, should_stop=stop),
            fleet=args.fleet,
            preset=args.preset,
            family=args.family or "tum",
            config=args.config,
            assignments=[*args.assignments, *(f"{key}={json.dumps(v)}" for key, v in recording_of(args).items())],
            overwrite=args.overwrite,
            door=door,
        )
    console.print(f"{summary_text(summary)}\nrun folder: {args.out}")
    console.result({"run": str(args.out.resolve()), **asdict(summary)})
    return 0


def publish_command(args: Namespace) -> int:
    """Send a recording to a fleet, or a camera's frames until Ctrl-C; 0 once all of it is in the map."""
    options = {"size": args.size, "range": args.frames}
    source = open_source(args.source, overrides={key: value for key, value in options.items() if value})
    camera = live_camera(source)
    total = len(source) if camera is None else None
    with ExitStack() as stack:
        if camera is not None:
            stack.callback(_leave_camera, camera)
        progress = stack.enter_context(Progress(total, what="publishing", unit="frame"))
        publisher = stack.enter_context(FramePublisher(_fleet(args)))
        for index in range(len(source)):
            publisher.publish(source.frame(index))
            progress.step()
    return 0


def _leave_camera(camera: LiveCamera) -> None:
    camera.close()
    lost = ", ".join(f"{name} {count}" for name, count in camera.counters.items())
    print(f"camera: {lost}", file=sys.stderr)


def _door(args: Namespace) -> Door | None:
    if (args.listen is None) != (args.access is None):
        raise ConfigError("--listen HOST:PORT needs --access FILE, which says who may come in, and the other way round")
    return None if args.listen is None else read_door(args.listen, args.access)


def _fleet(args: Namespace) -> str | Bus:
    """The name of a fleet on this host, or a session with one elsewhere."""
    if (args.connect is None) != (args.credentials is None):
        raise ConfigError("--connect HOST:PORT needs --credentials FILE, and the other way round")
    if args.connect is None:
        return str(args.fleet)
    return join_from_elsewhere(args.fleet, args.connect, args.credentials)

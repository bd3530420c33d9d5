"""``vtslam up`` and ``vtslam publish``: a fleet that waits for frames, and a recording sent to one."""

from argparse import Namespace
from dataclasses import asdict

from vtslam.services.cli.console import Console, Progress
from vtslam.services.cli.frame_watch import FrameWatch
from vtslam.services.cli.run_command import summary_text
from vtslam.services.cli.stop_request import StopRequest
from vtslam.services.sensor.publisher import FramePublisher
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.live_run import run_live


def up_command(args: Namespace) -> int:
    """Run a fleet until Ctrl-C or SIGTERM, which is its normal end; the exit status."""
    console = Console(args.json)
    console.print(
        f"fleet {args.fleet}: send frames with  vtslam publish SOURCE --fleet {args.fleet}   (Ctrl-C ends it)"
    )
    with StopRequest() as stop, Progress(None, what="mapping", unit="frame") as progress:
        summary = run_live(
            args.out,
            FleetHooks(on_frame=FrameWatch(progress), on_event=progress.note, should_stop=stop),
            fleet=args.fleet,
            preset=args.preset,
            family=args.family or "tum",
            config=args.config,
            assignments=args.assignments,
            overwrite=args.overwrite,
        )
    console.print(f"{summary_text(summary)}\nrun folder: {args.out}")
    console.result({"run": str(args.out.resolve()), **asdict(summary)})
    return 0


def publish_command(args: Namespace) -> int:
    """Send a recording to a fleet; 0 once all of it is in the map."""
    options = {"size": args.size, "range": args.frames}
    source = open_source(args.source, overrides={key: value for key, value in options.items() if value})
    with Progress(len(source), what="publishing", unit="frame") as progress, FramePublisher(args.fleet) as publisher:
        for index in range(len(source)):
            publisher.publish(source.frame(index))
            progress.step()
    return 0

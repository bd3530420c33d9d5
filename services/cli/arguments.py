"""The arguments of all commands; imports nothing that is slow, so that ``--help`` answers at once."""

import argparse
from pathlib import Path

from vtslam.services.cli import bench_arguments

SOURCE_HELP = (
    "where frames come from: replica:DIR, 7scenes:DIR, tum:DIR, scannet:DIR|FILE.sens, scannetpp:DIR, "
    "realsense:, kitti:DIR, mcap:FILE, sim:room, sim:city"
)
DEFAULT_PRESET = "fast"
WEB_PORT = 9090
VIEW_ASSIGNMENT = f"viewer.web_port={WEB_PORT}"  # what --view stands for
_JSON_HELP = "write the result as JSON (- for standard output)"


def parser() -> argparse.ArgumentParser:
    """The parser of ``vtslam``; the parsed ``command`` names the command."""
    top = argparse.ArgumentParser(
        prog="vtslam",
        description="RGB-D SLAM by splatting view-tied 3D Gaussians.",
        epilog="first steps: vtslam demo",
    )
    top.add_argument("--version", action="store_true", help="print the version and end")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")
    _add_demo(commands)
    _add_run(commands)
    _add_up(commands)
    _add_publish(commands)
    _add_record(commands)
    _add_status(commands)
    _add_view(commands)
    _add_eval(commands)
    _add_sections(commands)
    _add_bench(commands)
    _add_settings(commands)
    _add_doctor(commands)
    return top


_Commands = argparse._SubParsersAction  # argparse has no public name for it


def _command(
    commands: "_Commands[argparse.ArgumentParser]", name: str, text: str, *, example: str
) -> argparse.ArgumentParser:
    return commands.add_parser(
        name,
        help=text,
        description=text[0].upper() + text[1:] + ".",
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _add_demo(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "demo",
        "map a simulated room, judge the result, and draw it",
        example="vtslam demo --out /tmp/demo --set source.noise=kinect",
    )
    command.add_argument("--out", type=Path, default=Path("vtslam-demo"), help="run folder (default: %(default)s)")
    _add_assignments(command)
    command.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_run(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "run",
        "track and map a recording",
        example="vtslam run replica:DIR --size 320x240 --frames 0:120 --out RUN",
    )
    command.add_argument("source", nargs="?", metavar="SOURCE", help=SOURCE_HELP)
    command.add_argument(
        "--in-process",
        action="store_true",
        help="one process for all services; the result is that of lockstep",
    )
    command.add_argument("--out", type=Path, metavar="RUN", help="run folder to make")
    command.add_argument(
        "--overwrite", action="store_true", help="give up an earlier run in RUN, and an earlier recording"
    )
    command.add_argument(
        "--resume",
        type=Path,
        metavar="RUN",
        help="go on with a run that was cut off or stopped, with its own source and settings",
    )
    _add_pacing(command, default="lockstep")
    _add_recording(command)
    _add_viewing(command)
    _add_poses(command)
    _add_layers(command)
    command.set_defaults(preset=None)  # so that it is known whether one was asked for
    _add_source_shorthands(command)
    command.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_up(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "up",
        "start a fleet that maps what publishers send it, until Ctrl-C",
        example="vtslam up --fleet kitchen --out RUN",
    )
    command.add_argument("--out", type=Path, required=True, metavar="RUN", help="run folder to make")
    command.add_argument("--fleet", default="vtslam", metavar="NAME", help="name of the fleet (default: %(default)s)")
    command.add_argument(
        "--overwrite", action="store_true", help="give up an earlier run in RUN, and an earlier recording"
    )
    _add_pacing(command, default="realtime")
    _add_recording(command)
    _add_viewing(command)
    command.add_argument("--listen", metavar="HOST:PORT", help="let other hosts in here; needs --access")
    command.add_argument("--access", type=Path, metavar="FILE", help="who may come in (TOML, see deploy/runbook.md)")
    _add_layers(command)
    command.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_publish(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "publish",
        "send a recording to a fleet, as a sensor would",
        example="vtslam publish sim:room --size 160x120 --fleet kitchen",
    )
    command.add_argument("source", metavar="SOURCE", help=SOURCE_HELP)
    command.add_argument("--fleet", default="vtslam", metavar="NAME", help="name of the fleet (default: %(default)s)")
    command.add_argument("--connect", metavar="HOST:PORT", help="a fleet on another host; needs --credentials")
    command.add_argument("--credentials", type=Path, metavar="FILE", help="login or certificate (TOML)")
    command.add_argument("--size", metavar="WxH", help="scale frames to this size")
    command.add_argument("--frames", metavar="A:B", help="frames A to B-1 only")


def _add_record(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "record",
        "record what a running fleet sees and finds, until it ends or Ctrl-C",
        example="vtslam record --fleet kitchen --out kitchen.mcap",
    )
    command.add_argument("--fleet", default="vtslam", metavar="NAME", help="name of the fleet (default: %(default)s)")
    command.add_argument("--out", type=Path, required=True, metavar="FILE", help="MCAP file to make")
    command.add_argument(
        "--overwrite", action="store_true", help="give up an earlier recording, FILE-2 and so on included"
    )
    command.add_argument("--color", choices=["png", "jpeg"], default="png", help="png keeps every bit (default)")
    command.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_status(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands, "status", "show the services of running fleets", example="vtslam status --fleet run-4711-a3f09c"
    )
    command.add_argument("--fleet", metavar="NAME", help="this fleet (default: all of this user)")
    command.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_view(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "view",
        "look at a finished run, or at a running fleet: map, camera, images, figures",
        example="vtslam view RUN --web\n  vtslam view --live --save kitchen.rrd\n  vtslam view RUN --film film.webp",
    )
    command.add_argument("run", nargs="?", type=Path, metavar="RUN", help="a run folder")
    command.add_argument("--live", action="store_true", help="a running fleet instead")
    command.add_argument("--fleet", metavar="NAME", help="its name (default: the only one of this user)")
    command.add_argument("--web", action="store_true", help="serve a page on 127.0.0.1, not a window")
    command.add_argument("--port", type=int, metavar="N", help=f"of that page; its data take N+1 (default: {WEB_PORT})")
    command.add_argument("--save", type=Path, metavar="FILE", help="keep it in a file (.rrd) instead, or beside --web")
    command.add_argument("--film", type=Path, metavar="FILE", help="only draw how the map grew (.webp, .gif)")


def _add_eval(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands, "eval", "judge a run against its recording; writes RUN/metrics.json", example="vtslam eval RUN"
    )
    command.add_argument("run", type=Path, metavar="RUN", help="a run folder")
    command.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_sections(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "sections",
        "list, verify, repair or repack the sections of a run",
        example="vtslam sections verify RUN",
    )
    actions = command.add_subparsers(dest="action", metavar="WHAT", required=True)
    actions.add_parser("ls", help="what is there, from the catalogue")
    actions.add_parser("verify", help="read every section and hold it against the catalogue")
    actions.add_parser("repair", help="finish what was cut off, set damaged files aside (RUN/damaged)")
    repack = actions.add_parser("repack", help="write all sections anew with another codec; fast and dense round")
    repack.add_argument("--codec", default="dense", metavar="NAME", help="the codec (default: %(default)s)")
    for action in actions.choices.values():
        action.add_argument("run", type=Path, metavar="RUN", help="a run folder")
        action.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_bench(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "bench",
        "measure rendering, tracking, mapping or the whole system on this machine, or try a fleet's recovery",
        example="vtslam bench splat --size 640x480 --threads 2 --json FILE",
    )
    kinds = command.add_subparsers(dest="bench", metavar="WHAT", required=True)
    bench_arguments.add_kinds(kinds, source_help=SOURCE_HELP)
    for name, kind in kinds.choices.items():
        if name in bench_arguments.WITH_SOURCE:
            kind.add_argument("source", metavar="SOURCE", help=SOURCE_HELP)
        if name in bench_arguments.WITH_LAYERS:
            _add_layers(kind)
        if name in bench_arguments.WITH_SHORTHANDS:
            _add_source_shorthands(kind)
        kind.add_argument("--json", metavar="FILE", help=_JSON_HELP)
        kind.add_argument("--compare", metavar="FILE", help="an earlier result (--json) to set beside this one")


def _add_settings(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "settings",
        "list all settings: effective value, type, range",
        example="vtslam settings --preset paper --family replica",
    )
    _add_layers(command)
    command.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_doctor(commands: "_Commands[argparse.ArgumentParser]") -> None:
    command = _command(
        commands,
        "doctor",
        "check the installation and this machine, or a recording",
        example="vtslam doctor\n  vtslam doctor replica:DIR",
    )
    command.add_argument("source", nargs="?", metavar="SOURCE", help=f"look for faults of a recording; {SOURCE_HELP}")
    command.add_argument("--gpu", action="store_true", help="check the CUDA engine against the reference instead")
    command.add_argument("--json", metavar="FILE", help=_JSON_HELP)


def _add_source_shorthands(command: argparse.ArgumentParser) -> None:
    command.add_argument("--size", metavar="WxH", help="scale frames to this size (source.size)")
    command.add_argument("--frames", metavar="A:B", help="frames A to B-1 only (source.frames)")
    command.add_argument(
        "--holdout", type=int, metavar="K", help="track every K-th regular frame but keep it out of mapping (holdout)"
    )


def _add_poses(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--poses",
        metavar="FILE|TOPIC",
        help="poses from elsewhere: a trajectory (TUM), or transforms in the recording, as in /tf (source.poses)",
    )
    command.add_argument(
        "--poses-sigma", metavar="M,DEG", help="their standard deviations (source.poses_sigma; default: 0.05,1)"
    )
    command.add_argument(
        "--tracking", choices=["on", "off"], help="off: such poses are taken as they are (tracker.enabled)"
    )


def _add_recording(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--record", metavar="FILE", help="record frames, poses and events in this MCAP file (recorder.file)"
    )


def _add_viewing(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--view",
        dest="assignments",
        action="append_const",
        const=VIEW_ASSIGNMENT,
        help=f"show it in a browser while it lasts, at port {WEB_PORT} of 127.0.0.1 (viewer.web_port)",
    )


def _add_pacing(command: argparse.ArgumentParser, *, default: str) -> None:
    command.add_argument(
        "--pacing",
        dest="assignments",
        action="append",
        default=[],
        type=lambda text: f'fleet.pacing="{text}"',
        metavar="P",
        help="lockstep: every frame, one after another; pipelined: the next is tracked while one is mapped; realtime: "
        f"the newest, others are dropped (fleet.pacing; default: {default})",
    )


def _add_layers(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--preset",
        default=DEFAULT_PRESET,
        metavar="P",
        help="schedule: fast, paper, released, realtime (default: fast)",
    )
    command.add_argument(
        "--family",
        metavar="F",
        help="kind of recording: tum, replica, scannet, scannetpp, kitti (default: as the source says)",
    )
    command.add_argument("--config", type=Path, metavar="FILE", help="TOML file of settings")
    _add_assignments(command)


def _add_assignments(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--set",
        dest="assignments",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="one setting, as in section.length=20; may be repeated (all keys: vtslam settings)",
    )

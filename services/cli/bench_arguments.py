"""What the kinds of ``vtslam bench`` take beside what all commands with a source or settings do."""

import argparse
from pathlib import Path

_Commands = argparse._SubParsersAction  # argparse has no public name for it

# By what they take: a source as their first word; the settings; parts and size of a recording.
WITH_SOURCE = ("track", "map", "curves", "system", "basin", "variants", "fleet", "viewer")
WITH_LAYERS = (*WITH_SOURCE, "codec", "chaos", "resume", "city")
WITH_SHORTHANDS = (*WITH_SOURCE, "codec", "chaos", "resume")


def add_kinds(kinds: "_Commands[argparse.ArgumentParser]", *, source_help: str) -> None:
    """Add all kinds with their own arguments."""
    _add_tracking_and_mapping(kinds)
    _add_storage(kinds, source_help)
    _add_fleets(kinds)


def _add_tracking_and_mapping(kinds: "_Commands[argparse.ArgumentParser]") -> None:
    splat = kinds.add_parser("splat", help="one rendering, its gradients and the loss, on a fixed scene")
    splat.add_argument("--scene", choices=["yardstick"], default="yardstick", help="the scene (default: %(default)s)")
    splat.add_argument("--size", default="640x480", metavar="WxH", help="image (default: %(default)s)")
    splat.add_argument("--threads", type=int, default=2, metavar="N", help="threads (default: %(default)s)")
    splat.add_argument("--repeats", type=int, default=15, metavar="N", help="measurements (default: %(default)s)")
    kinds.add_parser("track", help="tracking on a recording, beside OpenCV's RGB-D odometry")
    kinds.add_parser("map", help="mapping alone, at the recording's true poses")
    curves = kinds.add_parser("curves", help="mapping at the true poses: quality by time, for two schedules")
    curves.add_argument(
        "--presets", default="fast,paper", metavar="A,B", help="schedules, two at most (default: %(default)s)"
    )
    curves.add_argument(
        "--shares", default="0.25,0.5,1,2", metavar="X,Y", help="shares of their steps (default: %(default)s)"
    )
    curves.add_argument("--picture", type=Path, metavar="FILE", help="draw the curves, PNG or JPEG")
    kinds.add_parser("system", help="a whole run: time by stage, and quality")
    basin = kinds.add_parser("basin", help="how far off a first guess of the pose may be, for both optimisers")
    basin.add_argument("--trials", type=int, default=30, metavar="N", help="guesses per error (default: %(default)s)")
    variants = kinds.add_parser("variants", help="ways to estimate a pose, compared on the same maps and guesses")
    variants.add_argument(
        "--trials", type=int, default=24, metavar="N", help="guesses per error (default: %(default)s)"
    )
    variants.add_argument("--only", default="", metavar="A,B", help="these of them (default: all)")


def _add_storage(kinds: "_Commands[argparse.ArgumentParser]", source_help: str) -> None:
    codec = kinds.add_parser("codec", help="sections stored in each codec: bytes, quality lost, speed")
    codec.add_argument("--source", required=True, metavar="SOURCE", help=source_help)
    codec.add_argument("--curves", action="store_true", help="also coarser and finer grids of the dense codec")
    codec.add_argument("--picture", type=Path, metavar="FILE", help="draw the curves (with --curves), PNG or JPEG")
    overlap = kinds.add_parser("overlap", help="choosing overlapping sections on a long road")
    overlap.add_argument("--views", type=int, default=100_000, metavar="N", help="along it (default: %(default)s)")
    overlap.add_argument("--size", default="310x94", metavar="WxH", help="images (default: %(default)s)")


def _add_fleets(kinds: "_Commands[argparse.ArgumentParser]") -> None:
    fleet = kinds.add_parser("fleet", help="a run as processes, beside the same in one process; delays in realtime")
    fleet.add_argument("--rounds", type=int, default=1, metavar="N", help="runs of each kind (default: %(default)s)")
    fleet.add_argument(
        "--parts", default="ratios,latency,realtime", metavar="A,B", help="what is measured (default: %(default)s)"
    )
    fleet.add_argument(
        "--live-seconds", type=float, default=60.0, metavar="S", help="of latency and realtime (default: %(default)g)"
    )
    fleet.add_argument(
        "--latency-size", default="1200x680", metavar="WxH", help="frames of latency, at 30 Hz (default: %(default)s)"
    )
    fleet.add_argument(
        "--live-size", default="320x240", metavar="WxH", help="frames of realtime, at 60 Hz (default: %(default)s)"
    )
    viewer = kinds.add_parser("viewer", help="what a viewer costs a fleet: with one, with one killed, with one hung")
    viewer.add_argument("--rounds", type=int, default=3, metavar="N", help="runs of each kind (default: %(default)s)")
    chaos = kinds.add_parser("chaos", help="a fleet whose processes are killed and stopped: is the result the same?")
    chaos.add_argument("--kills", type=int, default=36, metavar="N", help="kills (default: %(default)s)")
    chaos.add_argument("--hangs", type=int, default=5, metavar="N", help="stops of 15 s (default: %(default)s)")
    chaos.add_argument("--seed", type=int, default=1, metavar="S", help="draws them (default: %(default)s)")
    chaos.add_argument(
        "source", nargs="?", default="sim:room?frames=120&size=160x120", metavar="SOURCE", help="default: %(default)s"
    )
    resume = kinds.add_parser("resume", help="a fleet killed as a whole, and resumed, N times: is the result the same?")
    resume.add_argument("--kills", type=int, default=10, metavar="N", help="kills (default: %(default)s)")
    resume.add_argument("--seed", type=int, default=1, metavar="S", help="draws them (default: %(default)s)")
    resume.add_argument(
        "source", nargs="?", default="sim:room?frames=300&size=64x48", metavar="SOURCE", help="default: %(default)s"
    )
    city = kinds.add_parser("city", help="a long drive through the simulated town as a fleet: does anything grow?")
    city.add_argument("--frames", type=int, metavar="N", help="the first N (default: the whole drive)")
    city.add_argument("--size", default="310x94", metavar="WxH", help="images (default: %(default)s)")
    city.add_argument("--budget-mb", type=int, default=48, metavar="B", help="of the map (default: %(default)s)")
    city.add_argument("--trajectory", type=Path, metavar="FILE", help="KITTI poses to drive along, not round a block")
    city.add_argument("--laps", type=int, default=3, metavar="L", help="of 300 m round a block (default: %(default)s)")
    city.add_argument("--pose-prior", metavar="M,DEG", help="give the true poses along, with errors of such sizes")

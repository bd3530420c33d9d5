"""``vtslam bench``: what rendering, tracking, mapping or the whole system costs here."""

import sys
from argparse import Namespace
from pathlib import Path

from vtslam.common.config import ConfigError
from vtslam.common.preset_loading import load_settings
from vtslam.services.bench.basin import bench_basin
from vtslam.services.bench.chaos import bench_chaos, is_sound
from vtslam.services.bench.city import CityDrive, bench_city
from vtslam.services.bench.codec import bench_codec, steps
from vtslam.services.bench.codec_picture import write_codec_picture
from vtslam.services.bench.comparison import comparison_table, read_result, surroundings
from vtslam.services.bench.first_guesses import ERRORS_M_DEG
from vtslam.services.bench.fleet import PARTS, FleetBench, bench_fleet
from vtslam.services.bench.map_curves import MOST_SCHEDULES, bench_map_curves, write_map_picture
from vtslam.services.bench.overlap import HEADS, bench_overlap
from vtslam.services.bench.recording import bench_map, bench_system, bench_track
from vtslam.services.bench.resume import bench_resume, is_whole
from vtslam.services.bench.splat import bench_splat
from vtslam.services.bench.variants import bench_variants
from vtslam.services.bench.viewer import bench_viewer
from vtslam.services.cli.console import Console, Progress
from vtslam.services.cli.run_command import assignments_of
from vtslam.services.run_plan import RunPlan, plan_run

_LARGEST_SIDE_PX = 16384
_OF_RECORDINGS = {"track": bench_track, "map": bench_map, "system": bench_system}


def bench_command(args: Namespace) -> int:
    """Measure as the arguments say; the exit status."""
    console = Console(args.json)
    earlier = None if args.compare is None else read_result(Path(args.compare))
    if earlier is not None and earlier["bench"] != args.bench:
        raise ConfigError(
            f"--compare {args.compare}: expected a result of bench {args.bench}, found {earlier['bench']}"
        )
    values = _measured(args)
    console.print(comparison_table(values, earlier))
    about = surroundings(["vtslam", *sys.argv[1:]])
    console.result({"bench": args.bench, **values, "about": about})
    return 0 if _is_good(args, values) else 1


def _is_good(args: Namespace, values: dict[str, object]) -> bool:
    """Whether what was tried, rather than measured, went well."""
    if args.bench == "resume":
        return is_whole(values, kills=args.kills)
    return args.bench != "chaos" or is_sound(values)


def _measured(args: Namespace) -> dict[str, object]:
    kinds = {
        "splat": _splat,
        "basin": _basin,
        "codec": _codec,
        "curves": _curves,
        "chaos": _chaos,
        "city": _city,
        "fleet": _fleet,
        "overlap": _overlap,
        "variants": _variants,
        "resume": _resume,
        "viewer": _viewer,
    }
    return kinds.get(args.bench, _recording)(args)


def _splat(args: Namespace) -> dict[str, object]:
    if args.threads < 1 or args.repeats < 1:
        raise ConfigError(
            f"bench splat: expected --threads and --repeats of at least 1, found {args.threads}, {args.repeats}"
        )
    with Progress(args.repeats, what="measuring", unit="repeat") as progress:
        return bench_splat(_size(args.size), threads=args.threads, repeats=args.repeats, on_step=progress.step)


def _overlap(args: Namespace) -> dict[str, object]:
    if args.views < 1000:
        raise ConfigError(f"bench overlap: expected --views of at least 1000, found {args.views}")
    tracker = load_settings(preset="fast", family="kitti", file=None, assignments=[]).tracker
    with Progress(HEADS, what="choosing", unit="head") as progress:
        return bench_overlap(_size(args.size), views=args.views, tracker=tracker, on_step=progress.step)


def _basin(args: Namespace) -> dict[str, object]:
    if args.trials < 1:
        raise ConfigError(f"bench basin: expected --trials of at least 1, found {args.trials}")
    plan = _plan(args)
    with Progress(2 * len(ERRORS_M_DEG) * args.trials, what="tracking", unit="guess") as progress:
        return bench_basin(plan, trials=args.trials, on_step=progress.step)


def _variants(args: Namespace) -> dict[str, object]:
    if args.trials < 0:
        raise ConfigError(f"bench variants: expected --trials of at least 0, found {args.trials}")
    plan, only = _plan(args), [name for name in args.only.split(",") if name]
    with Progress(len(plan.source), what="comparing", unit="frame") as progress:
        return bench_variants(plan, trials=args.trials, only=only, on_step=progress.step)


def _curves(args: Namespace) -> dict[str, object]:
    presets = args.presets.split(",")
    try:
        shares = [float(text) for text in args.shares.split(",")]
    except ValueError:
        shares = []
    if len(presets) > MOST_SCHEDULES or not shares or not all(0.0 < share <= 100.0 for share in shares):
        raise ConfigError(
            f"bench curves: expected --presets of at most {MOST_SCHEDULES} and --shares above 0 and at most 100, "
            f"found {args.presets} and {args.shares}"
        )
    plans = {preset: _plan(args, preset=preset) for preset in presets}
    with Progress(len(plans) * len(shares), what="mapping", unit="run") as progress:
        found = bench_map_curves(plans, shares, on_step=progress.step)
    if args.picture is not None:
        write_map_picture(args.picture, found)
    return found


def _codec(args: Namespace) -> dict[str, object]:
    if args.picture is not None and not args.curves:
        raise ConfigError("bench codec: --picture draws curves: expected --curves with it")
    plan = _plan(args)
    with Progress(steps(curves=args.curves), what="mapping and storing", unit="step") as progress:
        found = bench_codec(plan, curves=args.curves, on_step=progress.step)
    if args.picture is not None:
        write_codec_picture(args.picture, found)
    return found


def _chaos(args: Namespace) -> dict[str, object]:
    if args.kills < 0 or args.hangs < 0:
        raise ConfigError(f"bench chaos: expected --kills and --hangs of at least 0, found {args.kills}, {args.hangs}")
    plan = _plan(args)
    with Progress(len(plan.source), what="mapping under fire", unit="frame") as progress:
        return bench_chaos(
            plan, kills=args.kills, hangs=args.hangs, seed=args.seed, on_frame=lambda facts: progress.step()
        )


def _resume(args: Namespace) -> dict[str, object]:
    if args.kills < 0:
        raise ConfigError(f"bench resume: expected --kills of at least 0, found {args.kills}")
    plan = _plan(args)
    with Progress(args.kills, what="killing and resuming", unit="kill") as progress:
        return bench_resume(plan, kills=args.kills, seed=args.seed, on_kill=progress.step)


def _fleet(args: Namespace) -> dict[str, object]:
    parts = args.parts.split(",")
    if args.rounds < 1 or args.live_seconds <= 0.0 or not set(parts) <= set(PARTS):
        raise ConfigError(
            f"bench fleet: expected --rounds of at least 1, --live-seconds above 0 and --parts of {','.join(PARTS)}, "
            f"found {args.rounds}, {args.live_seconds:g}, {args.parts}"
        )
    bench = FleetBench(
        rounds=args.rounds, live_seconds=args.live_seconds, live_sizes=(_size(args.latency_size), _size(args.live_size))
    )
    return bench_fleet(_plan(args), parts, bench, on_part=lambda text: print(f"bench fleet: {text}", file=sys.stderr))


def _viewer(args: Namespace) -> dict[str, object]:
    if args.rounds < 1:
        raise ConfigError(f"bench viewer: expected --rounds of at least 1, found {args.rounds}")
    return bench_viewer(
        _plan(args), rounds=args.rounds, on_part=lambda text: print(f"bench viewer: {text}", file=sys.stderr)
    )


def _city(args: Namespace) -> dict[str, object]:
    if args.budget_mb < 1 or args.laps < 1 or (args.frames is not None and args.frames < 1):
        raise ConfigError(
            "bench city: expected --budget-mb, --laps and --frames of at least 1, "
            f"found {args.budget_mb}, {args.laps}, {args.frames}"
        )
    drive = CityDrive(
        frames=args.frames,
        size=_size(args.size),
        budget_mb=args.budget_mb,
        trajectory=args.trajectory,
        laps=args.laps,
        pose_prior=args.pose_prior,
    )

    def plan(uri: str, assignments: list[str]) -> RunPlan:
        words = [*assignments, *args.assignments]
        return plan_run(uri, preset=args.preset, family=args.family, config=args.config, assignments=words)

    run_plan = plan(drive.uri, drive.assignments)
    with Progress(len(run_plan.source), what="driving", unit="frame") as progress:
        return bench_city(drive, run_plan, on_frame=lambda facts: progress.step())


def _recording(args: Namespace) -> dict[str, object]:
    return _OF_RECORDINGS[args.bench](_plan(args))


def _plan(args: Namespace, *, preset: str | None = None) -> RunPlan:
    return plan_run(
        args.source,
        preset=preset or args.preset,
        family=args.family,
        config=args.config,
        assignments=assignments_of(args),
    )


def _size(text: str) -> tuple[int, int]:
    width, x, height = text.partition("x")
    if x and width.isdecimal() and height.isdecimal():
        size = int(width), int(height)
        if all(1 <= side <= _LARGEST_SIDE_PX for side in size):
            return size
    raise ConfigError(f"--size: expected WIDTHxHEIGHT of 1 to {_LARGEST_SIDE_PX} pixels, found {text!r}")

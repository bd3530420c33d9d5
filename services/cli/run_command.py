"""``vtslam run``: track and map a recording."""

import json
import os
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path

from vtslam.common.config import ConfigError
from vtslam.common.settings import Settings
from vtslam.services.cli.arguments import DEFAULT_PRESET
from vtslam.services.cli.console import Console, Progress
from vtslam.services.cli.frame_watch import FrameWatch
from vtslam.services.cli.stop_request import StopRequest
from vtslam.services.pacing import Pacing
from vtslam.services.recorded_run import holds_every_frame
from vtslam.services.run_plan import RunPlan, plan_resume, plan_run
from vtslam.services.run_record import RunSummary
from vtslam.services.viewer.rerun_process import page_url
from vtslam.storage.errors import WriteFailed
from vtslam.storage.run_folder import RunFolder


def run_command(args: Namespace) -> int:
    """Run as the arguments say; the exit status."""
    console = Console(args.json)
    out = _checked_out(args)
    plan = plan_resume(out) if args.resume else _plan(args)
    pacing = plan.settings.fleet.pacing
    if args.in_process and pacing not in ("", Pacing.LOCKSTEP):
        raise ConfigError(f"--in-process works in lockstep, expected no other pacing, found {pacing}")
    say_page(console, plan.settings)
    if args.in_process and plan.settings.viewer.is_wanted:
        raise ConfigError("--in-process has no viewer: leave out --view, or look at the run afterwards (vtslam view)")
    console.print(f"{plan.source.uri}: {len(plan.source)} frames, preset {plan.preset}, family {plan.family}")
    with StopRequest() as stop:
        try:
            summary = _watched(args, plan, out, stop)
        except WriteFailed as error:
            raise type(error)(f"{error}; what was stored is kept: vtslam run --resume {out}") from error
    console.print(f"{summary_text(summary)}\nrun folder: {out}{_hint(out)}")
    console.result({"run": str(out.resolve()), "source": plan.source.uri, **asdict(summary)})
    return stop.exit_status if summary.interrupted else 0


def _hint(out: Path) -> str:
    """What to do next, if that can be done."""
    with RunFolder.open(out) as run:
        return f"   (next: vtslam eval {out})" if holds_every_frame(run) else ""


def say_page(console: Console, settings: Settings) -> None:
    """Say where the viewer's page is, if there is to be one."""
    if settings.viewer.web_port:
        console.print(f"viewer: {page_url(settings.viewer.web_port)}")


def _checked_out(args: Namespace) -> Path:
    """The run folder, if the arguments go together."""
    out: Path | None = args.resume or args.out
    if args.resume is None and (args.source is None or out is None):
        raise ConfigError("run: expected SOURCE and --out RUN, or --resume RUN")
    layers = args.preset or args.family or args.config or assignments_of(args)
    if args.resume is not None and (args.source or args.out or args.overwrite or layers):
        raise ConfigError(
            f"run: --resume {args.resume} goes on with the run's own source and settings, and a run that records goes "
            "on recording; it takes --in-process and --json only"
        )
    assert out is not None
    return out


def _plan(args: Namespace) -> RunPlan:
    return plan_run(
        args.source,
        preset=args.preset or DEFAULT_PRESET,
        family=args.family,
        config=args.config,
        assignments=assignments_of(args),
    )


def _watched(args: Namespace, plan: RunPlan, out: Path, stop: StopRequest) -> RunSummary:
    if args.resume:
        return _watched_resume(plan, out, stop, in_process=args.in_process)
    watched = watched_run if args.in_process else watched_fleet
    return watched(plan, out, stop, overwrite=args.overwrite)


def _watched_resume(plan: RunPlan, out: Path, stop: StopRequest, *, in_process: bool) -> RunSummary:
    """Go on with a run, with progress as in a whole one."""
    from vtslam.services.supervisor.fleet_run import FleetHooks

    with Progress(len(plan.source), what="mapping", unit="frame") as progress:
        watch = FrameWatch(progress)
        if in_process:
            return plan.resume(out, on_frame=watch, should_stop=stop)
        return plan.resume_in_fleet(out, FleetHooks(on_frame=watch, on_event=progress.note, should_stop=stop))


def watched_run(
    plan: RunPlan, out: Path, stop: StopRequest, *, overwrite: bool, created_by: str | None = None
) -> RunSummary:
    """Execute a plan with progress and lines about lost tracking."""
    with Progress(len(plan.source), what="mapping", unit="frame") as progress:
        return plan.execute(
            out, overwrite=overwrite, created_by=created_by, on_frame=FrameWatch(progress), should_stop=stop
        )


def watched_fleet(plan: RunPlan, out: Path, stop: StopRequest, *, overwrite: bool) -> RunSummary:
    """Execute a plan in processes, with progress and lines about lost tracking and processes that died."""
    from vtslam.services.supervisor.fleet_run import FleetHooks

    with Progress(len(plan.source), what="mapping", unit="frame") as progress:
        hooks = FleetHooks(on_frame=FrameWatch(progress), on_event=progress.note, should_stop=stop)
        return plan.execute_in_fleet(out, hooks, overwrite=overwrite)


def recording_of(args: Namespace) -> dict[str, str]:
    """The settings that ``--record`` stands for, if it was given."""
    file: str | None = getattr(args, "record", None)  # not every command that shares the others has it
    return {} if file is None else {"recorder.file": os.path.abspath(file)}


def _poses_of(args: Namespace) -> dict[str, str | bool | float]:
    """The settings that ``--poses``, ``--poses-sigma`` and ``--tracking`` stand for, as far as they were given."""
    shorthands = {"source.poses": "poses", "source.poses_sigma": "poses_sigma"}
    given = {key: getattr(args, name, None) for key, name in shorthands.items()}
    settings: dict[str, str | bool | float] = {key: value for key, value in given.items() if value is not None}
    tracking = getattr(args, "tracking", None)
    if tracking is not None:
        settings |= {"tracker.enabled": tracking == "on"}
    if tracking == "off":  # such poses are not refined either
        settings |= {"mapper.bundle_rotation_rate": 0.0, "mapper.bundle_translation_rate": 0.0}
    return settings


def summary_text(summary: RunSummary) -> str:
    """The end of a run in words."""
    rate = summary.frames / summary.seconds if summary.seconds > 0 else 0.0
    lines = [
        f"{summary.frames} frames in {summary.seconds:.1f} s ({rate:.2f} frames/s): {summary.sections} sections, "
        f"{summary.gaussians} Gaussians, peak memory {summary.peak_rss_mb:.0f} MB"
    ]
    if summary.weak or summary.lost:
        lines.append(f"tracking was weak on {summary.weak} frames and lost on {summary.lost}")
    if summary.interrupted:
        lines.append("stopped early; what was done is kept")
    return "\n".join(lines)


def assignments_of(args: Namespace) -> list[str]:
    """``--set`` texts, and those that the short options stand for."""
    shorthands = {"source.size": args.size, "source.frames": args.frames, "holdout": args.holdout}
    given = {key: value for key, value in shorthands.items() if value is not None}
    given |= recording_of(args) | _poses_of(args)
    # JSON's quotes are TOML's: a size of 48 stays a text, which the source then explains.
    return [*args.assignments, *(f"{key}={json.dumps(value)}" for key, value in given.items())]

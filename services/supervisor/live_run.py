"""Runs a fleet that waits for publishers, and leaves a run folder when it is told to end."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from vtslam.common.config import to_dict
from vtslam.common.preset_loading import load_settings
from vtslam.services.engines import engine_versions, make_engine
from vtslam.services.network import Door
from vtslam.services.process_facts import program_version, versions
from vtslam.services.recorder.files import check_way, make_way
from vtslam.services.run_record import RunSummary
from vtslam.services.supervisor.fleet_run import FleetHooks, run_in_fleet
from vtslam.services.supervisor.processes import LIVE_SOURCE
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.run_info import RunFacts, RunInfo


def run_live(
    out: Path,
    hooks: FleetHooks,
    *,
    fleet: str,
    preset: str,
    family: str,
    config: Path | None = None,
    assignments: Sequence[str] = (),
    overwrite: bool = False,
    door: Door | None = None,
) -> RunSummary:
    """Run a fleet until ``hooks.should_stop``, mapping every frame that publishers send.

    Args:
        out: The run folder to make.
        hooks: What the caller is told and asked.
        fleet: Name of the fleet; publishers ask for it.
        preset: Schedule.
        family: Kind of sensor.
        config: A user's TOML file, or None.
        assignments: ``key=value`` texts.
        overwrite: Give up an earlier run in ``out``.
        door: How it is opened to other hosts; closed unless given.

    Raises:
        ConfigError: A setting is refused.
        FleetError, SharedMemoryError, BusError, StorageError: See `run_in_fleet`.
    """
    settings = load_settings(preset=preset, family=family, file=config, assignments=assignments)
    make_engine(settings.splat)  # refused here, before anything starts
    facts = RunFacts(
        created_by=f"vtslam {program_version()}",
        source=LIVE_SOURCE,
        family=family,
        preset=preset,
        width=0,
        height=0,
        first_frame=0,
        end_frame=0,
    )
    info = RunInfo(facts=facts, settings=to_dict(settings), versions={**versions(), **engine_versions(settings.splat)})
    check_way(settings.recorder, overwrite=overwrite)
    with RunFolder.create(out, info, overwrite=overwrite) as run:
        make_way(settings.recorder, overwrite=overwrite)
        summary = run_in_fleet(run, settings, hooks, fleet=fleet, door=door)
        _complete(run, summary)
    return replace(summary, interrupted=False)


def _complete(run: RunFolder, summary: RunSummary) -> None:
    """What is known of a live run only at its end; being told to end is how it ends."""
    info = run.read_info()
    facts = replace(info.facts, finished=True, interrupted=False, end_frame=summary.frames)
    if summary.sections:
        camera = run.read_section(0).camera
        facts = replace(facts, width=camera.width, height=camera.height)
    run.write_info(replace(info, facts=facts))

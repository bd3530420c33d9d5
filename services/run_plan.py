"""A run before it starts: source, settings and engine, all checked, so that nothing is refused half-way."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from vtslam.common.config import ConfigError, load, to_dict
from vtslam.common.preset_loading import load_settings
from vtslam.common.section_end import SectionEnd, least_budget_mb
from vtslam.common.settings import Settings, SourceSettings
from vtslam.common.splat.engine import Engine
from vtslam.services.engines import engine_versions, make_engine
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.pacing import pace_of
from vtslam.services.process_facts import program_version, versions
from vtslam.services.recorder.files import check_way, make_way, maybe_recording
from vtslam.services.recording_run import run_recording
from vtslam.services.resume import ResumePoint, prepare_to_resume
from vtslam.services.run_record import RunRecord, RunSummary
from vtslam.services.sensor.sources.base import Source, SourceError, SourceUri, live_camera
from vtslam.services.sensor.sources.pose_priors import OPTIONS as POSE_OPTIONS
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.processes import LIVE_SOURCE
from vtslam.storage.errors import RunFolderError
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.run_info import RunFacts, RunInfo

if TYPE_CHECKING:
    from vtslam.services.supervisor.fleet_run import FleetHooks

DEFAULT_PRESET = "fast"
_FRAMES_LOOKED_AT = 500  # for the first one with a pose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunPlan:
    """Everything a run needs but its folder.

    Attributes:
        source: The open recording, at the size and over the frames that the settings ask for.
        settings: The effective settings.
        engine: The rasteriser.
        preset, family: Names of the settings' layers.
    """

    source: Source
    settings: Settings
    engine: Engine
    preset: str
    family: str

    def execute(
        self,
        folder: Path,
        *,
        overwrite: bool = False,
        created_by: str | None = None,
        known_poses: npt.NDArray[np.float64] | None = None,
        on_frame: Callable[[FrameFacts], None] = lambda facts: None,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> RunSummary:
        """Make the run folder and run; see :func:`vtslam.services.recording_run.run_recording`.

        Args:
            folder: Where the run folder is made.
            overwrite: Give up an earlier run there, and an earlier recording.
            created_by: Program and version for ``run.toml``; this program if None.
            known_poses: ``T_world_camera`` float64 [F,4,4] of all frames, to map at them without tracking.
            on_frame: Called after each frame.
            should_stop: Asked before each frame.

        Raises:
            StorageError: The folder cannot be made or written.
            SourceError: A frame cannot be read; what was done before it is kept.
        """
        with (
            self._made_folder(folder, self.info(created_by), overwrite=overwrite) as run,
            maybe_recording(self.settings.recorder, family=self.family) as recording,
        ):
            return run_recording(
                self.source,
                self.settings,
                self.engine,
                run,
                known_poses=known_poses,
                recording=recording,
                on_frame=on_frame,
                should_stop=should_stop,
            )

    def resume(
        self,
        folder: Path,
        *,
        on_frame: Callable[[FrameFacts], None] = lambda facts: None,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> RunSummary:
        """Go on with a run that was cut off or stopped, in this process; see :func:`plan_resume`.

        Raises:
            StorageError: The folder cannot be read or written, or another process is writing it.
            SourceError: A frame cannot be read; what was done before it is kept.
        """
        with RunFolder.open(folder, writable=True) as run:
            point = self._prepared(run)
            if self._is_complete(point):
                return _closed(run)
            with maybe_recording(self.settings.recorder, family=self.family) as recording:
                return run_recording(
                    self.source,
                    self.settings,
                    self.engine,
                    run,
                    resume=point,
                    recording=recording,
                    on_frame=on_frame,
                    should_stop=should_stop,
                )

    def resume_in_fleet(self, folder: Path, hooks: "FleetHooks") -> RunSummary:
        """As :meth:`resume`, each service a process of its own; raises as `execute_in_fleet`."""
        from vtslam.services.supervisor.fleet_run import run_in_fleet

        with RunFolder.open(folder, writable=True) as run:
            point = self._prepared(run, lead=pace_of(self.settings.fleet, live=False).lead)
            if self._is_complete(point):
                return _closed(run)
            return run_in_fleet(run, self.settings, hooks, resume=point)

    def _is_complete(self, point: ResumePoint | None) -> bool:
        return point is not None and point.facts.num_frames == len(self.source)

    def _prepared(self, run: RunFolder, *, lead: int = 0) -> ResumePoint | None:
        point = prepare_to_resume(run, self.source, end=SectionEnd.of(self.settings, self.source.camera, lead=lead))
        done = 0 if point is None else point.facts.num_frames
        run.catalog.add_event("resumed", f"after {done} frames, by vtslam {program_version()}")
        return point

    def execute_in_fleet(self, folder: Path, hooks: "FleetHooks", *, overwrite: bool = False) -> RunSummary:
        """Make the run folder and run, each service a process of its own.

        See :func:`vtslam.services.supervisor.fleet_run.run_in_fleet` for what may be raised, and StorageError: the
        folder cannot be made.
        """
        from vtslam.services.supervisor.fleet_run import run_in_fleet

        with self._made_folder(folder, self.info(), overwrite=overwrite) as run:
            return run_in_fleet(run, self.settings, hooks)

    @contextmanager
    def _made_folder(self, folder: Path, info: RunInfo, *, overwrite: bool) -> Iterator[RunFolder]:
        """A new run folder; an earlier recording goes only once that is made and so nothing is refused any more."""
        used = SourceUri.parse(self.source.uri).files()
        check_way(self.settings.recorder, overwrite=overwrite, used=used)
        with RunFolder.create(folder, info, overwrite=overwrite, used=used) as run:
            make_way(self.settings.recorder, overwrite=overwrite)
            yield run

    def info(self, created_by: str | None = None) -> RunInfo:
        """What ``run.toml`` says at the start; ``created_by`` is this program and its version if None."""
        facts = RunFacts(
            created_by=created_by or f"vtslam {program_version()}",
            source=self.source.uri,
            family=self.family,
            preset=self.preset,
            width=self.source.camera.width,
            height=self.source.camera.height,
            first_frame=0,
            end_frame=len(self.source),
        )
        found = {**versions(), **engine_versions(self.settings.splat)}
        return RunInfo(facts=facts, settings=to_dict(self.settings), versions=found)


def plan_run(
    uri: str,
    *,
    preset: str = DEFAULT_PRESET,
    family: str | None = None,
    config: Path | None = None,
    assignments: Sequence[str] = (),
) -> RunPlan:
    """Check settings, open the source and make the engine.

    Args:
        uri: The source, as in ``replica:DIR`` or ``sim:room``.
        preset: Schedule (`vtslam.common.preset_loading.SCHEDULES`).
        family: Kind of recording; None takes what the source says of itself.
        config: A user's TOML file, or None.
        assignments: ``key=value`` texts.

    Raises:
        ConfigError: A setting is refused, or poses are given but none for the first frame.
        SourceError: The source cannot be opened, or has no such option, size or range.
    """
    # The source's own family is known once it is open, and how to open it is a setting, which families leave alone.
    settings = load_settings(preset=preset, family=family or "tum", file=config, assignments=assignments)
    source = open_source(uri, overrides=_source_options(settings.source))
    if live_camera(source) is not None:
        raise SourceError(
            f"{source.uri}: expected a recording, found a camera; start a fleet with vtslam up, and send it the "
            f"camera's frames with vtslam publish {source.uri}"
        )
    family = family or source.family
    settings = load_settings(preset=preset, family=family, file=config, assignments=assignments)
    _check_first_pose(source, settings)
    budget_mb, least_mb = settings.fleet.map_budget_mb, least_budget_mb(settings, source.camera)
    if budget_mb < least_mb:
        size = f"{source.camera.width}x{source.camera.height}"
        raise ConfigError(f"fleet.map_budget_mb = {budget_mb}: expected at least {least_mb} for frames of {size}")
    return RunPlan(source=source, settings=settings, engine=make_engine(settings.splat), preset=preset, family=family)


def _check_first_pose(source: Source, settings: Settings) -> None:
    """Refuse a first frame without a pose where poses are given: the world would not be that of the later ones'."""
    options = SourceUri.parse(source.uri).options
    has_poses = not options.keys().isdisjoint(POSE_OPTIONS)
    # Where poses are made from the recording's own truth the first frame is not read: to render one takes the memory
    # of a town, which this process would keep. Should it lack a pose, the tracker says that it ignores the rest.
    if settings.tracker.enabled and "poses" not in options:
        return
    if source.frame(0).pose_prior is not None:
        return
    if not has_poses:
        raise ConfigError(f"--tracking off: {source.uri}: expected a pose for the first frame (--poses), found none")
    looked_at = min(len(source), _FRAMES_LOOKED_AT)
    found = next((index for index in range(1, looked_at) if source.frame(index).pose_prior is not None), None)
    first, _, end = options.get("range", "0:").partition(":")
    told = f"none for the first {looked_at}" if found is None else f"none before --frames {int(first) + found}:{end}"
    raise ConfigError(f"{source.uri}: expected a pose for the first frame, which says where the world is, found {told}")


def plan_resume(folder: Path) -> RunPlan:
    """What a run folder's own settings and source say, to go on with it.

    Raises:
        StorageError: There is no run, or it was fed by publishers, whose frames are gone.
        ConfigError: Its settings are refused.
        SourceError: Its source cannot be opened any more, or is not as long or large as it was.
    """
    info = RunFolder.open(folder).read_info()
    facts = info.facts
    if facts.source == LIVE_SOURCE:
        raise RunFolderError(f"{folder}: publishers fed this run, and their frames are gone; it cannot be resumed")
    settings: Settings = load(Settings, [(f"{folder / 'run.toml'} [settings]", info.settings)])
    if pace_of(settings.fleet, live=False).is_realtime:
        raise RunFolderError(f"{folder}: this run dropped frames to keep up with time; it cannot be resumed")
    source = open_source(facts.source)
    found = (source.camera.width, source.camera.height, len(source))
    if found != (facts.width, facts.height, facts.end_frame):
        raise RunFolderError(
            f"{folder}: {facts.source}: expected the {facts.end_frame} frames of {facts.width}x{facts.height} "
            f"that the run is made from, found {found[2]} of {found[0]}x{found[1]}"
        )
    engine = make_engine(settings.splat)
    return RunPlan(source=source, settings=settings, engine=engine, preset=facts.preset, family=facts.family)


def _closed(run: RunFolder) -> RunSummary:
    """A run of which every frame is durable."""
    return RunRecord(run).finish(finished=True, interrupted=False, seconds=0.0, peak_rss_mb=0.0)


def _source_options(settings: SourceSettings) -> dict[str, str]:
    """The options of a source's URI that the settings ask for."""
    options = {
        "size": settings.size,
        "range": settings.frames,
        "noise": settings.noise,
        "poses": settings.poses,
        "poses_sigma": settings.poses_sigma,
    }
    if settings.seed >= 0:
        options["seed"] = str(settings.seed)
    return {key: value for key, value in options.items() if value}

"""What Python programs call to run and judge a recording; ``import vtslam`` offers it by name."""

from collections.abc import Callable, Sequence
from pathlib import Path

from vtslam.services.evaluation import METRICS_NAME, evaluate_run, write_metrics
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.run_plan import DEFAULT_PRESET, plan_run
from vtslam.services.run_record import RunSummary


def run(
    source: str,
    out: str | Path,
    *,
    preset: str = DEFAULT_PRESET,
    family: str | None = None,
    config: str | Path | None = None,
    assignments: Sequence[str] = (),
    overwrite: bool = False,
    on_frame: Callable[[FrameFacts], None] = lambda facts: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """Track and map a recording, as ``vtslam run --in-process`` does.

    Args:
        source: Where frames come from, as in ``replica:DIR`` or ``sim:room``.
        out: The run folder to make.
        preset: Schedule: fast, paper, released, realtime.
        family: Kind of recording; None takes what the source says of itself.
        config: A TOML file of settings, or None.
        assignments: Single settings, as in ``section.length=20``.
        overwrite: Give up an earlier run in ``out``.
        on_frame: Called after each frame.
        should_stop: Asked before each frame; True ends the run, and what was done is kept.

    Raises:
        ConfigError: A setting is refused; nothing was started.
        SourceError: The source cannot be opened, or a frame cannot be read; what was done before it is kept.
        StorageError: The run folder cannot be made or written.
    """
    plan = plan_run(
        source, preset=preset, family=family, config=None if config is None else Path(config), assignments=assignments
    )
    return plan.execute(Path(out), overwrite=overwrite, on_frame=on_frame, should_stop=should_stop)


def open_run(path: str | Path) -> RecordedRun:
    """A run folder with its recording: poses, sections, renderings; see :class:`RecordedRun`."""
    return RecordedRun(Path(path))


def evaluate(path: str | Path) -> dict[str, object]:
    """Judge a run against its recording, as ``vtslam eval`` does.

    Returns:
        The content of ``metrics.json``, which is written into the run folder.

    Raises:
        StorageError, TrajectoryError, ConfigError, SourceError: The run or its recording cannot be read.
    """
    values = evaluate_run(open_run(path))
    write_metrics(Path(path) / METRICS_NAME, values)
    return values

"""The report of a run: ``report.json`` and pictures, in the run folder."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vtslam.common.metrics_trajectory import aligning_motion, trajectory_errors
from vtslam.services.evaluation import write_metrics
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.report_pictures import Picture, frame_picture, in_columns, stacked, write_picture
from vtslam.services.report_plot import trajectory_plot

REPORT_NAME = "report.json"
_PICTURES = "pictures"
OVERVIEW_NAME = f"{_PICTURES}/overview.png"
_NUM_FRAMES_SHOWN = 4


def write_report(run: RecordedRun, values: Mapping[str, Any]) -> dict[str, object]:
    """Draw a run and write its ``report.json``: the metrics, what was run, and the pictures' names.

    Args:
        run: The run.
        values: Its metrics (:func:`vtslam.services.evaluation.evaluate_run`).

    Returns:
        The content of ``report.json``.

    Raises:
        SourceError, StorageError: A frame or section cannot be read, or a file cannot be written.
    """
    folder = run.folder.path / _PICTURES
    folder.mkdir(exist_ok=True)
    for earlier in folder.glob("frame-*.png"):  # another run's, which may have shown other frames
        earlier.unlink()
    strips = {f"frame-{frame_id:06d}.png": _strip(run, frame_id) for frame_id in _shown_frames(run)}
    plot, sheet = _trajectory(run), in_columns(list(strips.values()), 2)
    pictures = {"overview.png": stacked([plot, sheet]), "trajectory.png": plot, **strips}
    for name, picture in pictures.items():
        write_picture(folder / name, picture)
    facts = run.info.facts
    about = {"source": facts.source, "preset": facts.preset, "family": facts.family, "created_by": facts.created_by}
    names = [f"{_PICTURES}/{name}" for name in pictures]
    report = {**values, "run": about, "pictures": names}
    write_metrics(run.folder.path / REPORT_NAME, report)
    return report


def _shown_frames(run: RecordedRun) -> Sequence[int]:
    """A few frames, evenly over the run."""
    count = min(_NUM_FRAMES_SHOWN, run.num_frames)
    return sorted({int(frame_id) for frame_id in np.linspace(0, run.num_frames - 1, count + 2)[1:-1]})


def _strip(run: RecordedRun, frame_id: int) -> Picture:
    section = run.section(run.rows[frame_id]["section_id"])
    return frame_picture(run.frame(frame_id), run.render(section, frame_id))


def _trajectory(run: RecordedRun) -> Picture:
    estimated_m, truth = run.poses[:, :3, 3], run.true_poses()
    heads = [run.frames_of(section_id).start for section_id in run.section_ids()]
    if truth is None:
        return trajectory_plot(estimated_m, None, None, heads)
    T_estimate_truth = aligning_motion(truth[:, :3, 3], estimated_m)
    true_m = truth[:, :3, 3] @ T_estimate_truth[:3, :3].T + T_estimate_truth[:3, 3]
    return trajectory_plot(estimated_m, true_m, trajectory_errors(run.poses, truth).position_error_m, heads)

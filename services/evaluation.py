"""What a run is worth: every figure of ``metrics.json``, from its folder and its recording."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from vtslam.common import metrics
from vtslam.common.metrics_trajectory import TrajectoryErrors, trajectory_errors
from vtslam.common.section import Section
from vtslam.services.recorded_run import RecordedRun
from vtslam.storage.atomic import replace_file

METRICS_NAME = "metrics.json"


def evaluate_run(run: RecordedRun, *, on_section: Callable[[], None] = lambda: None) -> dict[str, object]:
    """The content of ``metrics.json``: exactly the keys of :func:`vtslam.common.metrics.summarise`.

    Args:
        run: The run.
        on_section: Called after each section.

    Raises:
        SourceError: A frame cannot be read.
        StorageError: A section cannot be read.
    """
    gathered = _Gathered()
    ids = run.section_ids()
    for section_id in ids:
        _look_at(run, run.section(section_id), gathered)
        on_section()
    return metrics.summarise(
        evaluated=gathered.evaluated,
        heldout=gathered.heldout,
        seams=gathered.seams,
        trajectory=_trajectory(run),
        costs=_costs(run, sections=len(ids), gaussians=gathered.gaussians),
    )


def write_metrics(path: Path, values: dict[str, object]) -> None:
    """Replace ``path`` by ``values`` as JSON; raises WriteFailed."""
    replace_file(path, [(json.dumps(values, indent=1, allow_nan=False) + "\n").encode()])


@dataclass(slots=True)
class _Gathered:
    """Figures of the sections looked at so far."""

    evaluated: list[metrics.FrameQuality] = field(default_factory=list)
    heldout: list[metrics.FrameQuality] = field(default_factory=list)
    seams: list[metrics.Seam] = field(default_factory=list)
    gaussians: int = 0


def _look_at(run: RecordedRun, section: Section, gathered: _Gathered) -> None:
    """Add what one section shows: its own frames, and both sides of the seam at its end."""
    gathered.gaussians += section.gaussians.count
    own = run.frames_of(section.section_id)
    last, following = metrics.seam_frames(own, run.frames_of(section.section_id + 1))
    evaluated = set(metrics.evaluated_frames(run.num_frames)) & set(own)
    heldout = {frame_id for frame_id in own if run.rows[frame_id]["held_out"]}
    in_seam = {*last, *following} if following else set()
    seam_db: dict[int, float | None] = {}
    for frame_id in sorted(evaluated | heldout | in_seam):
        frame = run.frame(frame_id)
        rendering = run.render(section, frame_id)
        if frame_id in evaluated or frame_id in heldout:
            quality = metrics.frame_quality(rendering, frame, section=section.section_id)
            gathered.evaluated += [quality] if frame_id in evaluated else []
            gathered.heldout += [quality] if frame_id in heldout else []
        if frame_id in in_seam:
            seam_db[frame_id] = metrics.seam_psnr_db(rendering, frame)
    if following:
        seam = metrics.seam_of(
            section.section_id, next_db=[seam_db[i] for i in following], last_db=[seam_db[i] for i in last]
        )
        gathered.seams += [] if seam is None else [seam]


def _trajectory(run: RecordedRun) -> TrajectoryErrors | None:
    truth = run.true_poses()
    return None if truth is None else trajectory_errors(run.poses, truth)


def _costs(run: RecordedRun, *, sections: int, gaussians: int) -> metrics.RunCosts:
    facts = run.info.facts
    return metrics.RunCosts(
        frames=run.num_frames,
        gaussians=gaussians,
        sections=sections,
        track_s=sum(row["track_s"] for row in run.rows),
        map_s=sum(row["map_s"] for row in run.rows),
        total_s=facts.seconds or sum(row["total_s"] for row in run.rows),
        track_renders=sum(row["track_renders"] for row in run.rows),
        map_renders=sum(row["map_renders"] for row in run.rows),
        peak_rss_mb=facts.peak_rss_mb or None,
    )

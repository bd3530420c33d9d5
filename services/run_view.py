"""A finished run as parts to show, frame by frame along its time line."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from vtslam.common.section import Section
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.viewer.core import Limits, Scene, SeenFrame
from vtslam.services.viewer.parts import Part

MOST_FRAMES = 300  # whose images are sent
_MOST_GROWTHS = 60  # times that a growing section is sent


class _Sink(Protocol):
    def send(self, frame_id: int, update: Iterable[Part]) -> bool: ...


def show_run(
    run: RecordedRun,
    sink: _Sink,
    *,
    section_gaussians: int,
    gaussians: int,
    on_section: Callable[[], None] = lambda: None,
) -> None:
    """Send a run: figures of all frames, images of at most `MOST_FRAMES`, sections as they grew.

    Args:
        run: The run.
        sink: Who takes it.
        section_gaussians: Gaussians of a section that are sent at most ...
        gaussians: ... and of all sections.
        on_section: Called after each section.

    Raises:
        SourceError, StorageError: A frame or section cannot be read.
    """
    ids = run.section_ids()
    limit = min(section_gaussians, gaussians // max(len(ids), 1))
    scene = Scene(Limits(section_gaussians=limit, gaussians=gaussians), truth=run.true_poses())
    every = -(-run.num_frames // MOST_FRAMES)
    growths = max(_MOST_GROWTHS // max(len(ids), 1), 1)
    for section_id in ids:
        section, frames = run.section(section_id), run.frames_of(section_id)
        grown = set(np.linspace(0, len(frames), growths + 2, dtype=int)[1:-1].tolist())
        for row, frame_id in enumerate(frames):
            parts = scene.figures(_facts(run.rows[frame_id]))
            if frame_id % every == 0:
                parts = scene.frame(_seen(run, section, frame_id))
            if row in grown:
                parts += scene.growing(section_up_to(section, row))
                parts += scene.states(active=section_id, resident=set(), known=range(section_id))
            sink.send(frame_id, parts)
        parts = scene.nothing_grows() + scene.finished(section)
        sink.send(frames[-1], parts + scene.states(active=None, resident=set(), known=range(section_id + 1)))
        on_section()


def section_up_to(section: Section, row: int) -> Section:
    """The part of a finished section that is tied to its frames up to ``row``."""
    kept = section.gaussians.frame_index <= row
    return replace(
        section,
        frames=section.frames[: row + 1],
        gaussians=section.gaussians.thinned(kept),
        means_m=section.means_m[kept],
    )


def _seen(run: RecordedRun, section: Section, frame_id: int) -> SeenFrame:
    return SeenFrame(
        frame=run.frame(frame_id),
        T_world_camera=run.poses[frame_id],
        rendering=run.render(section, frame_id),
        facts=_facts(run.rows[frame_id]),
    )


def _facts(row: dict[str, Any]) -> FrameFacts:
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in row.items()}
    return FrameFacts(**values)

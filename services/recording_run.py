"""Runs a recording through the system in this process, and leaves a run folder."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np
import numpy.typing as npt

from vtslam.common.settings import Settings
from vtslam.common.splat.engine import Engine
from vtslam.common.trajectory_io import write_trajectory
from vtslam.services.engines import thread_count
from vtslam.services.process_facts import peak_rss_mb
from vtslam.services.sensor.sources.base import Source, SourceError
from vtslam.services.system import FrameReport, System
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import SectionArchive

FIRST_FRAME_STATE, KNOWN_STATE = "first", "known"  # not tracked: defines the world; came with its pose


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFacts:
    """One line of ``frames.jsonl``.

    Attributes:
        frame_id: Place in the stream, from 0.
        section_id: Section of the frame.
        is_head: Whether it opens its section.
        held_out: Whether it was kept out of mapping.
        state: "first", "known", "ok", "weak" or "lost".
        tracked_section_id: The section it was tracked against; -1 if none.
        rescued: Whether odometry replaced the guess.
        covered_share: Share of the pixels that tracking used.
        color_loss, depth_loss_m: Loss per pixel at the end of tracking.
        position_sigma_m, rotation_sigma_rad: Standard deviations (all axes together) by the tracker's covariance.
        exposure_gain, exposure_offset: How the frame shows the map's colours, per channel.
        map_loss: Loss at the last step of mapping.
        gaussians_added: New Gaussians.
        gaussians: Gaussians of the section afterwards.
        track_renders, map_renders: Renders spent; ending a section counts for its last frame.
        read_s, track_s, map_s, total_s: Wall-clock seconds: reading, tracking, mapping, all of it.
    """

    frame_id: int
    section_id: int
    is_head: bool
    held_out: bool
    state: str
    tracked_section_id: int
    rescued: bool
    covered_share: float
    color_loss: float
    depth_loss_m: float
    position_sigma_m: float
    rotation_sigma_rad: float
    exposure_gain: tuple[float, ...]
    exposure_offset: tuple[float, ...]
    map_loss: float
    gaussians_added: int
    gaussians: int
    track_renders: int
    map_renders: int
    read_s: float
    track_s: float
    map_s: float
    total_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary:
    """What a run came to.

    Attributes:
        frames: Frames committed.
        sections: Sections written.
        gaussians: Gaussians in them.
        weak, lost: Frames in these states of tracking.
        interrupted: Whether it was asked to stop early.
        seconds: Wall-clock time, reading and writing included.
        peak_rss_mb: Largest resident memory of the process, 10^6 bytes.
    """

    frames: int
    sections: int
    gaussians: int
    weak: int
    lost: int
    interrupted: bool
    seconds: float
    peak_rss_mb: float


def run_recording(
    source: Source,
    settings: Settings,
    engine: Engine,
    run: RunFolder,
    *,
    known_poses: npt.NDArray[np.float64] | None = None,
    on_frame: Callable[[FrameFacts], None] = lambda facts: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """Run all frames of ``source``, writing sections as they are finished and the trajectory with each of them.

    Args:
        source: The recording.
        settings: The effective settings.
        engine: The rasteriser they ask for (`vtslam.services.engines.make_engine`).
        run: An empty run folder, open for writing.
        known_poses: ``T_world_camera`` float64 [F,4,4] of all frames, to map at them without tracking.
        on_frame: Called after each frame.
        should_stop: Asked before each frame; True ends the run, and what was done is kept.

    Raises:
        SourceError: A frame cannot be read; what was done before it is kept.
        StorageError: Something cannot be written.
    """
    recorder = _Recorder(settings, engine, run)
    interrupted = False
    try:
        for index in range(len(source)):
            interrupted = should_stop()
            if interrupted:
                break
            known = None if known_poses is None else known_poses[index]
            on_frame(recorder.frame(source, index, known))
    except SourceError:
        recorder.close(finished=False, interrupted=False)
        raise
    return recorder.close(finished=not interrupted, interrupted=interrupted)


class _Recorder:
    """The system, its run folder and the facts gathered so far."""

    def __init__(self, settings: Settings, engine: Engine, run: RunFolder) -> None:
        self._start_s = time.perf_counter()
        self._run = run
        self._system = System(
            settings, engine, SectionArchive(run), threads=thread_count(settings.splat), clock=time.perf_counter
        )
        self._facts: list[FrameFacts] = []
        self._times_ns: list[int] = []
        self._poses: list[npt.NDArray[np.float64]] = []

    def frame(self, source: Source, index: int, known_T_world_camera: npt.NDArray[np.float64] | None) -> FrameFacts:
        """Read and process one frame."""
        start_s = time.perf_counter()
        frame = source.frame(index)
        read_s = time.perf_counter() - start_s
        report = self._system.process(frame, known_T_world_camera=known_T_world_camera)
        self._times_ns.append(frame.capture_time_ns)
        self._poses.append(report.commit.T_world_camera)
        facts = _facts_of(report, read_s=read_s, total_s=time.perf_counter() - start_s)
        self._facts.append(facts)
        if report.sealed_section_id is not None:
            self._write_progress()
        return facts

    def close(self, *, finished: bool, interrupted: bool) -> RunSummary:
        """Write the open section and everything else that is not written yet."""
        start_s = time.perf_counter()
        renders = self._system.finish()
        if self._facts:
            last = self._facts[-1]
            seconds = time.perf_counter() - start_s
            self._facts[-1] = replace(
                last,
                map_renders=last.map_renders + renders,
                map_s=last.map_s + seconds,
                total_s=last.total_s + seconds,
            )
        self._write_progress()
        summary = self._summary(interrupted)
        info = self._run.read_info()
        facts = replace(
            info.facts,
            finished=finished,
            interrupted=interrupted,
            frames=summary.frames,
            seconds=summary.seconds,
            peak_rss_mb=summary.peak_rss_mb,
        )
        self._run.write_info(replace(info, facts=facts))
        return summary

    def _write_progress(self) -> None:
        poses = np.stack(self._poses) if self._poses else np.zeros((0, 4, 4))
        write_trajectory(self._run.trajectory_path, self._times_ns, poses)
        self._run.write_frames(asdict(facts) for facts in self._facts)

    def _summary(self, interrupted: bool) -> RunSummary:
        of_section = {facts.section_id: facts.gaussians for facts in self._facts}
        return RunSummary(
            frames=len(self._facts),
            sections=len(of_section),
            gaussians=sum(of_section.values()),
            weak=sum(facts.state == "weak" for facts in self._facts),
            lost=sum(facts.state == "lost" for facts in self._facts),
            interrupted=interrupted,
            seconds=time.perf_counter() - self._start_s,
            peak_rss_mb=peak_rss_mb(),
        )


def _state(report: FrameReport) -> str:
    if report.tracking is not None:
        return report.tracking.state.value
    return FIRST_FRAME_STATE if report.commit.frame_id == 0 else KNOWN_STATE


def _facts_of(report: FrameReport, *, read_s: float, total_s: float) -> FrameFacts:
    tracking, commit = report.tracking, report.commit
    quality = None if tracking is None else tracking.quality
    variances = np.zeros(6) if tracking is None else np.maximum(np.diag(tracking.covariance), 0.0)
    return FrameFacts(
        frame_id=commit.frame_id,
        section_id=commit.section_id,
        is_head=commit.frame_index == 0,
        held_out=commit.held_out,
        state=_state(report),
        tracked_section_id=-1 if quality is None else quality.section_id,
        rescued=quality is not None and quality.rescued,
        covered_share=0.0 if quality is None else quality.covered_share,
        color_loss=0.0 if quality is None else quality.color_loss,
        depth_loss_m=0.0 if quality is None else quality.depth_loss_m,
        position_sigma_m=float(np.sqrt(variances[:3].sum())),
        rotation_sigma_rad=float(np.sqrt(variances[3:].sum())),
        exposure_gain=tuple(commit.exposure.gain.tolist()),
        exposure_offset=tuple(commit.exposure.offset.tolist()),
        map_loss=commit.loss,
        gaussians_added=commit.gaussians_added,
        gaussians=commit.gaussians,
        track_renders=0 if quality is None else quality.renders,
        map_renders=commit.renders + report.seal_renders,
        read_s=read_s,
        track_s=report.track_s,
        map_s=report.map_s,
        total_s=total_s,
    )

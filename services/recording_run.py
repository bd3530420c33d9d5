"""Runs a recording through the system in this process, and leaves a run folder."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vtslam.common.settings import Settings
from vtslam.common.splat.engine import Engine
from vtslam.services.engines import thread_count
from vtslam.services.frame_facts import (
    FIRST_FRAME_STATE,
    KNOWN_STATE,
    CommittedFrame,
    FrameFacts,
    Seconds,
    frame_facts,
)
from vtslam.services.process_facts import peak_rss_mb
from vtslam.services.run_record import RunRecord, RunSummary
from vtslam.services.sensor.sources.base import Source, SourceError
from vtslam.services.system import FrameReport, Seal, System
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import SectionArchive


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
    """The system, its run folder and the frames so far."""

    def __init__(self, settings: Settings, engine: Engine, run: RunFolder) -> None:
        self._start_s = time.perf_counter()
        self._system = System(
            settings, engine, SectionArchive(run), threads=thread_count(settings.splat), clock=time.perf_counter
        )
        self._record = RunRecord(run)

    def frame(self, source: Source, index: int, known_T_world_camera: npt.NDArray[np.float64] | None) -> FrameFacts:
        """Read and process one frame."""
        start_s = time.perf_counter()
        frame = source.frame(index)
        read_s = time.perf_counter() - start_s
        report = self._system.process(frame, known_T_world_camera=known_T_world_camera)
        facts = _facts_of(report, read_s=read_s, total_s=time.perf_counter() - start_s)
        T_world_camera = report.commit.T_world_camera
        self._record.add(
            CommittedFrame(facts=facts, capture_time_ns=frame.capture_time_ns, T_world_camera=T_world_camera)
        )
        if report.sealed is not None:
            self._record.write()
        return facts

    def close(self, *, finished: bool, interrupted: bool) -> RunSummary:
        """Write the open section and everything else that is not written yet."""
        start_s = time.perf_counter()
        sealed, last = self._system.finish(), self._record.last()
        if sealed is not None and last is not None:
            self._record.add(replace(last, facts=_with_seal(last.facts, sealed, time.perf_counter() - start_s)))
        return self._record.finish(
            finished=finished,
            interrupted=interrupted,
            seconds=time.perf_counter() - self._start_s,
            peak_rss_mb=peak_rss_mb(),
        )


def _state(report: FrameReport) -> str:
    if report.tracking is not None:
        return report.tracking.state.value
    return FIRST_FRAME_STATE if report.commit.frame_id == 0 else KNOWN_STATE


def _facts_of(report: FrameReport, *, read_s: float, total_s: float) -> FrameFacts:
    tracking = report.tracking
    facts = frame_facts(
        report.commit,
        None if tracking is None else tracking.quality,
        np.zeros((6, 6)) if tracking is None else tracking.covariance,
        state=_state(report),
        seconds=Seconds(read_s=read_s, track_s=report.track_s, map_s=report.map_s, total_s=total_s),
    )
    return facts if report.sealed is None else _with_seal(facts, report.sealed, 0.0)


def _with_seal(facts: FrameFacts, sealed: Seal, seconds: float) -> FrameFacts:
    return facts.with_seal(gaussians=sealed.gaussians, renders=sealed.renders, seconds=seconds)

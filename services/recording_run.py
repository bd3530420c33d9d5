"""Runs a recording through the system in this process, and leaves a run folder."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from vtslam.common.frame import Frame
from vtslam.common.section import Section
from vtslam.common.settings import Settings
from vtslam.common.splat.engine import Engine
from vtslam.services.commit_facts import CommitFacts, pixels_crc32
from vtslam.services.engines import thread_count
from vtslam.services.frame_facts import (
    CommittedFrame,
    FrameFacts,
    Seconds,
    frame_facts,
    untracked_state,
)
from vtslam.services.free_memory import give_back_free_memory, keep_large_arrays_apart
from vtslam.services.process_facts import peak_rss_mb
from vtslam.services.resume import ResumePoint
from vtslam.services.run_record import RunRecord, RunSummary
from vtslam.services.sensor.sources.base import Source, SourceError
from vtslam.services.sensor.sources.read_ahead import ReadAhead
from vtslam.services.system import FrameReport, Seal, System
from vtslam.services.tracker.priors import ignored_text
from vtslam.services.tracker.state import TrackerState
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import SectionArchive
from vtslam.storage.section_record import SectionRecord

if TYPE_CHECKING:
    from vtslam.storage.recording.writer import RecordingWriter


def run_recording(
    source: Source,
    settings: Settings,
    engine: Engine,
    run: RunFolder,
    *,
    resume: ResumePoint | None = None,
    known_poses: npt.NDArray[np.float64] | None = None,
    recording: "RecordingWriter | None" = None,
    on_frame: Callable[[FrameFacts], None] = lambda facts: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """Run all frames of ``source``, writing sections as they are finished and the trajectory with each of them.

    Args:
        source: The recording.
        settings: The effective settings.
        engine: The rasteriser they ask for (`vtslam.services.engines.make_engine`).
        run: A run folder, open for writing; empty unless ``resume`` is given.
        resume: Where to go on; from the beginning if None.
        known_poses: ``T_world_camera`` float64 [F,4,4] of all frames, to map at them without tracking.
        recording: Where frames and poses are recorded, or None.
        on_frame: Called after each frame.
        should_stop: Asked before each frame; True ends the run, and what was done is kept.

    Raises:
        SourceError: A frame cannot be read; what was done before it is kept.
        StorageError: Something cannot be written.
    """
    keep_large_arrays_apart()
    recorder = _Recorder(settings, engine, run, resume, recording)
    interrupted = False
    try:
        with ReadAhead(source, first=0 if resume is None else resume.facts.num_frames) as frames:
            while frames.next_index < len(source):
                interrupted = should_stop()
                if interrupted:
                    break
                known = None if known_poses is None else known_poses[frames.next_index]
                on_frame(recorder.frame(frames, known))
    except SourceError:
        recorder.close(finished=False, interrupted=False)
        raise
    return recorder.close(finished=not interrupted, interrupted=interrupted)


class _RecentArchive(SectionArchive):
    """The run folder's sections, with the record of the last one written at hand."""

    last: SectionRecord | None = None

    def write(self, section: Section) -> None:
        """See `SectionArchive.write`."""
        self.last = self.written(section)


class _Recorder:
    """The system, its run folder and the frames of the open section."""

    def __init__(
        self,
        settings: Settings,
        engine: Engine,
        run: RunFolder,
        resume: ResumePoint | None,
        recording: "RecordingWriter | None",
    ) -> None:
        self._start_s = time.perf_counter()
        self._run, self._recording, self._told = run, recording, False
        self._archive = _RecentArchive(run)
        self._system = System(
            settings, engine, self._archive, threads=thread_count(settings.splat), clock=time.perf_counter
        )
        self._record = RunRecord(run)
        self._report: FrameReport | None = None
        if resume is not None:
            facts = resume.facts
            state = TrackerState.resumed(facts.committed_poses, resume.frame, facts.history, facts.exposure)
            self._system.go_on_after(resume.section_id, num_frames=facts.num_frames, state=state)

    def frame(self, frames: ReadAhead, known_T_world_camera: npt.NDArray[np.float64] | None) -> FrameFacts:
        """Read and process one frame."""
        start_s = time.perf_counter()
        frame = frames.next()
        read_s = time.perf_counter() - start_s
        if self._recording is not None:
            self._recording.add_frame(frame)
        self._tell_of_ignored(frame)
        report = self._system.process(frame, known_T_world_camera=known_T_world_camera)
        facts = _facts_of(report, read_s=read_s, total_s=time.perf_counter() - start_s)
        T_world_camera = report.commit.T_world_camera
        self._record.add(
            CommittedFrame(facts=facts, capture_time_ns=frame.capture_time_ns, T_world_camera=T_world_camera)
        )
        if self._recording is not None:
            self._recording.add_pose(frame.frame_id, frame.capture_time_ns, report.commit.T_world_camera)
        self._report = report
        if report.sealed is not None:
            self._commit()
        return facts

    def _tell_of_ignored(self, frame: Frame) -> None:
        """Note once that poses that come with frames do not count."""
        if not self._told and frame.pose_prior is not None and self._system.state.prior_of(frame) is None:
            self._told = True
            self._run.catalog.add_event("priors", ignored_text(frame))

    def close(self, *, finished: bool, interrupted: bool) -> RunSummary:
        """Write the open section and everything else that is not written yet."""
        start_s = time.perf_counter()
        sealed, last = self._system.finish(), self._record.last()
        if sealed is not None and last is not None:
            self._record.add(replace(last, facts=_with_seal(last.facts, sealed, time.perf_counter() - start_s)))
            self._commit()
        return self._record.finish(
            finished=finished,
            interrupted=interrupted,
            seconds=time.perf_counter() - self._start_s,
            peak_rss_mb=peak_rss_mb(),
        )

    def _commit(self) -> None:
        """Make the section that was written last part of the run."""
        assert self._archive.last is not None
        self._record.commit(self._archive.last, self._boundary())
        give_back_free_memory()

    def _boundary(self) -> CommitFacts:
        """What the run goes on from after the last frame."""
        state, last = self._system.state, self._record.last()
        assert last is not None
        assert self._report is not None
        poses, num_frames = state.committed_poses, self._record.num_frames
        return CommitFacts(
            num_frames=num_frames,
            num_tracked=num_frames,
            sequence=num_frames,
            iterations=self._report.commit.iterations,
            frame=last,
            T_world_previous=poses[0] if len(poses) == 2 else None,
            history=state.history(),
            pixels_crc32=pixels_crc32(self._report.frame),
        )


def _state(report: FrameReport) -> str:
    if report.tracking is not None:
        return report.tracking.state.value
    return untracked_state(is_first=report.commit.frame_id == 0)


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

"""What a run leaves in its folder: sections as they become durable with their frames, and the sums at its end."""

from dataclasses import asdict, dataclass, replace
from itertools import groupby

from vtslam.services.commit_facts import CommitFacts
from vtslam.services.frame_facts import CommittedFrame
from vtslam.storage import section_care
from vtslam.storage.catalog_rows import FrameRow
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.run_folder import WRITTEN_CODEC, RunFolder
from vtslam.storage.section_record import SectionRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSummary:
    """What a run came to.

    Attributes:
        frames: Frames committed.
        sections: Sections written.
        gaussians: Gaussians in them.
        weak, lost: Frames in these states of tracking.
        interrupted: Whether it was asked to stop early.
        seconds: Wall-clock time of the run, reading and writing included; of all its parts, if it was resumed.
        peak_rss_mb: Largest resident memory of the process, 10^6 bytes; of a fleet, the sum over its processes, where
            shared memory counts for each.
    """

    frames: int
    sections: int
    gaussians: int
    weak: int
    lost: int
    interrupted: bool
    seconds: float
    peak_rss_mb: float


class RunRecord:
    """The committed frames of a run that are not durable yet, and its folder.

    Args:
        run: The run folder, open for writing; what it holds already counts.
    """

    def __init__(self, run: RunFolder) -> None:
        self._run = run
        self._num_durable = run.catalog.num_frames
        self._last_durable = run.catalog.last_frame_id
        self._frames: list[CommittedFrame] = []

    @property
    def num_frames(self) -> int:
        """Frames committed."""
        return self._num_durable + len(self._frames)

    @property
    def last_frame_id(self) -> int:
        """The frame committed last; -1 if there is none."""
        return self._frames[-1].facts.frame_id if self._frames else self._last_durable

    @property
    def last_durable_frame_id(self) -> int:
        """The last frame of a section on disk; -1 if there is none."""
        return self._last_durable

    def add(self, frame: CommittedFrame) -> None:
        """One more frame, or the last one again with what was learned of it since; durable ones are left alone."""
        if self._frames and self._frames[-1].facts.frame_id == frame.facts.frame_id:
            self._frames.pop()
        if frame.facts.frame_id > self._last_durable:
            self._frames.append(frame)

    def last(self) -> CommittedFrame | None:
        """The last frame, if it is not durable yet."""
        return self._frames[-1] if self._frames else None

    def commit(self, section: SectionRecord, boundary: CommitFacts | None) -> None:
        """Make a written section with its frames, which were added, part of the run.

        Args:
            section: The section.
            boundary: What the run goes on from after it; None if it cannot.

        Raises:
            StorageError: It cannot be written.
        """
        frames = [frame for frame in self._frames if frame.facts.section_id == section.section_id]
        resume = None if boundary is None else boundary.packed()
        self._run.commit_section(section, [_row_of(frame) for frame in frames], resume=resume)
        self._num_durable += len(frames)
        self._last_durable = frames[-1].facts.frame_id
        self._frames = self._frames[len(frames) :]

    def finish_broken(self, *, seconds: float, peak_rss_mb: float) -> None:
        """Write what a run came to that cannot go on, with the frames whose section is on no disk.

        Raises:
            StorageError: It cannot be written.
        """
        for section_id, frames in groupby(self._frames, key=lambda frame: frame.facts.section_id):
            self._run.add_loose_frames(section_id, [_row_of(frame) for frame in frames])
        self.finish(finished=False, interrupted=False, seconds=seconds, peak_rss_mb=peak_rss_mb)

    def finish(self, *, finished: bool, interrupted: bool, seconds: float, peak_rss_mb: float) -> RunSummary:
        """Write what the run came to, sections in the codec that the settings ask for if it is finished.

        Frames that are not durable do not count.

        Args:
            finished: The run came to its end.
            interrupted: It was asked to stop early.
            seconds: Since it was started or resumed.
            peak_rss_mb: See `RunSummary`.

        Raises:
            StorageError: It cannot be written.
        """
        info = self._run.read_info()
        summary = self.summary(
            interrupted=interrupted,
            seconds=info.facts.seconds + seconds,
            peak_rss_mb=max(info.facts.peak_rss_mb, peak_rss_mb),
        )
        facts = replace(
            info.facts,
            finished=finished,
            interrupted=interrupted,
            frames=summary.frames,
            seconds=summary.seconds,
            peak_rss_mb=summary.peak_rss_mb,
        )
        self._run.catalog.add_event("finished" if finished else "stopped", f"{summary.frames} frames")
        self._run.write_info(replace(info, facts=facts))
        if finished:  # a run that goes on later needs its sections as they were
            storage = info.settings.get("storage", {})
            grid = DenseGrid().coarser(storage.get("coarseness", 1.0))
            section_care.repack_all(self._run, storage.get("codec", WRITTEN_CODEC), grid)
        return summary

    def summary(self, *, interrupted: bool, seconds: float, peak_rss_mb: float) -> RunSummary:
        """What is durable, in sums; the arguments as in `RunSummary`."""
        totals = self._run.catalog.totals()
        return RunSummary(
            frames=totals.frames,
            sections=totals.sections,
            gaussians=totals.gaussians,
            weak=totals.states.get("weak", 0),
            lost=totals.states.get("lost", 0),
            interrupted=interrupted,
            seconds=seconds,
            peak_rss_mb=peak_rss_mb,
        )


def _row_of(frame: CommittedFrame) -> FrameRow:
    return FrameRow(
        frame_id=frame.facts.frame_id,
        capture_time_ns=frame.capture_time_ns,
        T_world_camera=frame.T_world_camera,
        facts=asdict(frame.facts),
    )

"""What a run leaves in its folder beside the sections: trajectory, facts per frame, and the sums at its end."""

from dataclasses import asdict, dataclass, replace

import numpy as np

from vtslam.common.trajectory_io import write_trajectory
from vtslam.services.frame_facts import CommittedFrame
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.run_folder import RunFolder

_WRITTEN_CODEC = "lossless"  # of sections as they are written; with it there is nothing to repack


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
    """The committed frames of a run, and its folder.

    Args:
        run: The run folder, open for writing.
    """

    def __init__(self, run: RunFolder) -> None:
        self._run = run
        self._frames: list[CommittedFrame] = []

    @property
    def num_frames(self) -> int:
        """Frames committed."""
        return len(self._frames)

    def add(self, frame: CommittedFrame) -> None:
        """One more frame, or the last one again with what was learned of it since."""
        if self._frames and self._frames[-1].facts.frame_id == frame.facts.frame_id:
            self._frames.pop()
        self._frames.append(frame)

    def last(self) -> CommittedFrame | None:
        """The last frame."""
        return self._frames[-1] if self._frames else None

    def write(self) -> None:
        """Replace trajectory and facts on disk; raises StorageError."""
        poses = [frame.T_world_camera for frame in self._frames]
        times_ns = [frame.capture_time_ns for frame in self._frames]
        write_trajectory(self._run.trajectory_path, times_ns, np.stack(poses) if poses else np.zeros((0, 4, 4)))
        self._run.write_frames(asdict(frame.facts) for frame in self._frames)

    def finish(self, *, finished: bool, interrupted: bool, seconds: float, peak_rss_mb: float) -> RunSummary:
        """Write everything that is not written yet, sections in the codec that the settings ask for; what it came to.

        Args:
            finished: The run came to its end.
            interrupted: It was asked to stop early.
            seconds: See `RunSummary`.
            peak_rss_mb: See `RunSummary`.
        """
        self.write()
        summary = self._summary(interrupted=interrupted, seconds=seconds, peak_rss_mb=peak_rss_mb)
        info = self._run.read_info()
        facts = replace(
            info.facts,
            finished=finished,
            interrupted=interrupted,
            frames=summary.frames,
            seconds=seconds,
            peak_rss_mb=peak_rss_mb,
        )
        self._run.write_info(replace(info, facts=facts))
        storage = info.settings.get("storage", {})
        self._run.repack_sections(
            storage.get("codec", _WRITTEN_CODEC), DenseGrid().coarser(storage.get("coarseness", 1.0))
        )
        return summary

    def _summary(self, *, interrupted: bool, seconds: float, peak_rss_mb: float) -> RunSummary:
        states = [frame.facts.state for frame in self._frames]
        of_section = {frame.facts.section_id: frame.facts.gaussians for frame in self._frames}
        return RunSummary(
            frames=len(states),
            sections=len(of_section),
            gaussians=sum(of_section.values()),
            weak=states.count("weak"),
            lost=states.count("lost"),
            interrupted=interrupted,
            seconds=seconds,
            peak_rss_mb=peak_rss_mb,
        )

"""A fleet's processor time and private memory while it runs, as its supervisor sees them frame by frame."""

import os
import time
from array import array
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np

from vtslam.services.frame_facts import FrameFacts
from vtslam.services.process_facts import cpu_seconds, private_rss_mb
from vtslam.services.supervisor.supervisor import Supervisor

SUPERVISOR = "supervisor"  # this process
Window = tuple[int, int]  # frames


@dataclass(slots=True)
class FleetWatch:
    """Looks at a fleet whenever frames were committed.

    What it keeps is part of the supervisor's memory that it looks at, so that is eight bytes a number.

    Attributes:
        frames: Committed up to now.
        at_frames: Frames at each look.
        cpu_s, rss_mb: At each look, by process: processor time in all, and private memory (RssAnon).
        counters: Of each process, by name.
        map_peak_mb, map_mb: The most that the map store took, and what all sections would, 10^6 bytes.
    """

    frames: int = 0
    at_frames: "array[int]" = field(default_factory=lambda: array("q"))
    cpu_s: dict[str, "array[float]"] = field(default_factory=lambda: defaultdict(lambda: array("d")))
    rss_mb: dict[str, "array[float]"] = field(default_factory=lambda: defaultdict(lambda: array("d")))
    counters: dict[str, dict[str, int]] = field(default_factory=dict)
    map_peak_mb: float = 0.0
    map_mb: float = 0.0
    _cpu_of_pid: dict[tuple[str, int], float] = field(default_factory=dict)

    def on_frame(self, facts: FrameFacts) -> None:
        """To be called after each committed frame."""
        self.frames += 1

    def on_step(self, supervisor: Supervisor) -> None:
        """To be called at each step of the supervisor."""
        self.map_peak_mb = 1e-6 * supervisor.progress.map_peak_bytes
        self.map_mb = 1e-6 * supervisor.progress.map_bytes
        self.counters = {name: dict(child.counters) for name, child in supervisor.children.items()}
        pids = {name: child.pid for name, child in supervisor.children.items()}
        if any(pid is None for pid in pids.values()) or (self.at_frames and self.at_frames[-1] == self.frames):
            return
        self.at_frames.append(self.frames)
        for name, pid in pids.items():
            assert pid is not None
            self._cpu_of_pid[name, pid] = max(cpu_seconds(pid), self._cpu_of_pid.get((name, pid), 0.0))
            self.cpu_s[name].append(sum(each for (owner, _), each in self._cpu_of_pid.items() if owner == name))
            self.rss_mb[name].append(private_rss_mb(pid))
        self.cpu_s[SUPERVISOR].append(time.process_time())
        self.rss_mb[SUPERVISOR].append(private_rss_mb(os.getpid()))

    def cpu_s_per_frame(self, window: Window) -> dict[str, float]:
        """Processor seconds per frame within a window of frames, by process."""
        begin, end = window
        return {
            name: float(np.diff(np.interp([begin, end], self.at_frames, values))[0]) / max(end - begin, 1)
            for name, values in self.cpu_s.items()
        }

    def rss_growth(self) -> dict[str, float | None]:
        """The most private memory in the last quarter of the frames over that in the second one, by process."""
        frames = np.array(self.at_frames)
        second = (frames >= self.frames / 4) & (frames < self.frames / 2)
        last = frames >= 3 * self.frames / 4
        if not second.any() or not last.any():
            return dict.fromkeys(self.rss_mb)
        sizes = {name: np.array(values) for name, values in self.rss_mb.items()}
        return {name: float(size[last].max() / size[second].max()) for name, size in sizes.items()}

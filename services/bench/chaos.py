"""A run whose processes are killed and stopped all the time, held against the same run undisturbed."""

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vtslam.common import failpoints
from vtslam.common.fleet_folder import shared_memory_folder
from vtslam.services.bench.supervisor_kill import seconds_after_supervisor_kill
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.run_plan import RunPlan
from vtslam.services.supervisor.child_process import ChildProcess
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.supervisor import Supervisor
from vtslam.storage.run_folder import RunFolder

_SERVICES = ("sensor", "tracker", "mapper", "archiver")
_POINT_STARTS = (2, 4, 6)  # starts that die within a write to shared memory, or to the run folder
_STOP_S = 15.0
_LATEST_S = 0.5  # after its frame
_WITHIN_WRITES = {
    "sensor": ("after_claim", "after_color", "after_pixels", "after_words", "before_publish"),
    "mapper": ("after_reserve", "after_frames", "after_images", "after_ties", "after_colors", "before_flip"),
    "archiver": ("before_write", "after_write", "after_catalog", "after_trajectory"),
}
_PREFIXES = {"sensor": "shm.ring.", "mapper": "shm.commit.", "archiver": "run.section."}


@dataclass(slots=True)
class _Stopped:
    """A process that was sent SIGSTOP, and when it is sent SIGCONT if it is still there."""

    pid: int
    until_s: float


@dataclass(slots=True)
class _Disturber:
    """Kills and stops by a plan drawn from a seed: each waits for its frame, and for its process to be at work.

    Attributes:
        events: (frames committed, service, signal), in order.
        points: Fail point by (service, start).
        on_frame: Called after each frame.
        rng: Draws how long after its frame a signal is sent, so that it meets any part of the work.
        sent: Signals sent, by (service, signal).
        pids: All processes seen.
        children: The processes as their supervisor sees them.
        frames: Frames committed.
    """

    events: list[tuple[int, str, signal.Signals]]
    points: dict[tuple[str, int], str]
    on_frame: Callable[[FrameFacts], None]
    rng: random.Random
    sent: Counter[tuple[str, signal.Signals]] = field(default_factory=Counter)
    pids: set[int] = field(default_factory=set)
    children: Mapping[str, ChildProcess] = field(default_factory=dict)
    frames: int = 0
    _stopped: list[_Stopped] = field(default_factory=list)
    _due_s: float | None = None

    def hooks(self) -> FleetHooks:
        return FleetHooks(
            on_frame=self._count,
            on_step=self._step,
            environment=lambda name, start: {failpoints.VARIABLE: self.points.get((name, start), "")},
        )

    def _count(self, facts: FrameFacts) -> None:
        self.frames += 1
        self.on_frame(facts)

    def _step(self, supervisor: Supervisor) -> None:
        self.children = supervisor.children
        for child in supervisor.children.values():
            if child.pid is not None:
                self.pids.add(child.pid)
        self._wake_stopped(supervisor)
        if self.events and self.events[0][0] <= self.frames:
            self._due_s = self._due_s or time.monotonic() + self.rng.uniform(0.0, _LATEST_S)
            if time.monotonic() >= self._due_s:
                self._send_next(supervisor)

    def _send_next(self, supervisor: Supervisor) -> None:
        _, name, number = self.events[0]
        child = supervisor.children[name]
        if child.pid is not None and child.is_ready:
            self._send(child.pid, name, number)
        elif not child.finished:
            return
        self.events.pop(0)
        self._due_s = None

    def _send(self, pid: int, name: str, number: signal.Signals) -> None:
        os.kill(pid, number)
        self.sent[name, number] += 1
        if number is signal.SIGSTOP:
            self._stopped.append(_Stopped(pid, time.monotonic() + _STOP_S))

    def _wake_stopped(self, supervisor: Supervisor) -> None:
        """Let stopped processes go on after their time; most are killed before."""
        running = {child.pid for child in supervisor.children.values()}
        for stopped in [each for each in self._stopped if each.until_s <= time.monotonic()]:
            self._stopped.remove(stopped)
            if stopped.pid in running:
                os.kill(stopped.pid, signal.SIGCONT)


def bench_chaos(
    plan: RunPlan, *, kills: int, hangs: int, seed: int, on_frame: Callable[[FrameFacts], None]
) -> dict[str, Any]:
    """Run a recording in one process, then in a fleet under fire, and compare; at last kill a fleet's supervisor.

    Args:
        plan: The run.
        kills: SIGKILLs sent, evenly over the services; those within writes to shared memory and run folder come on top.
        hangs: SIGSTOPs of 15 s.
        seed: Draws the plan of both.
        on_frame: Called after each frame of the second run.
    """
    before = set(os.listdir(shared_memory_folder()))
    disturber = _Disturber(_events(len(plan.source), kills, hangs, seed), _points(seed), on_frame, random.Random(seed))
    with TemporaryDirectory(prefix="vtslam-chaos-") as folder:
        calm, disturbed = Path(folder, "calm"), Path(folder, "disturbed")
        plan.execute(calm)
        plan.execute_in_fleet(disturbed, disturber.hooks())
        counts = _frame_counts(disturbed)
        identical = result_bytes(calm) == result_bytes(disturbed)
        gone_s = seconds_after_supervisor_kill(plan, Path(folder))
    sent_kills = {name: disturber.sent[name, signal.SIGKILL] for name in _SERVICES}
    killed = {name: child.deaths - child.hangs for name, child in disturber.children.items()}
    return {
        "kills": sum(killed.values()),
        "kills_by_service": killed,
        "kills_in_shm_write": sum(killed[name] - sent_kills[name] for name in ("sensor", "mapper")),
        "kills_in_run_folder_write": killed["archiver"] - sent_kills["archiver"],
        "hangs": sum(disturber.sent[name, signal.SIGSTOP] for name in _SERVICES),
        "frames_missing": sum(frame_id not in counts for frame_id in range(len(plan.source))),
        "frames_duplicated": sum(count - 1 for count in counts.values()),
        "identical": identical,
        "orphans": sum(Path(f"/proc/{pid}").exists() for pid in disturber.pids),
        "gone_after_supervisor_kill_s": None if gone_s is None else round(gone_s, 3),
        "shm_left": len([name for name in set(os.listdir(shared_memory_folder())) - before if _is_ours(name)]),
    }


def is_sound(values: dict[str, Any]) -> bool:
    """Whether nothing was lost, doubled, changed or left."""
    none = ("frames_missing", "frames_duplicated", "orphans", "shm_left")
    died_with_supervisor = values["gone_after_supervisor_kill_s"] is not None
    return died_with_supervisor and values["identical"] is True and all(values[key] == 0 for key in none)


def _events(frames: int, kills: int, hangs: int, seed: int) -> list[tuple[int, str, signal.Signals]]:
    """Signals evenly over the run, services in an order drawn anew for each round."""
    rng = random.Random(seed)
    names: list[str] = []
    while len(names) < kills:
        names += rng.sample(_SERVICES, len(_SERVICES))
    signals = [(name, signal.SIGKILL) for name in names[:kills]]
    for index in range(hangs):
        place = (index + 1) * len(signals) // (hangs + 1)
        signals.insert(place, (_SERVICES[index % len(_SERVICES)], signal.SIGSTOP))
    usable = max(frames - 4, 1)  # near the end the sensor has finished
    return [(1 + i * usable // max(len(signals), 1), name, number) for i, (name, number) in enumerate(signals)]


def _points(seed: int) -> dict[tuple[str, int], str]:
    rng = random.Random(seed + 1)
    return {
        (name, start): f"{_PREFIXES[name]}{rng.choice(points)}:1"
        for name, points in _WITHIN_WRITES.items()
        for start in _POINT_STARTS
    }


def result_bytes(run: Path) -> dict[str, bytes]:
    """The files of a run that must not depend on how it was run, by name."""
    paths = [run / "trajectory.txt", *sorted((run / "sections").glob("*.vts"))]
    return {path.name: path.read_bytes() for path in paths}


def _frame_counts(path: Path) -> Counter[int]:
    """How often each frame is in the sections."""
    with RunFolder.open(path) as run:
        sections = [run.read_section(section_id) for section_id in run.section_ids()]
    return Counter(int(frame_id) for section in sections for frame_id in section.frame_ids)


def _is_ours(name: str) -> bool:
    """Of this run; others may run fleets of their own at the same time."""
    return name.startswith(f"vtslam-run-{os.getpid()}-")

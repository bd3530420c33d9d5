"""What a viewer costs the processes it looks at: while it works, once it is killed, and while it hangs."""

import os
import signal
import socket
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from vtslam.services.frame_facts import FrameFacts
from vtslam.services.process_facts import cpu_seconds
from vtslam.services.run_plan import RunPlan
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.processes import MAPPER, TRACKER, VIEWER
from vtslam.services.supervisor.supervisor import Supervisor

KINDS = ("without", "with", "killed", "hung")
_SIGNALS = {"killed": signal.SIGKILL, "hung": signal.SIGSTOP}
_MEASURED = (TRACKER.name, MAPPER.name)


@dataclass(slots=True)
class _Watch:
    """One run as its supervisor sees it.

    Attributes:
        kind: One of `KINDS`.
        half: Frames after which the viewer is disturbed, if it is.
        frames: Committed.
        looks: Frames committed, time on the clock, and processor time of tracker and mapper, s, at each look.
        shown: Updates that the viewer says it has shown.
    """

    kind: str
    half: int
    frames: int = 0
    looks: list[tuple[int, float, float]] = field(default_factory=list)
    shown: int = 0
    _is_done: bool = False

    def on_frame(self, facts: FrameFacts) -> None:
        self.frames += 1

    def on_step(self, supervisor: Supervisor) -> None:
        pids = [supervisor.children[name].pid for name in _MEASURED]
        if self.frames and not (self.looks and self.looks[-1][0] == self.frames):
            cpu_s = [cpu_seconds(pid) for pid in pids if pid is not None]
            if len(cpu_s) == len(pids):
                self.looks.append((self.frames, time.perf_counter(), sum(cpu_s)))
        viewer = supervisor.children.get(VIEWER.name)
        if viewer is None:
            return
        self.shown = max(self.shown, viewer.counters.get("updates.shown", 0))
        if self.frames >= self.half and not self._is_done and self.kind in _SIGNALS and viewer.pid is not None:
            os.kill(viewer.pid, _SIGNALS[self.kind])
            self._is_done = True

    def per_frame(self, first: int) -> tuple[float, float]:
        """Seconds per frame from frame ``first`` to the last: of processor time, and on the clock."""
        frames, wall_s, cpu_s = np.array(self.looks).T
        ends = [max(first, frames[0]), frames[-1]]
        count = max(ends[1] - ends[0], 1.0)
        spent_cpu_s, spent_wall_s = (float(np.diff(np.interp(ends, frames, each))[0]) for each in (cpu_s, wall_s))
        return spent_cpu_s / count, spent_wall_s / count


def bench_viewer(plan: RunPlan, *, rounds: int, on_part: Callable[[str], None]) -> dict[str, Any]:
    """Run the same fleet without a viewer, with one, with one killed half-way and with one stopped half-way, by turns.

    Args:
        plan: The run.
        rounds: Runs of each kind.
        on_part: Told what begins.

    Returns:
        Seconds per frame of each run (processor time of tracker and mapper, time on the clock), over the whole of it
        and, ``late``, over its second half; and medians over those without a viewer: for the undisturbed viewer of the
        whole run, for the others of what came after the disturbance.

    Raises:
        ViewerError: The viewer cannot be used here: a fleet goes on without it, and nothing would be measured.
    """
    from vtslam.services.viewer import rerun_sink  # noqa: F401  # refuses where rerun is missing

    half = len(plan.source) // 2
    runs: dict[str, dict[str, list[float]]] = {
        kind: {name: [] for name in ("cpu_s", "wall_s", "late_cpu_s", "late_wall_s")} for kind in KINDS
    }
    shown: dict[str, list[int]] = {kind: [] for kind in KINDS[1:]}
    for number in range(rounds):
        turn = number % len(KINDS)
        for kind in (*KINDS[turn:], *KINDS[:turn]):  # nobody is always first
            on_part(f"{kind}, round {number + 1} of {rounds}")
            watch = _watched(plan, kind, half)
            for name, value in zip(runs[kind], watch.per_frame(1) + watch.per_frame(half), strict=True):
                runs[kind][name].append(round(float(value), 5))
            if kind in shown:
                shown[kind].append(watch.shown)
    values: dict[str, Any] = {"frames": len(plan.source), "rounds": rounds, "updates_shown": shown, **runs}
    for kind in KINDS[1:]:
        for name in ("cpu", "wall"):
            figure = f"{name}_s" if kind == "with" else f"late_{name}_s"
            alone = statistics.median(runs["without"][figure])
            values[f"{kind}_{name}_ratio"] = round(statistics.median(runs[kind][figure]) / alone, 4) if alone else None
    return values


def _watched(plan: RunPlan, kind: str, half: int) -> _Watch:
    viewer = replace(plan.settings.viewer, web_port=0 if kind == "without" else _free_ports(), save="")
    watch = _Watch(kind, half=half)
    with TemporaryDirectory(prefix="vtslam-bench-") as folder:
        viewed = replace(plan, settings=replace(plan.settings, viewer=viewer))
        viewed.execute_in_fleet(Path(folder, "run"), FleetHooks(on_frame=watch.on_frame, on_step=watch.on_step))
    return watch


def _free_ports() -> int:
    """A port that is free with the one after it, as far as one can know."""
    while True:
        with socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port = int(first.getsockname()[1])
            try:
                second.bind(("127.0.0.1", port + 1))
            except (OSError, OverflowError):
                continue
            return port

"""Long runs with a viewer, which tests disturb once it has shown something, and end."""

import os
import signal
from dataclasses import dataclass, field
from pathlib import Path

from vtslam.services.run_plan import RunPlan, plan_run
from vtslam.services.run_record import RunSummary
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.supervisor import Supervisor

_FRAMES = 3000  # more than a test waits for
_ASSIGNMENTS = (
    "source.size=48x36",
    "section.length=3",
    "section.candidate_interval=2",
    "mapper.iterations_head=2",
    "mapper.iterations_regular=1",
    "mapper.iterations_seal=1",
    "splat.threads=1",
    "fleet.pacing=lockstep",
    "viewer.idle=false",  # or it might never show anything beside other work
    "viewer.cpu_share=1.0",
)


def viewed_plan(*assignments: str, frames: int = _FRAMES) -> RunPlan:
    """A run of the simulated room in small images."""
    uri = f"sim:room?frames={_FRAMES}"
    return plan_run(uri, assignments=[*_ASSIGNMENTS, f"source.frames=0:{frames}", *assignments])


@dataclass(slots=True)
class ViewedRun:
    """A run that ends once the viewer has shown some updates, or some frames after it was sent a signal.

    Attributes:
        updates: So many are waited for.
        disturbance: What the viewer is sent then; None ends the run.
        further: Frames committed after that, before the run ends.
        frames: Committed.
        events: What the supervisor told.
        deaths, starts: By process.
    """

    updates: int
    disturbance: signal.Signals | None = None
    further: int = 8
    frames: int = 0
    events: list[str] = field(default_factory=list)
    deaths: dict[str, int] = field(default_factory=dict)
    starts: dict[str, int] = field(default_factory=dict)
    _disturbed_at: int | None = None
    _is_over: bool = False

    def execute(self, plan: RunPlan, out: Path) -> RunSummary:
        hooks = FleetHooks(
            on_frame=lambda facts: self._count(),
            on_event=self.events.append,
            on_step=self._step,
            should_stop=lambda: self._is_over,
        )
        return plan.execute_in_fleet(out, hooks)

    def _count(self) -> None:
        self.frames += 1

    def _step(self, supervisor: Supervisor) -> None:
        viewer = supervisor.children["viewer"]
        self.deaths = {name: child.deaths for name, child in supervisor.children.items()}
        self.starts = {name: child.epoch for name, child in supervisor.children.items()}
        if self._disturbed_at is not None:
            self._is_over = self.frames >= self._disturbed_at + self.further
        elif viewer.counters.get("updates.shown", 0) >= self.updates:
            if self.disturbance is None or viewer.pid is None:
                self._is_over = True
            else:
                os.kill(viewer.pid, self.disturbance)
                self._disturbed_at = self.frames

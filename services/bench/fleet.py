"""What running as processes costs: a recording in one process and in a fleet, start-up left out."""

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vtslam.services.frame_facts import FrameFacts
from vtslam.services.run_plan import RunPlan
from vtslam.services.supervisor.fleet_run import FleetHooks


class _Stopwatch:
    """From the first committed frame to the last one, in seconds."""

    def __init__(self) -> None:
        self._first_s: float | None = None
        self.seconds = 0.0

    def __call__(self, facts: FrameFacts) -> None:
        now_s = time.perf_counter()
        self._first_s = now_s if self._first_s is None else self._first_s
        self.seconds = now_s - self._first_s


def bench_fleet(plan: RunPlan) -> dict[str, Any]:
    """Seconds of both from the first committed frame to the last, and their ratio."""
    alone, lockstep = _Stopwatch(), _Stopwatch()
    with TemporaryDirectory(prefix="vtslam-bench-") as folder:
        plan.execute(Path(folder, "alone"), on_frame=alone)
        summary = plan.execute_in_fleet(Path(folder, "fleet"), FleetHooks(on_frame=lockstep))
    return {
        "frames": summary.frames,
        "in_process_s": round(alone.seconds, 3),
        "lockstep_s": round(lockstep.seconds, 3),
        "lockstep_ratio": round(lockstep.seconds / alone.seconds, 4) if alone.seconds > 0 else None,
    }

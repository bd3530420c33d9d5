"""A fleet whose supervisor is killed: how long its processes live on."""

import subprocess
import sys
import time
from pathlib import Path

from vtslam.common.fleet_folder import shared_memory_folder, sweep_dead_fleets
from vtslam.services.process_facts import children_of, is_gone
from vtslam.services.run_plan import RunPlan
from vtslam.services.supervisor.processes import PROCESSES

_POLL_S = 0.005
_START_S = 300.0  # until all processes work
_DEATH_S = 60.0  # until they are given up


def seconds_after_supervisor_kill(plan: RunPlan, folder: Path) -> float | None:
    """Seconds from SIGKILL of a fleet's supervisor until all its processes are gone; None if they live on.

    Args:
        plan: The run, whose recording and settings' layers are used.
        folder: Where its run folder is made.

    Raises:
        TimeoutError: The fleet does not start to work.
    """
    words = ["run", plan.source.uri, "--out", str(folder / "killed")]
    words += ["--preset", plan.preset, "--family", plan.family]
    fleet = subprocess.Popen(
        [sys.executable, "-m", "vtslam.services.cli", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        pids = working_processes(fleet)
    finally:
        fleet.kill()
        start_s = time.monotonic()
        fleet.wait()
    try:
        while not all(is_gone(pid) for pid in pids):
            if time.monotonic() - start_s > _DEATH_S:
                return None
            time.sleep(_POLL_S)
        return time.monotonic() - start_s
    finally:
        sweep_dead_fleets()


def working_processes(fleet: "subprocess.Popen[bytes]") -> set[int]:
    """The processes of a fleet once the first frame is in its ring."""
    deadline_s = time.monotonic() + _START_S
    while fleet.poll() is None and time.monotonic() < deadline_s:
        pids = children_of(fleet.pid)
        if len(pids) == len(PROCESSES) and any(shared_memory_folder().glob(f"vtslam-run-{fleet.pid}-*/ring")):
            return pids
        time.sleep(_POLL_S)
    raise TimeoutError(f"the fleet did not start to work within {_START_S:g} s; status {fleet.poll()}")

"""Long runs by the command line, in processes that tests stop or look at."""

import subprocess
import sys
from pathlib import Path

from helpers.processes import source_environment

DEADLINE_S, POLL_S = 60.0, 0.02


def wait_for(path: Path, process: "subprocess.Popen[str]") -> None:
    """Until ``path`` is there; fails if the process ends first or the deadline passes."""
    for _ in range(int(DEADLINE_S / POLL_S)):
        if path.exists():
            return
        try:
            process.wait(POLL_S)
        except subprocess.TimeoutExpired:
            continue
        break
    raise AssertionError(f"{path} did not appear; the process ended with {process.poll()}")


def start_run(out: Path, *mode: str) -> "subprocess.Popen[str]":
    """A long run of the simulated room, in a process."""
    words = ["run", "sim:room?frames=2000", *mode, "--size", "48x36", "--set", "section.length=3"]
    return start_vtslam(*words, "--out", str(out))


def start_vtslam(*words: str) -> "subprocess.Popen[str]":
    """A command in a process, its output and errors in one pipe."""
    return subprocess.Popen(
        [sys.executable, "-m", "vtslam.services.cli", *words],
        env=source_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )

"""A run whose whole fleet is killed again and again and resumed each time, held against the same run undisturbed."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from vtslam.common.fleet_folder import sweep_dead_fleets
from vtslam.services.bench.chaos import result_bytes
from vtslam.services.bench.supervisor_kill import working_processes
from vtslam.services.process_facts import is_gone
from vtslam.services.run_plan import RunPlan
from vtslam.services.supervisor.errors import FleetError
from vtslam.storage import section_care
from vtslam.storage.run_folder import RunFolder

_POLL_S = 0.02
_SECTION_S = 600.0  # until a section is durable, at most
_DEATH_S = 60.0  # until killed processes are gone, at most
_TOLD_CHARACTERS = 2000


def bench_resume(plan: RunPlan, *, kills: int, seed: int, on_kill: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Run a recording in one process, then as fleets of which all but the last are killed, and compare.

    Args:
        plan: The run; its fleets are lockstep ones.
        kills: SIGKILLs of a whole fleet, supervisor and services at once.
        seed: Draws the moments: a number of durable sections, each once as far as there are enough, and a part of the
            section that follows.
        on_kill: Called after each of them.

    Returns:
        ``frames`` of the run, ``kills`` that met it in progress, whether the result is ``identical``, and
        ``sections_verified`` of its ``sections``.

    Raises:
        FleetError: A fleet ended by itself and not well.
        TimeoutError: A fleet does not start to work, or does not die.
    """
    rng = random.Random(seed)
    with TemporaryDirectory(prefix="vtslam-resume-") as folder:
        calm, killed, log = Path(folder, "calm"), Path(folder, "killed"), Path(folder, "log")
        undisturbed = plan.execute(calm)
        RunFolder.create(killed, plan.info()).close()
        ends, met = _ends_of_sections(calm), 0
        for section_id in _moments(rng, kills, sections=len(ends)):
            within = (0, *ends)[section_id : section_id + 2]
            delay_s = rng.uniform(0.0, undisturbed.seconds / undisturbed.sections)
            met += _killed(killed, log, frames=(within[0], within[1]), delay_s=delay_s)
            on_kill()
        _finish(killed, log)
        sweep_dead_fleets()
        with RunFolder.open(killed) as run:
            healths = list(section_care.examined(run))
        return {
            "frames": undisturbed.frames,
            "kills": met,
            "identical": result_bytes(calm) == result_bytes(killed),
            "sections": undisturbed.sections,
            "sections_verified": sum(health.problem is None for health in healths),
        }


def is_whole(values: dict[str, Any], *, kills: int) -> bool:
    """Whether every kill met a run in progress, and nothing came of them."""
    verified = values["sections_verified"] == values["sections"]
    return values["identical"] is True and verified and values["kills"] == kills


def _ends_of_sections(path: Path) -> list[int]:
    with RunFolder.open(path) as run:
        return [row.end_frame_id for row in run.catalog.sections()]


def _moments(rng: random.Random, kills: int, *, sections: int) -> list[int]:
    """Sections that are being mapped when a fleet is killed, rising; the last one would be over too soon."""
    choices = range(max(sections - 1, 1))
    if kills <= len(choices):
        return sorted(rng.sample(choices, kills))
    return sorted(rng.choices(choices, k=kills))


def _resumed(run: Path, log: Path) -> "subprocess.Popen[bytes]":
    """A fleet that goes on with the run."""
    words = [sys.executable, "-m", "vtslam.services.cli", "run", "--resume", str(run)]
    with log.open("wb") as output:
        return subprocess.Popen(words, stdout=output, stderr=subprocess.STDOUT)


def _killed(run: Path, log: Path, *, frames: tuple[int, int], delay_s: float) -> bool:
    """Resume the run, and kill everything; whether it was still at work.

    Args:
        run: The run folder.
        log: What the fleet says.
        frames: The kill waits until so many are durable, and then ...
        delay_s: ... so long, or until the second number is.
    """
    fleet = _resumed(run, log)
    pids: set[int] = set()
    try:
        pids = _working(fleet)
        _wait_until_durable(run, frames[0], fleet, patience_s=_SECTION_S)
        _wait_until_durable(run, frames[1], fleet, patience_s=delay_s)
    finally:
        at_work = fleet.poll() is None
        for pid in (fleet.pid, *pids) if at_work else ():
            _kill(pid)
        fleet.wait()
        _wait_until_gone(pids)
    if not at_work:
        _require_success(fleet, log)
    return at_work


def _kill(pid: int) -> None:
    with suppress(ProcessLookupError):  # its supervisor's death may have been its own
        os.kill(pid, signal.SIGKILL)


def _working(fleet: "subprocess.Popen[bytes]") -> set[int]:
    """The fleet's processes once they work; none if there was nothing left to do."""
    try:
        return working_processes(fleet)
    except TimeoutError:
        if fleet.poll() is None:
            raise
        return set()


def _wait_until_durable(run: Path, frames: int, fleet: "subprocess.Popen[bytes]", *, patience_s: float) -> None:
    """Until so many frames are durable, the fleet has ended, or for so long no section became durable."""
    deadline_s, found = time.monotonic() + patience_s, -1
    while fleet.poll() is None and time.monotonic() < deadline_s:
        with RunFolder.open(run) as folder:
            durable = folder.catalog.num_frames
        if durable >= frames:
            return
        if found >= 0 and durable > found:
            deadline_s = time.monotonic() + patience_s
        found = durable
        time.sleep(_POLL_S)


def _wait_until_gone(pids: set[int]) -> None:
    deadline_s = time.monotonic() + _DEATH_S
    while not all(is_gone(pid) for pid in pids):
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"processes live on {_DEATH_S:g} s after they and their supervisor were killed: {pids}")
        time.sleep(_POLL_S)


def _finish(run: Path, log: Path) -> None:
    fleet = _resumed(run, log)
    try:
        fleet.wait()
    finally:
        fleet.kill()
        fleet.wait()
    _require_success(fleet, log)


def _require_success(fleet: "subprocess.Popen[bytes]", log: Path) -> None:
    if fleet.returncode != 0:
        told = log.read_text(errors="replace")[-_TOLD_CHARACTERS:]
        raise FleetError(f"the fleet ended with status {fleet.returncode}: {told}")

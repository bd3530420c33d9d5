"""Threads that hand messages on wait for nobody's time slice; who works ahead leaves others the processors."""

import errno
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeVar

import pytest

from vtslam.common.bus import Member
from vtslam.common.bus_zenoh import Hub, join
from vtslam.common.scheduling import answer_at_once, threads_that_answer_at_once
from vtslam.common.topics import Role

SHORTEST_NS = 100_000
R = TypeVar("R")


@dataclass(frozen=True)
class Standing:
    """How the kernel treats a thread: its policy, priority within it, nice value and, where it tells, time slice."""

    policy: int
    priority: int
    nice: int
    slice_ns: int | None

    @classmethod
    def of(cls, thread: int) -> Self:
        text = Path(f"/proc/self/task/{thread}/sched")
        line = re.search(r"^se\.slice\s*:\s*(\d+)$", text.read_text() if text.exists() else "", re.MULTILINE)
        return cls(
            policy=os.sched_getscheduler(thread),
            priority=os.sched_getparam(thread).sched_priority,
            nice=os.getpriority(os.PRIO_PROCESS, thread),
            slice_ns=None if line is None else int(line[1]),
        )

    @property
    def answers_at_once(self) -> bool:
        return (self.policy, self.priority) == (os.SCHED_RR, 1) or self.slice_ns == SHORTEST_NS


def own_standing() -> Standing:
    return Standing.of(threading.get_native_id())


def in_new_thread(work: Callable[[], R]) -> R:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


def has_slices() -> bool:
    """Whether threads have slices of their own (from Linux 6.12 on), and the kernel tells which."""
    release = re.match(r"(\d+)\.(\d+)", os.uname().release)
    assert release is not None
    return (int(release[1]), int(release[2])) >= (6, 12) and own_standing().slice_ns is not None


def may_have_real_time_priority() -> bool:
    def ask() -> bool:
        try:
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        except OSError:
            return False
        return True

    return in_new_thread(ask)


@pytest.fixture(params=["real-time priority", "short slices"])
def means(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """What the system lets threads have."""
    name = str(request.param)
    if name == "short slices":
        if not has_slices():
            pytest.skip("the kernel has no slices, or does not tell")
        refuse_real_time(monkeypatch)
    elif not may_have_real_time_priority():
        pytest.skip("this user may not have real-time priority")
    return name


def refuse_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the kernel does for users without the right."""
    allowed = os.sched_setscheduler

    def refuse(pid: int, policy: int, param: os.sched_param) -> None:
        if policy in (os.SCHED_RR, os.SCHED_FIFO):
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
        allowed(pid, policy, param)

    monkeypatch.setattr(os, "sched_setscheduler", refuse)


def test_threads_started_within_answer_at_once_and_others_as_usual(means: str) -> None:
    usual = own_standing()
    assert not usual.answers_at_once
    with threads_that_answer_at_once():
        inside = in_new_thread(own_standing)
    assert inside.answers_at_once
    assert (inside.policy == os.SCHED_RR) == (means == "real-time priority")
    assert own_standing() == usual
    assert in_new_thread(own_standing) == usual


def test_a_process_that_stepped_back_stays_so_after_threads_that_answer_at_once(means: str) -> None:
    def stepped_back() -> tuple[Standing, Standing]:
        os.nice(3)
        before = own_standing()
        with threads_that_answer_at_once():
            pass
        return before, own_standing()

    before, after = in_new_thread(stepped_back)
    assert before == after
    assert after.nice == own_standing().nice + 3


def test_what_runs_only_where_nobody_else_wants_to_stays_so() -> None:
    def idle() -> int:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        with threads_that_answer_at_once():
            return os.sched_getscheduler(0)

    assert in_new_thread(idle) == os.SCHED_IDLE


def test_all_threads_of_sessions_on_the_bus_answer_at_once(means: str, tmp_path: Path) -> None:
    with Hub(tmp_path / "hub", "test"), join(Member(fleet="test", role=Role.TRACKER), tmp_path / "hub"):
        names = {path.parent.name: path.read_text() for path in Path("/proc/self/task").glob("[0-9]*/comm")}
        zenohs = [int(thread) for thread, name in names.items() if re.fullmatch(r"(app|acc|net|rx|tx)-\d+\n", name)]
        assert len(zenohs) >= 3
        assert all(Standing.of(thread).answers_at_once for thread in zenohs)


def test_a_thread_may_answer_at_once_from_now_on(means: str) -> None:
    def now_on() -> tuple[Standing, Standing]:
        answer_at_once()
        return own_standing(), in_new_thread(own_standing)

    assert all(standing.answers_at_once for standing in in_new_thread(now_on))
    assert not own_standing().answers_at_once


@pytest.mark.parametrize(("way", "nice"), [("give_way", 10), ("yield_to_others", 19)])
@pytest.mark.parametrize("leads", [True, False])
def test_a_process_that_steps_back_takes_its_session_along_if_it_leads_one(way: str, nice: int, *, leads: bool) -> None:
    group = Path("/proc/self/autogroup")  # empty for a session as old as its container, absent from some kernels
    lines = [
        "import os",
        "from pathlib import Path",
        f"from vtslam.common.scheduling import {way}",
        f"{way}()",
        f"group = Path('{group}')",
        "text = group.read_text() if group.exists() else ''",
        "print(os.getpriority(os.PRIO_PROCESS, 0), (text.split() or ['none'])[-1])",
    ]
    command = [sys.executable, "-c", "\n".join(lines)]
    usual = ((group.read_text() if group.exists() else "").split() or ["none"])[-1]
    said = subprocess.run(command, start_new_session=leads, capture_output=True, text=True, check=True).stdout.split()
    assert int(said[0]) == nice + os.getpriority(os.PRIO_PROCESS, 0)
    assert said[1] in ((str(nice), "none") if leads else (usual,))

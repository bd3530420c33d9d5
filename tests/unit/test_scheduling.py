"""Threads that hand messages on wait for nobody's time slice; who works ahead leaves others the processors."""

import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from vtslam.common.bus import Member
from vtslam.common.bus_zenoh import Hub, join
from vtslam.common.scheduling import answer_at_once, threads_that_answer_at_once
from vtslam.common.topics import Role

SHORTEST_NS = 100_000


def slices_ns() -> dict[str, int]:
    """Of the threads of this process by id, as the kernel tells them."""
    found = {}
    for path in Path("/proc/self/task").glob("[0-9]*/sched"):
        if (line := re.search(r"^se\.slice\s*:\s*(\d+)$", path.read_text(), re.MULTILINE)) is not None:
            found[path.parent.name] = int(line[1])
    return found


def own_slice_ns() -> int:
    return slices_ns()[str(threading.get_native_id())]


def slice_of_new_thread_ns() -> int:
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(own_slice_ns()))
    thread.start()
    thread.join()
    return found[0]


@pytest.fixture
def _kernel_has_slices() -> None:
    release = re.match(r"(\d+)\.(\d+)", os.uname().release)
    assert release is not None
    if (int(release[1]), int(release[2])) < (6, 12):
        pytest.skip("threads have slices of their own from Linux 6.12 on")
    try:
        found = slices_ns()
    except OSError as error:
        pytest.skip(f"the kernel does not tell: {error}")
    if not found:
        pytest.skip("the kernel does not tell")


@pytest.mark.usefixtures("_kernel_has_slices")
def test_threads_started_within_have_the_shortest_slice_and_others_what_is_usual() -> None:
    usual = own_slice_ns()
    assert usual > SHORTEST_NS
    with threads_that_answer_at_once():
        assert slice_of_new_thread_ns() == SHORTEST_NS
    assert own_slice_ns() == usual
    assert slice_of_new_thread_ns() == usual


@pytest.mark.usefixtures("_kernel_has_slices")
def test_what_runs_only_where_nobody_else_wants_to_stays_so() -> None:
    found: list[int] = []

    def idle() -> None:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        with threads_that_answer_at_once():
            found.append(os.sched_getscheduler(0))

    thread = threading.Thread(target=idle)
    thread.start()
    thread.join()
    assert found == [os.SCHED_IDLE]


@pytest.mark.usefixtures("_kernel_has_slices")
def test_all_threads_of_sessions_on_the_bus_answer_at_once(tmp_path: Path) -> None:
    with Hub(tmp_path / "hub", "test"), join(Member(fleet="test", role=Role.TRACKER), tmp_path / "hub"):
        names = {path.parent.name: path.read_text() for path in Path("/proc/self/task").glob("[0-9]*/comm")}
        zenohs = {thread for thread, name in names.items() if re.fullmatch(r"(app|acc|net|rx|tx)-\d+\n", name)}
        assert len(zenohs) >= 3
        assert {each for thread, each in slices_ns().items() if thread in zenohs} == {SHORTEST_NS}


@pytest.mark.usefixtures("_kernel_has_slices")
def test_a_thread_may_answer_at_once_from_now_on() -> None:
    found: list[int] = []

    def now_on() -> None:
        answer_at_once()
        found.extend((own_slice_ns(), slice_of_new_thread_ns()))

    thread = threading.Thread(target=now_on)
    thread.start()
    thread.join()
    assert found == [SHORTEST_NS, SHORTEST_NS]
    assert own_slice_ns() > SHORTEST_NS


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

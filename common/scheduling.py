"""How soon threads get a processor that others want too."""

import ctypes
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_PRIORITY = 1  # of real-time ones: the lowest, which is before all usual ones

# Linux 6.12 and later: a thread that wakes runs before those with longer slices, so long as it uses less than its
# share, which stays what it was. Earlier kernels take the number and ignore it.
_SLICE_NS = 100_000  # the shortest there is
_USUAL = 0  # the kernel's own choice

_BEHIND = 10  # a nice value: a tenth of the share of one at 0

_SYSCALLS = {"x86_64": 314, "aarch64": 274}  # sched_setattr


class _SchedAttr(ctypes.Structure):
    """``struct sched_attr`` of its first version, see sched_setattr(2)."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime_ns", ctypes.c_uint64),
        ("deadline_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),
    )


@contextmanager
def threads_that_answer_at_once() -> Iterator[None]:
    """Threads that this one starts within run as soon as they wake, although others use all processors.

    For threads that hand messages on: they work for microseconds and sleep again, and what they wait for a processor is
    their whole delay. They have real-time priority where this process may give it (root, CAP_SYS_NICE or
    RLIMIT_RTPRIO), and else the shortest time slices: with these a thread still waits for the kernel's next tick where
    another runs. Does nothing where the system has neither, or where this thread runs by other than the usual rules.
    """
    undo = _put_forward()
    try:
        yield
    finally:
        undo()


def answer_at_once() -> None:
    """Let this thread run as soon as it wakes from now on; threads that it starts later too.

    See :func:`threads_that_answer_at_once`.
    """
    _put_forward()


def give_way() -> None:
    """Leave the processors to processes that others wait for, and take what is left: for those that work ahead.

    Threads that there are already, as a bus session's, keep their place within the process.
    """
    _step_back(_BEHIND)


def yield_to_others() -> None:
    """Let this process and what it starts run only where nobody else wants to: nice 19, SCHED_IDLE.

    Threads that there are already keep theirs.
    """
    _step_back(19)
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def _step_back(nice: int) -> None:
    """Lower the calling thread, and the whole session if this process leads one.

    Where the kernel groups processes by session, processors are shared out among sessions first.
    """
    os.nice(nice)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):  # not every kernel has groups
            Path("/proc/self/autogroup").write_text(str(nice))


def _put_forward() -> Callable[[], None]:
    """Put the calling thread before those of the usual priority; what undoes it."""
    if os.sched_getscheduler(0) != os.SCHED_OTHER:
        return lambda: None
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_PRIORITY))
    except OSError:  # not allowed
        _set_slice(_SLICE_NS)
        return lambda: _set_slice(_USUAL)
    return lambda: os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _set_slice(slice_ns: int) -> None:
    """Set that of the calling thread, where the kernel takes it."""
    number = _SYSCALLS.get(platform.machine())
    if number is None:
        return
    wanted = _SchedAttr(
        size=ctypes.sizeof(_SchedAttr),
        policy=os.SCHED_OTHER,
        nice=os.getpriority(os.PRIO_PROCESS, 0),
        runtime_ns=slice_ns,
    )
    ctypes.CDLL(None).syscall(ctypes.c_long(number), 0, ctypes.byref(wanted), 0)

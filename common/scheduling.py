"""How soon threads get a processor that others want too."""

import ctypes
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
    their whole delay. Does nothing where the system has no such thing, or where this thread runs by other than the
    usual rules (SCHED_IDLE, real time).
    """
    changed = _set_slice(_SLICE_NS)
    try:
        yield
    finally:
        if changed:
            _set_slice(_USUAL)


def answer_at_once() -> None:
    """Let this thread run as soon as it wakes from now on; threads that it starts later too."""
    _set_slice(_SLICE_NS)


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


def _set_slice(slice_ns: int) -> bool:
    """Set that of the calling thread; whether the kernel took it."""
    number = _SYSCALLS.get(platform.machine())
    if number is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    wanted = _SchedAttr(
        size=ctypes.sizeof(_SchedAttr),
        policy=os.SCHED_OTHER,
        nice=os.getpriority(os.PRIO_PROCESS, 0),
        runtime_ns=slice_ns,
    )
    return bool(ctypes.CDLL(None).syscall(ctypes.c_long(number), 0, ctypes.byref(wanted), 0) == 0)

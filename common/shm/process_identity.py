"""Who a process is, in one word, and whether it is still there (docs/protocol-shm.md, section 2)."""

import os
from functools import cache
from pathlib import Path

PID_BITS = 22  # the kernel's largest pid is 2^22


def identity_of(pid: int, start_ticks: int) -> int:
    """The identity of a process by its pid and its start time in clock ticks since boot."""
    return pid | start_ticks << PID_BITS


def own_identity() -> int:
    """The identity of this process."""
    return _own_identity(os.getpid())


@cache
def _own_identity(pid: int) -> int:
    found = _start_ticks_and_state(pid)
    assert found is not None, "a process sees itself in /proc"
    return identity_of(pid, found[0])


def pid_of(identity: int) -> int:
    """The pid in an identity."""
    return identity & ((1 << PID_BITS) - 1)


def is_alive(identity: int) -> bool:
    """Whether the process can still write: it exists, with that start time, and has not ended in all its threads."""
    pid = pid_of(identity)
    found = _start_ticks_and_state(pid)
    if found is None or identity_of(pid, found[0]) != identity:
        return False
    if found[1] not in "ZX":
        return True
    # The leading thread of a killed process can be a zombie while others are still on their way out.
    try:
        return len(os.listdir(f"/proc/{pid}/task")) > 1
    except OSError:
        return False


def boot_id() -> str:
    """A text that another boot of this machine does not have."""
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _start_ticks_and_state(pid: int) -> tuple[int, str] | None:
    """Start time in clock ticks and the state letter of a process; None if there is none."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return None
    # The name in brackets may itself hold spaces and brackets.
    fields = stat[stat.rindex(b")") + 2 :].split()
    return int(fields[19]), fields[0].decode("ascii")

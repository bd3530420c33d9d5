"""What a process can say of itself (memory, the versions its results may depend on), and of other processes."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def program_version() -> str:
    """Version of vtslam, or "unknown" where it runs from a source tree that is not installed."""
    return package_version("vtslam")


def package_version(name: str) -> str:
    """Version of an installed package, or "unknown"."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


def versions() -> dict[str, str]:
    """Versions by name."""
    return {
        "vtslam": program_version(),
        "python": platform.python_version(),
        "numpy": package_version("numpy"),
        "opencv": package_version("opencv-python-headless"),
        "machine": platform.machine(),
    }


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far, in 10^6 bytes.

    From the kernel's VmHWM: getrusage would also count what the process was before it became this program.
    """
    return _status_mb("self", "VmHWM:")


def private_rss_mb(pid: int) -> float:
    """Memory of a process that is no file's and nobody else's (RssAnon), in 10^6 bytes; 0 if there is no such one."""
    try:
        return _status_mb(str(pid), "RssAnon:")
    except OSError:
        return 0.0


def cpu_seconds(pid: int) -> float:
    """Processor time that a process has used with all its threads; 0 if there is no such one."""
    try:
        words = _said(f"/proc/{pid}/stat").rpartition(")")[2].split()  # the name before it may hold anything
    except OSError:
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _status_mb(process: str, key: str) -> float:
    for line in _said(f"/proc/{process}/status").splitlines():
        if line.startswith(key):
            return int(line.split()[1]) * 1024 / 1e6
    return 0.0


def _said(path: str) -> str:
    """A file's text; a Path would leave marks in the memory that is looked at (see `MapStore.used_bytes`)."""
    with open(path, encoding="ascii", errors="replace") as file:
        return file.read()


def is_gone(pid: int) -> bool:
    """Whether there is no such process, or only what its parent has not taken note of."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state == "Z"


def children_of(pid: int) -> set[int]:
    """Pids of a process's children."""
    found = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = path.read_text().rpartition(")")[2].split()[1]  # the name before it may hold anything
        except OSError:
            continue
        if int(parent) == pid:
            found.add(int(path.parent.name))
    return found

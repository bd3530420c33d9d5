"""What a process can say of itself: memory, and the versions its results may depend on."""

import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_STATUS = Path("/proc/self/status")


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
    for line in _STATUS.read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    return 0.0

"""What tests that start processes share."""

import os
import shutil
import sys
import tempfile
from pathlib import Path

_SOURCE = Path(__file__).resolve().parents[2] / "src"
_VARIABLE = "VTSLAM_SHARED_MEMORY"
_SHARED_MEMORY, _PREFIX = Path("/dev/shm"), "vts-test-"


def source_environment() -> dict[str, str]:
    """The environment, with this checkout's package first on the path."""
    paths = [str(_SOURCE), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def keep_bytecode(folder: Path) -> None:
    """Where PYTHONDONTWRITEBYTECODE is set, keep compiled modules apart from the sources, but keep them.

    The tests start some hundred interpreters, each of which would compile all that it imports.
    """
    if sys.dont_write_bytecode:
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        sys.dont_write_bytecode = False
        sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(folder)


def take_own_shared_memory() -> None:
    """Let this process and all it starts have their fleets in a folder of its own, where no others are swept or seen.

    Test processes that work beside each other are apart in this way, and what belongs to one bears its mark.
    """
    for path in _SHARED_MEMORY.glob(f"{_PREFIX}*"):
        if not Path("/proc", path.name.removeprefix(_PREFIX).partition("-")[0]).exists():  # tests that were killed
            shutil.rmtree(path, ignore_errors=True)
    os.environ[_VARIABLE] = tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}-", dir=_SHARED_MEMORY)


def remove_own_shared_memory() -> None:
    """Delete the folder of :func:`take_own_shared_memory`."""
    shutil.rmtree(os.environ.pop(_VARIABLE))


def leftovers() -> list[str]:
    """Processes that this one started, by way of others too, and what is left in its part of shared memory."""
    mark = f"{_VARIABLE}={os.environ[_VARIABLE]}".encode()
    found = [str(path) for path in Path(os.environ[_VARIABLE]).iterdir()]
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            if int(path.parent.name) != os.getpid() and mark in path.read_bytes().split(b"\0"):
                words = (path.parent / "cmdline").read_bytes().split(b"\0")
                found.append(f"process {path.parent.name}: {b' '.join(words).decode()}")
        except OSError:  # it has just ended, or is not ours
            continue
    return found

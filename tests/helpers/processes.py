"""What tests that start processes share."""

import os
from pathlib import Path

from vtslam.common.fleet_folder import SHARED_MEMORY, read_owner
from vtslam.common.shm.process_identity import own_identity
from vtslam.services.process_facts import is_gone

_SOURCE = Path(__file__).resolve().parents[2] / "src"


def source_environment() -> dict[str, str]:
    """The environment, with this checkout's package first on the path."""
    paths = [str(_SOURCE), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def leftovers() -> list[str]:
    """Processes and shared memory of fleets that this process started, or whose supervisor is gone."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"vtslam.services.supervisor.child" in words and b"--parent" in words:
            parent = int(words[words.index(b"--parent") + 1])
            if parent == os.getpid() or is_gone(parent):
                found.append(f"process {path.parent.name}: {b' '.join(words).decode()}")
    for path in SHARED_MEMORY.glob("vtslam-*"):
        owner = read_owner(path)
        if owner is None or owner.identity == own_identity() or not owner.is_alive:
            found.append(str(path))
    return found

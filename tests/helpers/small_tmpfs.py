"""A small file system in memory, in a mount namespace of a process's own and gone with it."""

import shutil
import subprocess
from pathlib import Path

_MOUNT = 'mount -t tmpfs -o size="$0",mode=0700 none "$1" && shift && exec "$@"'


def mounting(folder: Path, *, size: str) -> list[str]:
    """Words before a command that let it see a tmpfs of that size on ``folder``."""
    return ["unshare", "-rm", "sh", "-c", _MOUNT, size, str(folder)]


def can_mount(folder: Path) -> bool:
    """Whether this user may do so."""
    if shutil.which("unshare") is None:
        return False
    return subprocess.run([*mounting(folder, size="64k"), "true"], capture_output=True, check=False).returncode == 0

"""Folders for one user only: what the processes of a fleet share lies in one, and the socket of the bus."""

import os
import stat
from pathlib import Path

HUB_SOCKET = "hub.sock"
_MAX_SOCKET_PATH = 100  # bytes; the kernel takes 107, and the lock file beside it needs some
_SPECIAL = set("#?;=")  # they mean something in the bus's addresses


class PrivateFolderError(Exception):
    """A folder that has to be private is not, or cannot hold a socket."""


def make_private_folder(folder: Path) -> Path:
    """The folder, made if it is not there, for this user only.

    Raises:
        PrivateFolderError: It belongs to someone else, others may enter it, it is a link or no folder, or its path is
            too long for a socket.
    """
    socket = folder.absolute() / HUB_SOCKET
    if len(os.fsencode(socket)) > _MAX_SOCKET_PATH or _SPECIAL & set(str(socket)):
        raise PrivateFolderError(
            f"{socket}: a socket's path has at most {_MAX_SOCKET_PATH} bytes and none of {' '.join(sorted(_SPECIAL))}"
        )
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    check_private_folder(folder)
    return folder


def check_private_folder(folder: Path) -> None:
    """Refuse a folder that others could have tampered with; see :func:`make_private_folder`."""
    try:
        facts = folder.lstat()
    except OSError as error:
        raise PrivateFolderError(f"{folder}: {error.strerror}; is the fleet running?") from error
    if not stat.S_ISDIR(facts.st_mode):
        raise PrivateFolderError(f"{folder}: expected a folder, found something else")
    if facts.st_uid != os.getuid() or facts.st_mode & 0o077:
        raise PrivateFolderError(
            f"{folder}: expected mode 0700 and user {os.getuid()}, "
            f"found mode {stat.S_IMODE(facts.st_mode):04o} and user {facts.st_uid}"
        )
    above = folder.absolute().parent.stat()
    if above.st_uid not in (0, os.getuid()) or (above.st_mode & 0o022 and not above.st_mode & stat.S_ISVTX):
        raise PrivateFolderError(f"{folder.parent}: others may rename what is in it; use a folder of your own")

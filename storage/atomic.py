"""Replacing a file as a whole, so that a crash leaves the old content or the new, never a mixture."""

import os
import secrets
from collections.abc import Iterable
from pathlib import Path

from vtslam.storage.errors import WriteFailed

_TEMPORARY_PATTERN = ".*.tmp"


def replace_file(path: Path, pieces: Iterable[bytes | memoryview]) -> None:
    """Make ``path`` hold the given pieces of bytes, one after another, and make that durable.

    Written to a temporary name in the same folder, synced, renamed, and the folder synced.

    Raises:
        WriteFailed: The operating system refused; ``path`` is as it was, or (folder not synced) already new.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            for piece in pieces:
                file.write(piece)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise WriteFailed(f"{path}: cannot write: {error.strerror or error}") from error
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def sync_folder(folder: Path) -> None:
    """Make the names in ``folder`` durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sweep_temporaries(folder: Path) -> None:
    """Delete what crashed writers left in ``folder``; only for the folder's one writer."""
    for path in folder.glob(_TEMPORARY_PATTERN):
        path.unlink(missing_ok=True)


def is_temporary(path: Path) -> bool:
    """Whether ``path`` is named like an unfinished file."""
    return path.match(_TEMPORARY_PATTERN)

"""Durable writes: a crash leaves the old content or the new, never a mixture. All of storage's own go through here.

The catalogue is written by SQLite, which looks after itself.
"""

import errno
import os
import secrets
from collections.abc import Iterable
from pathlib import Path

from vtslam.storage.errors import DiskFull, WriteFailed

_TEMPORARY_PATTERN = ".*.tmp"
_FULL = (errno.ENOSPC, errno.EDQUOT)


class Disk:
    """The calls of the operating system that change what is on disk; tests put one that fails in its place."""

    def create(self, path: Path) -> int:
        """A descriptor for writing a file that is not there yet."""
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)

    def open_at_end(self, path: Path) -> int:
        """A descriptor for writing at the end of a file, which is made if it is not there."""
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)

    def write(self, descriptor: int, data: bytes | memoryview) -> int:
        """Write at the descriptor's place; how many bytes were taken."""
        return os.write(descriptor, data)

    def truncate(self, descriptor: int, size: int) -> None:
        """Cut a file."""
        os.ftruncate(descriptor, size)

    def sync(self, descriptor: int) -> None:
        """Make a file's bytes durable."""
        os.fsync(descriptor)

    def rename(self, source: Path, target: Path) -> None:
        """Give a file another name, in place of a file of that name."""
        source.replace(target)

    def unlink(self, path: Path) -> None:
        """Delete a file, if it is there."""
        path.unlink(missing_ok=True)

    def sync_folder(self, folder: Path) -> None:
        """Make the names in a folder durable."""
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


DISK = Disk()


def replace_file(path: Path, pieces: Iterable[bytes | memoryview]) -> None:
    """Make ``path`` hold the given pieces of bytes, one after another, and make that durable.

    Written to a temporary name in the same folder, synced, renamed, and the folder synced.

    Raises:
        WriteFailed: The operating system refused; ``path`` is as it was, or (folder not synced) already new.
    """
    temporary = temporary_path(path)
    try:
        descriptor = DISK.create(temporary)
        try:
            for piece in pieces:
                _write_all(descriptor, piece)
            DISK.sync(descriptor)
        finally:
            os.close(descriptor)
        DISK.rename(temporary, path)
        DISK.sync_folder(path.parent)
    except OSError as error:
        DISK.unlink(temporary)
        raise write_failed(path, error) from error
    except BaseException:
        DISK.unlink(temporary)
        raise


def append_to_file(path: Path, data: bytes) -> None:
    """Add ``data`` at the end of ``path``, and make that durable; a crash may leave a part of it.

    Raises:
        WriteFailed: The operating system refused; ``path`` is as long as it was.
    """
    try:
        is_new = not path.exists()
        descriptor = DISK.open_at_end(path)
        try:
            size = os.fstat(descriptor).st_size
            try:
                _write_all(descriptor, data)
                DISK.sync(descriptor)
            except BaseException:
                DISK.truncate(descriptor, size)
                raise
        finally:
            os.close(descriptor)
        if is_new:
            DISK.sync_folder(path.parent)
    except OSError as error:
        raise write_failed(path, error) from error


def rename_file(source: Path, target: Path) -> None:
    """Give a durable file another name, durably, in place of a file of that name; raises WriteFailed."""
    try:
        DISK.rename(source, target)
        for folder in {source.parent, target.parent}:
            DISK.sync_folder(folder)
    except OSError as error:
        raise write_failed(target, error) from error


def remove_files(paths: Iterable[Path]) -> None:
    """Delete files durably, those that are there; raises WriteFailed."""
    folders = set()
    for path in paths:
        try:
            DISK.unlink(path)
        except OSError as error:
            raise write_failed(path, error) from error
        folders.add(path.parent)
    for folder in folders:
        sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """Make the names in ``folder`` durable; raises WriteFailed."""
    try:
        DISK.sync_folder(folder)
    except OSError as error:
        raise write_failed(folder, error) from error


def sweep_temporaries(folder: Path) -> None:
    """Delete what crashed writers left in ``folder``; only for the folder's one writer."""
    for path in folder.glob(_TEMPORARY_PATTERN):
        DISK.unlink(path)


def temporary_path(path: Path) -> Path:
    """A name beside ``path`` that is swept after a crash."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


def is_temporary(path: Path) -> bool:
    """Whether ``path`` is named like an unfinished file."""
    return path.match(_TEMPORARY_PATTERN)


def write_failed(path: Path, error: OSError) -> WriteFailed:
    """The error for a refusal of the operating system."""
    kind = DiskFull if error.errno in _FULL else WriteFailed
    return kind(f"{path}: cannot write: {error.strerror or error}")


def _write_all(descriptor: int, data: bytes | memoryview) -> None:
    rest = memoryview(data).cast("B")
    while rest:
        rest = rest[DISK.write(descriptor, rest) :]

"""How a catalogue's file is opened, also where nobody can write, and SQLite's refusals in words."""

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from vtslam.storage.errors import CatalogError, DiskFull, StorageError, WriteFailed

_WAIT_S = 30.0  # for another process that has the catalogue to itself for a moment


def connected(path: Path, mode: str) -> sqlite3.Connection:
    """A connection in SQLite's mode ``ro``, ``rw`` or ``rwc``; raises sqlite3.Error and CatalogError."""
    uri = f"file:{quote(str(path.resolve()))}?mode={mode}"
    connection = sqlite3.connect(uri, uri=True, timeout=_WAIT_S, isolation_level=None)
    try:
        connection.execute("PRAGMA user_version")
    except sqlite3.OperationalError as error:
        connection.close()
        # The index that readers and a writer share cannot be made on a disk that nobody can write: there nobody writes.
        if mode == "ro" and error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY):
            _require_no_log(path.resolve())
            return sqlite3.connect(f"{uri}&immutable=1", uri=True, isolation_level=None)
        raise
    return connection


def _require_no_log(path: Path) -> None:
    """Refuse a catalogue whose last transactions are in its log, which would be left out without a word."""
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size > 0:
        raise CatalogError(
            f"{log}: expected a catalogue that was closed, found transactions that cannot be taken in where nobody "
            "can write; copy the run to where that can be done"
        )


@contextlib.contextmanager
def translated(path: Path) -> Iterator[None]:
    """SQLite's refusals as those of storage."""
    try:
        yield
    except sqlite3.Error as error:
        raise _error_of(path, error) from error


def _error_of(path: Path, error: sqlite3.Error) -> StorageError:
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code == sqlite3.SQLITE_FULL:
        return DiskFull(f"{path}: cannot write: no space left on the disk")
    if code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM):
        return WriteFailed(f"{path}: cannot write: {error}")
    if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        return CatalogError(f"{path}: expected the catalogue of a run, found a damaged file ({error})")
    return CatalogError(f"{path}: {error}")

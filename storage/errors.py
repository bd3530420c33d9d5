"""Errors of everything on disk; each text names the file, what was expected and what was found."""

from pathlib import Path
from typing import Self


class StorageError(Exception):
    """Something on disk cannot be read or written as it should be."""

    @classmethod
    def differing(cls, path: Path, what: str, *, expected: object, found: object) -> Self:
        """The error for ``what`` in the file ``path`` being ``found`` instead of ``expected``."""
        return cls(f"{path}: {what}: expected {expected}, found {found}")


class UnreadableFile(StorageError):
    """No such file, not a regular file, or the operating system refuses to read it."""


class WriteFailed(StorageError):
    """The operating system refused to write: a full disk, a missing permission."""


class DiskFull(WriteFailed):
    """There is no room, or no more of the user's share; what was stored before is as it was."""


class BadMagic(StorageError):
    """The file is of another kind."""


class UnsupportedVersion(StorageError):
    """The file is of a format version that this program does not know."""


class TruncatedFile(StorageError):
    """The file is shorter or longer than it was written."""


class ChecksumMismatch(StorageError):
    """Bytes of the file are not those that were written."""


class MalformedSection(StorageError):
    """Checksums fit, yet a name, type, size, order, value or range breaks the format."""


class CatalogError(StorageError):
    """The catalogue of a run cannot be read or written, or does not hold what it should."""


class MalformedRecording(StorageError):
    """A recording breaks its format, or lacks what is needed."""


class RunFolderError(StorageError):
    """A run folder cannot be made, opened or understood."""


class RunLocked(RunFolderError):
    """Another process is writing the run."""

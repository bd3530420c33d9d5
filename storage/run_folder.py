"""The folder that a run leaves on disk (RUN): what it was made with, its trajectory, its sections, facts per frame.

::

    RUN/run.toml             effective settings, versions, source
    RUN/trajectory.txt       TUM format
    RUN/frames.jsonl         one JSON object a frame: quality and timing
    RUN/sections/000042.vts  a finished section (docs/format-section.md)
    RUN/lock                 held by the one process that writes the run

Every file is replaced as a whole, so a run that was cut off is still a readable run.
"""

import fcntl
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from vtslam.storage.atomic import is_temporary, replace_file, sweep_temporaries, sync_folder
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.errors import MalformedSection, RunFolderError, RunLocked, WriteFailed
from vtslam.storage.frame_rows import read_rows, write_rows
from vtslam.storage.run_info import RunInfo, read_run_info
from vtslam.storage.section_codecs import SectionCodec
from vtslam.storage.section_file import read_section, repack_section, write_section
from vtslam.storage.section_record import SectionRecord

_INFO, _TRAJECTORY, _FRAMES, _SECTIONS, _LOCK = "run.toml", "trajectory.txt", "frames.jsonl", "sections", "lock"
_DERIVED = ("metrics.json", "report.json")  # made from a run; wrong beside another one
_SECTION_NAME = re.compile(r"(\d{6}|[1-9]\d{6,})\.vts")


class RunFolder:
    """An open run folder; made by :meth:`create` or :meth:`open`, closed by :meth:`close` or ``with``.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path, lock: int | None) -> None:
        self.path = path
        self._lock = lock  # descriptor that holds the lock; None: for reading

    @classmethod
    def create(cls, path: Path, info: RunInfo, *, overwrite: bool = False) -> Self:
        """Make a run folder and open it for writing.

        Args:
            path: A folder that does not exist, is empty, or (with ``overwrite``) holds an earlier run, whose files
                are deleted; other files in it are kept.
            info: Written to ``run.toml``.
            overwrite: Give up an earlier run in ``path``.

        Raises:
            RunFolderError: ``path`` holds something else, or a run and ``overwrite`` is not set.
            RunLocked: Another process is writing there.
            WriteFailed: The operating system refused.
        """
        _refuse_unless_free(path, overwrite)
        try:
            path.mkdir(parents=True, exist_ok=True)
            lock = _take_lock(path)
        except OSError as error:
            raise WriteFailed(f"{path}: cannot make a run folder: {error.strerror}") from error
        run = cls(path, lock)
        try:
            _refuse_unless_free(path, overwrite)  # again: another process may have been here before the lock
            run._clear()
            run.write_info(info)
        except BaseException:
            run.close()
            raise
        return run

    @classmethod
    def open(cls, path: Path, *, writable: bool = False) -> Self:
        """Open a run folder; for writing, take its lock and delete what a crashed writer left half done.

        Raises:
            RunFolderError: There is no run in ``path``.
            RunLocked: Another process is writing it.
            WriteFailed: The operating system refused the lock.
        """
        if not (path / _INFO).is_file():
            raise RunFolderError(f"{path}: not a run folder: expected {path / _INFO}, found none")
        if not writable:
            return cls(path, None)
        run = cls(path, None)
        try:
            run._lock = _take_lock(path)
            sweep_temporaries(path)
            sweep_temporaries(path / _SECTIONS)
        except OSError as error:
            run.close()
            raise WriteFailed(f"{path}: cannot open for writing: {error.strerror}") from error
        return run

    def close(self) -> None:
        """Give the lock back; reading stays possible."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    # --- facts of the run -------------------------------------------------------------------------------------------

    def read_info(self) -> RunInfo:
        """What the run was made with; raises RunFolderError."""
        return read_run_info(self.path / _INFO)

    def write_info(self, info: RunInfo) -> None:
        """Replace what the run was made with, as when it is finished."""
        self._require_writable()
        replace_file(self.path / _INFO, [info.as_toml().encode()])

    @property
    def trajectory_path(self) -> Path:
        """Where the trajectory is, or will be."""
        return self.path / _TRAJECTORY

    def write_frames(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Replace the facts per frame; see :func:`vtslam.storage.frame_rows.write_rows`."""
        self._require_writable()
        write_rows(self.path / _FRAMES, rows)

    def read_frames(self) -> list[dict[str, Any]]:
        """The facts per frame; raises RunFolderError."""
        return read_rows(self.path / _FRAMES)

    # --- sections ---------------------------------------------------------------------------------------------------

    def section_path(self, section_id: int) -> Path:
        """Where a section is, or will be."""
        return self.path / _SECTIONS / f"{section_id:06d}.vts"

    def section_ids(self) -> list[int]:
        """Ids of the sections on disk, in order."""
        names = (_SECTION_NAME.fullmatch(path.name) for path in (self.path / _SECTIONS).glob("*.vts"))
        return sorted(int(name[1]) for name in names if name)

    def write_section(self, record: SectionRecord) -> Path:
        """Write a finished section, durable and verified; where it is.

        Raises:
            RunFolderError: The section is already there; a finished section never changes.
            StorageError: See :func:`vtslam.storage.section_file.write_section`.
        """
        self._require_writable()
        path = self.section_path(record.section_id)
        if path.exists():
            raise RunFolderError(f"{path}: section {record.section_id} is already written; it never changes")
        write_section(path, record)
        return path

    def read_section(self, section_id: int) -> SectionRecord:
        """A section from disk, every byte checked; raises StorageError."""
        path = self.section_path(section_id)
        record = read_section(path)
        if record.section_id != section_id:
            raise MalformedSection.differing(path, "section_id", expected=section_id, found=record.section_id)
        return record

    def repack_sections(self, codec: SectionCodec, grid: DenseGrid | None = None) -> None:
        """Bring every section's file into ``codec``, one after another, each replaced as a whole.

        Args:
            codec: The codec; files that have it stay as they are.
            grid: What ``dense`` rounds to; None for the usual grid.

        Raises:
            StorageError: A section cannot be read or written; it and those after it are as they were.
        """
        self._require_writable()
        for section_id in self.section_ids():
            repack_section(self.section_path(section_id), codec, grid)

    def _require_writable(self) -> None:
        if self._lock is None:
            raise RunFolderError(f"{self.path}: open for reading only")

    def _clear(self) -> None:
        """Delete an earlier run's files; ``run.toml`` stays until it is replaced, as the mark of a run folder."""
        sections = self.path / _SECTIONS
        try:
            sections.mkdir(exist_ok=True)
            sweep_temporaries(self.path)
            sweep_temporaries(sections)
            for section_id in self.section_ids():
                self.section_path(section_id).unlink()
            for name in (_TRAJECTORY, _FRAMES, *_DERIVED):
                (self.path / name).unlink(missing_ok=True)
            sync_folder(sections)
            sync_folder(self.path)
        except OSError as error:
            raise WriteFailed(f"{self.path}: cannot clear the folder: {error.strerror}") from error


def _refuse_unless_free(path: Path, overwrite: bool) -> None:
    """Raise RunFolderError unless a new run may be made in ``path``."""
    if not path.exists():
        return
    if not path.is_dir():
        raise RunFolderError(f"{path}: expected a folder or nothing, found a file")
    if (path / _INFO).is_file():
        if not overwrite:
            raise RunFolderError(f"{path}: there is already a run here; choose another folder or ask to overwrite it")
    elif not all(_is_own_leftover(entry) for entry in path.iterdir()):
        raise RunFolderError(f"{path}: not empty and not a run folder; choose another folder")


def _is_own_leftover(entry: Path) -> bool:
    """Whether an entry of a folder without ``run.toml`` is what a crash while making a run leaves."""
    if entry.name == _SECTIONS and entry.is_dir():
        return all(is_temporary(inner) for inner in entry.iterdir())
    return entry.name == _LOCK or is_temporary(entry)


def _take_lock(path: Path) -> int:
    """A descriptor that holds the folder's lock until it is closed, also by the end of the process."""
    lock = os.open(path / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        holder = os.pread(lock, 32, 0).decode("ascii", "replace").strip() or "unknown"
        os.close(lock)
        raise RunLocked(f"{path}: another process is writing this run (process {holder})") from error
    except BaseException:
        os.close(lock)
        raise
    os.ftruncate(lock, 0)
    os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
    return lock

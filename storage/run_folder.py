"""The folder that a run leaves on disk (RUN): what it was made with, its catalogue, its sections, its trajectory.

::

    RUN/run.toml             effective settings, versions, source
    RUN/catalog.sqlite       what is durable: sections, frames, poses, candidate views, events (docs/format-run.md)
    RUN/sections/000042.vts  a finished section (docs/format-section.md)
    RUN/trajectory.txt       TUM format; made from the catalogue, longer with each section
    RUN/packed/              sections packed ahead of the run's end, as long as the run lasts
    RUN/damaged/             files that were set aside
    RUN/lock                 held by the one process that writes the run

A section is durable once the catalogue names it, which happens after its file is on disk and verified. So a run that
was cut off, also by a power cut, is still a readable run.
"""

import fcntl
import os
import re
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from vtslam.common import failpoints
from vtslam.common.trajectory_io import trajectory_text
from vtslam.storage.atomic import (
    append_to_file,
    is_temporary,
    remove_files,
    replace_file,
    sweep_temporaries,
    sync_folder,
    write_failed,
)
from vtslam.storage.catalog import Catalog
from vtslam.storage.catalog_rows import FrameRow, SectionRow
from vtslam.storage.errors import MalformedSection, RunFolderError, RunLocked
from vtslam.storage.run_info import RunInfo, read_run_info
from vtslam.storage.section_codecs import SectionCodec
from vtslam.storage.section_facts import file_facts
from vtslam.storage.section_file import read_columns, read_section, write_section
from vtslam.storage.section_record import SectionRecord

_INFO, _CATALOG, _TRAJECTORY, _SECTIONS, _LOCK = "run.toml", "catalog.sqlite", "trajectory.txt", "sections", "lock"
_PACKED = "packed"
WRITTEN_CODEC: SectionCodec = "lossless"  # of sections as a run writes them
_CATALOG_FILES = (_CATALOG, f"{_CATALOG}-wal", f"{_CATALOG}-shm")
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
        self._catalog: Catalog | None = None

    @classmethod
    def create(cls, path: Path, info: RunInfo, *, overwrite: bool = False, used: Sequence[str] = ()) -> Self:
        """Make a run folder and open it for writing.

        Args:
            path: A folder that does not exist, is empty, or (with ``overwrite``) holds an earlier run, whose files
                are deleted; other files in it are kept.
            info: Written to ``run.toml``.
            overwrite: Give up an earlier run in ``path``.
            used: Files that the new run reads; texts that name no file do no harm.

        Raises:
            RunFolderError: ``path`` holds something else, or a run and ``overwrite`` is not set, or one whose
                trajectory is used.
            RunLocked: Another process is writing there.
            WriteFailed: The operating system refused.
        """
        _refuse_unless_free(path, overwrite)
        _refuse_if_used(path / _TRAJECTORY, used)
        try:
            path.mkdir(parents=True, exist_ok=True)
            lock = _take_lock(path)
        except OSError as error:
            raise write_failed(path, error) from error
        run = cls(path, lock)
        try:
            _refuse_unless_free(path, overwrite)  # again: another process may have been here before the lock
            run._clear()
            run._catalog = Catalog.create(path / _CATALOG)
            sync_folder(path)
            run.write_info(info)
        except BaseException:
            run.close()
            raise
        return run

    @classmethod
    def open(cls, path: Path, *, writable: bool = False, lock: int | None = None) -> Self:
        """Open a run folder; for writing, take its lock and delete what a crashed writer left half done.

        Args:
            path: The folder.
            writable: Whether for writing.
            lock: :attr:`lock` of another process that holds the folder for this one to write, handed down to it.

        Raises:
            RunFolderError: There is no run in ``path``.
            RunLocked: Another process is writing it.
            WriteFailed: The operating system refused the lock.
            StorageError: For writing: the catalogue cannot be opened; see `Catalog.open`.
        """
        if not (path / _INFO).is_file():
            raise RunFolderError(f"{path}: not a run folder: expected {path / _INFO}, found none")
        run = cls(path, None)
        if not writable:
            return run
        try:
            run._lock = _take_lock(path) if lock is None else lock
            run._catalog = Catalog.open(path / _CATALOG, writable=True)
            for folder in (path, path / _SECTIONS, path / _PACKED):
                sweep_temporaries(folder)
        except OSError as error:
            run.close()
            raise write_failed(path, error) from error
        except BaseException:
            run.close()
            raise
        return run

    def close(self) -> None:
        """Give the catalogue and the lock back; reading stays possible."""
        if self._catalog is not None:
            self._catalog.close()
            self._catalog = None
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def lock(self) -> int | None:
        """The descriptor that holds the lock; the lock lasts until all processes that have it have closed it."""
        return self._lock

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
    def catalog(self) -> Catalog:
        """The catalogue, opened when it is asked for; raises as `Catalog.open`."""
        if self._catalog is None:
            self._catalog = Catalog.open(self.path / _CATALOG)
        return self._catalog

    @property
    def trajectory_path(self) -> Path:
        """Where the trajectory is, or will be."""
        return self.path / _TRAJECTORY

    def write_trajectory(self) -> None:
        """Make the trajectory anew from the catalogue, if it is not what it should be."""
        self._require_writable()
        times_ns, poses = self.catalog.poses()
        text = trajectory_text(times_ns.tolist(), poses).encode("ascii")
        if not self.trajectory_path.is_file() or self.trajectory_path.read_bytes() != text:
            replace_file(self.trajectory_path, [text])

    def read_frames(self) -> list[dict[str, Any]]:
        """The facts per frame; raises StorageError."""
        return [dict(frame.facts) for frame in self.catalog.frames()]

    def remove_derived(self) -> None:
        """Delete figures that were made of the run, because it goes on."""
        self._require_writable()
        remove_files(self.path / name for name in _DERIVED)

    # --- sections ---------------------------------------------------------------------------------------------------

    def section_path(self, section_id: int) -> Path:
        """Where a section is, or will be."""
        return self.path / _SECTIONS / f"{section_id:06d}.vts"

    def packed_path(self, section_id: int) -> Path:
        """Where a section is, or will be, packed ahead of the run's end."""
        return self.path / _PACKED / f"{section_id:06d}.vts"

    def section_ids(self) -> list[int]:
        """Ids of the sections on disk, in order."""
        return _section_ids(self.path / _SECTIONS)

    def write_section(self, record: SectionRecord) -> Path:
        """Write a finished section, durable and verified; where it is. It counts once it is in the catalogue.

        Raises:
            RunFolderError: The section is already there; a finished section never changes.
            StorageError: See :func:`vtslam.storage.section_file.write_section`.
        """
        self._require_writable()
        path = self.section_path(record.section_id)
        if path.exists():
            raise RunFolderError(f"{path}: section {record.section_id} is already written; it never changes")
        failpoints.reach("run.section.before_write")
        write_section(path, record, WRITTEN_CODEC)
        failpoints.reach("run.section.after_write")
        return path

    def commit_section(
        self,
        record: SectionRecord,
        frames: Sequence[FrameRow],
        *,
        resume: bytes | None = None,
        codec: SectionCodec = WRITTEN_CODEC,
    ) -> None:
        """Enter a written section in the catalogue, from when on it counts, and lengthen the trajectory.

        Args:
            record: The section that was written.
            frames: All its frames, in order.
            resume: What a run goes on from after it.
            codec: Of its file.

        Raises:
            StorageError: It cannot be written; if that is the trajectory, the section counts nevertheless.
        """
        self._require_writable()
        file = file_facts(self.section_path(record.section_id))
        row = SectionRow(
            section_id=record.section_id,
            first_frame_id=int(record.frame_ids[0]),
            num_frames=record.num_frames,
            num_gaussians=record.num_gaussians,
            camera=record.camera,
            depth_scale_m=record.depth_scale_m,
            num_bytes=file.num_bytes,
            sha256=file.sha256,
            codec=codec,
        )
        self.catalog.add_section(record, row, frames, resume=resume)
        failpoints.reach("run.section.after_catalog")
        self._lengthen_trajectory(frames)
        failpoints.reach("run.section.after_trajectory")

    def add_loose_frames(self, section_id: int, frames: Sequence[FrameRow]) -> None:
        """Keep the poses and facts of frames whose section will never be on disk; raises StorageError."""
        self._require_writable()
        self.catalog.add_loose_frames(section_id, frames)
        self._lengthen_trajectory(frames)

    def remove_packed(self) -> None:
        """Delete what was packed ahead, which has no use once the run has ended."""
        self._require_writable()
        remove_files([self.packed_path(each) for each in self._packed_ids()])
        try:
            if (self.path / _PACKED).is_dir():
                (self.path / _PACKED).rmdir()
        except OSError as error:
            raise write_failed(self.path / _PACKED, error) from error

    def _lengthen_trajectory(self, frames: Sequence[FrameRow]) -> None:
        times_ns, poses = [frame.capture_time_ns for frame in frames], [frame.T_world_camera for frame in frames]
        append_to_file(self.trajectory_path, trajectory_text(times_ns, np.stack(poses)).encode("ascii"))

    def drop_sections(self, first_section_id: int) -> None:
        """Forget a section and all later ones, and delete their files and those that the catalogue does not name."""
        self._require_writable()
        self.catalog.drop_from(first_section_id)
        remove_files(self.section_path(each) for each in self.section_ids() if each >= first_section_id)
        remove_files(self.packed_path(each) for each in self._packed_ids() if each >= first_section_id)
        self.write_trajectory()

    def read_section(self, section_id: int) -> SectionRecord:
        """A section from disk, every byte checked; raises StorageError."""
        path = self.section_path(section_id)
        record = read_section(path)
        if record.section_id != section_id:
            raise MalformedSection.differing(path, "section_id", expected=section_id, found=record.section_id)
        return record

    def read_views(self, section_id: int) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
        """Rows [V] of the frames that a section keeps the depth of, and that depth [V,H,W]; raises StorageError."""
        _, columns = read_columns(self.section_path(section_id), ["view_index", "view_depth"])
        return columns["view_index"], columns["view_depth"]

    def _packed_ids(self) -> list[int]:
        return _section_ids(self.path / _PACKED)

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
            for section_id in self._packed_ids():
                self.packed_path(section_id).unlink()
            for name in (_TRAJECTORY, *_CATALOG_FILES, *_DERIVED):
                (self.path / name).unlink(missing_ok=True)
            sync_folder(sections)
            sync_folder(self.path)
        except OSError as error:
            raise write_failed(self.path, error) from error


def _section_ids(folder: Path) -> list[int]:
    names = (_SECTION_NAME.fullmatch(path.name) for path in folder.glob("*.vts"))
    return sorted(int(name[1]) for name in names if name)


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


def _refuse_if_used(trajectory: Path, used: Sequence[str]) -> None:
    """Raise RunFolderError if a file that would be given up is read meanwhile."""
    if trajectory.is_file() and any(os.path.exists(each) and trajectory.samefile(each) for each in used):
        raise RunFolderError(f"{trajectory}: expected a run that nobody reads, found poses of the new one")


def _is_own_leftover(entry: Path) -> bool:
    """Whether an entry of a folder without ``run.toml`` is what a crash while making a run leaves."""
    if entry.name == _SECTIONS and entry.is_dir():
        return all(is_temporary(inner) for inner in entry.iterdir())
    return entry.name in (_LOCK, *_CATALOG_FILES) or is_temporary(entry)


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

"""The map store: the active section and the sealed ones that are in memory, within a budget (docs/protocol-shm.md)."""

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from vtslam.common import failpoints
from vtslam.common.frame import Frame
from vtslam.common.section import Section
from vtslam.common.shm.active_reader import ActiveReader, PinnedActive
from vtslam.common.shm.active_writer import ActiveWriter, make_active_block
from vtslam.common.shm.blocks import used_bytes
from vtslam.common.shm.errors import (
    MapStoreFull,
    SectionNotResident,
    SectionPinned,
    SharedMemoryError,
)
from vtslam.common.shm.process_identity import is_alive, own_identity
from vtslam.common.shm.records import ActiveSpec, LastCommit
from vtslam.common.shm.sealed_block import (
    PinnedSealed,
    read_sealed,
    read_tail,
    sealed_pin_holders,
    write_sealed,
    write_tail,
)

_NAME = re.compile(r"(active|sealed|tail)-(\d+)")
_LEFTOVER = re.compile(r"\.(?:new|old)-([0-9a-f]+)-.+")


@dataclass(frozen=True, slots=True, kw_only=True)
class Resident:
    """A sealed section in memory.

    Attributes:
        section_id: The section.
        num_bytes: What it takes.
        last_used_ns: When it was sealed or pinned last, by the system's clock.
        pinned_by: Pids of living processes that have it pinned.
    """

    section_id: int
    num_bytes: int
    last_used_ns: int
    pinned_by: tuple[int, ...]


class MapStore:
    """The map store in a folder; every process of the fleet makes one of its own.

    Args:
        folder: Made (mode 0700) if it does not exist; its parent must.
        budget_bytes: For all blocks together. The same in all processes that write.
        pins: Readers of a block at a time, at most 24.
    """

    def __init__(self, folder: Path, *, budget_bytes: int, pins: int = 8) -> None:
        folder.mkdir(mode=0o700, exist_ok=True)
        self._folder, self.budget_bytes, self._pins = folder, budget_bytes, pins
        self._sealed_bytes: dict[int, int] = {}  # by section, as they were seen; they never change

    # --- what is there ----------------------------------------------------------------------------------------------

    def used_bytes(self) -> int:
        """Bytes reserved by all blocks."""
        total = sum(self.sealed_bytes().values())
        # Texts, no Paths: this is asked many times a second. pathlib enters each part in the interpreter's table of
        # texts, and a table that so many were entered in and removed from is at some time made anew, megabytes larger.
        for folder, _, names in os.walk(self._folder):
            total += sum(used_bytes(f"{folder}/{name}") for name in names if not name.startswith("sealed-"))
        return total

    def sealed_bytes(self) -> dict[int, int]:
        """Bytes of each sealed section in memory, in order."""
        known = self._sealed_bytes
        self._sealed_bytes = {
            section_id: known.get(section_id) or used_bytes(self._path("sealed", section_id))
            for section_id in self.sealed_ids()
        }
        return self._sealed_bytes

    def free_bytes(self) -> int:
        """Bytes that can be reserved: the rest of the budget, or of the file system if that has less."""
        return min(self.budget_bytes - self.used_bytes(), shutil.disk_usage(self._folder).free)

    def active_id(self) -> int | None:
        """The section being mapped, if any."""
        sealed = set(self._ids("sealed"))
        ids = [section_id for section_id in self._ids("active") if section_id not in sealed]
        return ids[-1] if ids else None

    def sealed_ids(self) -> list[int]:
        """The sealed sections in memory, in order."""
        return self._ids("sealed")

    def residents(self) -> list[Resident]:
        """The sealed sections in memory, with what decides whether they may leave."""
        found = []
        for section_id, num_bytes in self.sealed_bytes().items():
            path = self._path("sealed", section_id)
            with contextlib.suppress(FileNotFoundError):
                found.append(
                    Resident(
                        section_id=section_id,
                        num_bytes=num_bytes,
                        last_used_ns=path.stat().st_mtime_ns,
                        pinned_by=tuple(sealed_pin_holders(path)),
                    )
                )
        return found

    def last_commit(self) -> LastCommit | None:
        """What was committed last, by whichever process; None if nothing was."""
        for _ in range(100):  # blocks come and go while this looks
            with contextlib.suppress(SectionNotResident):
                return self._last_commit()
        raise SharedMemoryError(f"{self._folder}: the last commit could not be read, its block kept changing")

    # --- reading ----------------------------------------------------------------------------------------------------

    def pinned_sealed(self, section_id: int, *, verify: bool = False) -> PinnedSealed:
        """A sealed section in place; raises SectionNotResident, NoFreePin, DamagedBlock."""
        return PinnedSealed(self._path("sealed", section_id), verify=verify)

    def pinned_active(self, section_id: int, generation: int | None = None) -> PinnedActive:
        """A commit of the active section in place, the last one if ``generation`` is None.

        Raises:
            SectionNotResident, GenerationGone, NoFreePin, DamagedBlock: See `ActiveReader`.
        """
        return self.active_reader(section_id).pinned(generation)

    def active_reader(self, section_id: int) -> ActiveReader:
        """The active section, mapped once for many pins; raises SectionNotResident, DamagedBlock."""
        return ActiveReader(self._path("active", section_id))

    def copied_sealed(self, section_id: int) -> Section:
        """A copy of a sealed section, for readers that nobody shall wait for; raises as `read_sealed`."""
        return read_sealed(self._path("sealed", section_id))

    def last_sealed_commit(self) -> LastCommit | None:
        """What was committed last to a sealed section, without a look at the active one; None if nothing was.

        Raises:
            SectionNotResident: It was replaced at this moment.
            DamagedBlock: See `read_tail`.
        """
        tails = self._ids("tail")
        return read_tail(self._path("tail", tails[-1])) if tails else None

    # --- writing ----------------------------------------------------------------------------------------------------

    def create_active(self, spec: ActiveSpec) -> ActiveWriter:
        """Begin a section.

        Raises:
            SharedMemoryError: There is an active section, or this one is already sealed.
            MapStoreFull, SharedMemoryFull: No memory.
        """
        if self._ids("active") or spec.section_id in self.sealed_ids():
            raise SharedMemoryError(
                f"{self._folder}: expected no active section and no sealed section {spec.section_id}, "
                f"found active {self._ids('active')}, sealed {self.sealed_ids()}"
            )
        folder = self._path("active", spec.section_id)
        new = self._temporary("new", folder)
        with self._removed_on_failure(new):
            make_active_block(new, replace(spec, pins=self._pins), self._admit)
            failpoints.reach("shm.active.before_rename")
            new.rename(folder)
        failpoints.reach("shm.active.after_rename")
        return ActiveWriter(folder, self._admit, take_over=False)

    def adopt_active(self) -> ActiveWriter | None:
        """Go on with the active section of a writer that died; None if there is none. Removes what it left half done.

        Raises:
            WriterAlive: It did not die.
            DamagedBlock: The block is not what it should be.
        """
        self.remove_leftovers()
        section_id = self.active_id()
        if section_id is None:
            return None
        return ActiveWriter(self._path("active", section_id), self._admit, take_over=True)

    def seal(self, writer: ActiveWriter, section: Section, facts: bytes) -> None:
        """End the active section: from now on it is ``section``, immutable, with ``facts`` as the last commit's.

        Raises:
            ValueError: It is another section than the writer's, or has no frames.
            MapStoreFull, SharedMemoryFull: No memory; the section stays active, and this can be tried again.
        """
        if section.section_id != writer.section_id or writer.num_frames != len(section.frames) or not section.frames:
            raise ValueError(f"{self._folder}: section {section.section_id} is not what was committed last")
        row, last = len(section.frames) - 1, writer.last_frame()
        writer.drop_spares()
        failpoints.reach("shm.seal.before_write")
        sealed, tail = self._path("sealed", section.section_id), self._path("tail", section.section_id)
        new_sealed, new_tail = self._temporary("new", sealed), self._temporary("new", tail)
        with self._removed_on_failure(new_sealed), self._removed_on_failure(new_tail):
            write_sealed(new_sealed, section, self._admit, pins=self._pins)
            write_tail(new_tail, section.section_id, row, last, facts, self._admit)
            failpoints.reach("shm.seal.after_write")
            new_tail.rename(tail)
            failpoints.reach("shm.seal.after_tail")
            writer.require_current()
            new_sealed.rename(sealed)
        failpoints.reach("shm.seal.after_rename")
        writer.close()
        self._remove(self._path("active", section.section_id))
        failpoints.reach("shm.seal.after_remove")
        self._remove_old_tails()

    def put_sealed(self, section: Section) -> None:
        """Bring a sealed section into memory, as from disk.

        Raises:
            SharedMemoryError: It is already there.
            MapStoreFull, SharedMemoryFull: No memory.
        """
        path = self._path("sealed", section.section_id)
        new = self._temporary("new", path)
        with self._removed_on_failure(new):
            write_sealed(new, section, self._admit, pins=self._pins)
            failpoints.reach("shm.put.after_write")
            try:
                os.link(new, path)  # unlike renaming, this never replaces what is there
            except FileExistsError as error:
                raise SharedMemoryError(f"{path}: a sealed section never changes, and this one is there") from error
            failpoints.reach("shm.put.after_link")
            new.unlink()

    def restore(self, section: Section, last: Frame, facts: bytes) -> None:
        """Begin an empty store with a section from disk, as if it had been sealed here.

        Args:
            section: The section.
            last: The frame of its last row.
            facts: What was committed with it.

        Raises:
            MapStoreFull, SharedMemoryFull: No memory.
        """
        row, tail = len(section.frames) - 1, self._path("tail", section.section_id)
        with self._removed_on_failure(tail):
            write_tail(tail, section.section_id, row, last, facts, self._admit)
            self.put_sealed(section)

    def unlink_sealed(self, section_id: int, *, verified_on_disk: bool) -> None:
        """Let a sealed section leave memory; nothing happens if it is not there.

        Raises:
            SharedMemoryError: It is not verified on disk.
            SectionPinned: A living process has it pinned.
        """
        path = self._path("sealed", section_id)
        if not verified_on_disk:
            raise SharedMemoryError(f"{path}: its file was not verified, so this is the only copy")
        if self._path("active", section_id).exists():
            # Left by a crash in the middle of sealing; without the sealed block it would count as active again.
            raise SectionPinned(f"{path}: its active block has to be removed first")
        if holders := sealed_pin_holders(path):
            raise SectionPinned(f"{path}: pinned by processes {holders}")
        path.unlink(missing_ok=True)

    def remove_leftovers(self) -> None:
        """For the mapper: :meth:`remove_unfinished`, active blocks of sealed sections, and old tails."""
        self.remove_unfinished()
        for section_id in set(self._ids("active")) & set(self._ids("sealed")):
            self._remove(self._path("active", section_id))
        self._remove_old_tails()

    def remove_unfinished(self) -> None:
        """Remove what dead processes left half made or half deleted; for any process at any time."""
        for name in os.listdir(self._folder):
            leftover = _LEFTOVER.fullmatch(name)
            if leftover and not is_alive(int(leftover[1], 16)):
                _delete(self._folder / name)

    # --- parts ------------------------------------------------------------------------------------------------------

    def _last_commit(self) -> LastCommit | None:
        section_id = self.active_id()
        if section_id is not None and (reader := self.active_reader(section_id)).generation:
            held = reader.pinned()
            try:
                state = held.state
                last = state.frames[-1]
                frame = replace(last, rgb=last.rgb.copy(), depth=last.depth.copy())
                row = len(state.frames) - 1
                return LastCommit(
                    section_id=section_id, frame_index=row, frame=frame, facts=state.facts, is_sealed=False
                )
            finally:
                held.release()
        sealed_tails = [tail for tail in self._ids("tail") if tail != section_id]
        return read_tail(self._path("tail", sealed_tails[-1])) if sealed_tails else None

    def _admit(self, place: str, wanted_bytes: int) -> None:
        used = self.used_bytes()
        if used + wanted_bytes > self.budget_bytes:
            raise MapStoreFull(place, wanted_bytes=wanted_bytes, used_bytes=used, budget_bytes=self.budget_bytes)

    def _ids(self, kind: str) -> list[int]:
        names = (_NAME.fullmatch(name) for name in os.listdir(self._folder))
        return sorted(int(name[2]) for name in names if name and name[1] == kind)

    def _path(self, kind: str, section_id: int) -> Path:
        return self._folder / f"{kind}-{section_id:06d}"

    def _temporary(self, what: str, path: Path) -> Path:
        return path.with_name(f".{what}-{own_identity():x}-{path.name}")

    @contextlib.contextmanager
    def _removed_on_failure(self, path: Path) -> Iterator[None]:
        _delete(path)  # this process's own, of an attempt that failed
        try:
            yield
        except BaseException:
            _delete(path)
            raise

    def _remove(self, path: Path) -> None:
        """Delete a block, out of sight first."""
        old = self._temporary("old", path)
        with contextlib.suppress(FileNotFoundError):  # somebody else was removing it
            path.rename(old)
        failpoints.reach("shm.remove.after_rename")
        _delete(old)
        failpoints.reach("shm.remove.after_files")

    def _remove_old_tails(self) -> None:
        for section_id in self._ids("tail")[:-1]:
            self._path("tail", section_id).unlink(missing_ok=True)


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)

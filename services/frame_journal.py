"""The committed frames of a fleet, one line each, beside the map store: what the run folder is made from.

Lines of a section are in a file of its own, which goes when the section is durable. The line of a frame is written
after its commit, and again after a restart, so that at most that one is ever missing. A later line of the same frame
replaces an earlier one; the line that ends a section also says what a run goes on from.
"""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vtslam.common.shm.blocks import refusal_of
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.frame_facts import CommittedFrame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JournalLine:
    """A committed frame; with ``ended``, all that was committed, if its section ended with it."""

    frame: CommittedFrame
    ended: CommitFacts | None


class JournalWriter:
    """Appends frames.

    Args:
        folder: Made if it is not there; what a killed writer left of its last line is cut off.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(mode=0o700, exist_ok=True)
        self._folder = folder
        self._file: tuple[int, int] | None = None  # section and descriptor

    def append(self, facts: CommitFacts, *, section_ended: bool) -> None:
        """Write a frame's line; raises SharedMemoryFull with nothing written."""
        plain = facts.frame.as_plain()
        if section_ended:
            plain["ended"] = facts.packed().decode()
        data = json.dumps(plain).encode() + b"\n"
        section_id = facts.frame.facts.section_id
        descriptor = self._descriptor(section_id)
        start, written = os.lseek(descriptor, 0, os.SEEK_CUR), 0
        try:
            while written < len(data):
                written += os.write(descriptor, data[written:])
        except OSError as error:
            os.ftruncate(descriptor, start)
            os.lseek(descriptor, start, os.SEEK_SET)
            raise refusal_of(self._folder / _name(section_id), error, len(data)) from error

    def close(self) -> None:
        """Give the descriptor back."""
        if self._file is not None:
            os.close(self._file[1])
            self._file = None

    def _descriptor(self, section_id: int) -> int:
        if self._file is None or self._file[0] != section_id:
            self.close()
            self._file = section_id, _open_at_last_line(self._folder / _name(section_id))
        return self._file[1]


class JournalReader:
    """Reads frames as they come; the folder need not be there yet.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._section_id, self._offset = folder, 0, 0

    def new_lines(self) -> Iterator[JournalLine]:
        """The whole lines that were not read before, in order.

        Raises:
            ValueError, KeyError, TypeError: A line is damaged; it and those behind it count as not read.
        """
        # Seen before this section's file is read, so that it is complete if a later one is there.
        while (last := self._last_section()) is not None and last >= self._section_id:
            yield from self._new_lines_here()
            if last == self._section_id:
                break
            self._section_id, self._offset = self._section_id + 1, 0

    def forget_before(self, section_id: int) -> None:
        """Delete the lines of sections before this one, which are durable."""
        for found in self._sections():
            if found < section_id:
                (self._folder / _name(found)).unlink(missing_ok=True)
        self.skip_before(section_id)

    def skip_before(self, section_id: int) -> None:
        """Leave out the lines of sections before this one."""
        if section_id > self._section_id:
            self._section_id, self._offset = section_id, 0

    def _sections(self) -> list[int]:
        try:
            return sorted(map(int, os.listdir(self._folder)))  # asked often: see `MapStore.used_bytes`
        except FileNotFoundError:
            return []

    def _last_section(self) -> int | None:
        return max(self._sections(), default=None)

    def _new_lines_here(self) -> Iterator[JournalLine]:
        try:
            with open(f"{self._folder}/{_name(self._section_id)}", "rb") as file:  # often too
                file.seek(self._offset)
                data = file.read()
        except FileNotFoundError:
            return
        for line in data.split(b"\n")[:-1]:
            found = _line_of(line)
            self._offset += len(line) + 1
            yield found


def _name(section_id: int) -> str:
    return f"{section_id:06d}"


def _open_at_last_line(path: Path) -> int:
    """A descriptor for appending; what is left of a line is cut off."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    whole = path.read_bytes().rfind(b"\n") + 1
    os.ftruncate(descriptor, whole)
    os.lseek(descriptor, whole, os.SEEK_SET)
    return descriptor


def _line_of(line: bytes) -> JournalLine:
    plain = json.loads(line)
    ended = plain.pop("ended", None)
    return JournalLine(
        frame=CommittedFrame.from_plain(plain),
        ended=None if ended is None else CommitFacts.unpacked(ended.encode()),
    )

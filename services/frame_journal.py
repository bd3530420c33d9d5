"""The committed frames of a fleet, one line each, beside the map store: what the run folder is made from.

The line of a frame is written after its commit, and again after a restart, so that at most that one is ever missing.
A later line of the same frame replaces an earlier one.
"""

import json
import os
from pathlib import Path

from vtslam.common.shm.blocks import refusal_of
from vtslam.services.frame_facts import CommittedFrame


class JournalWriter:
    """Appends frames.

    Args:
        path: The file; what a killed writer left of its last line is cut off.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        data = path.read_bytes()
        whole = data.rfind(b"\n") + 1
        os.ftruncate(self._fd, whole)
        os.lseek(self._fd, whole, os.SEEK_SET)

    def append(self, frame: CommittedFrame) -> None:
        """Write a frame's line; raises SharedMemoryFull with nothing written."""
        data = json.dumps(frame.as_plain()).encode() + b"\n"
        start, written = os.lseek(self._fd, 0, os.SEEK_CUR), 0
        try:
            while written < len(data):
                written += os.write(self._fd, data[written:])
        except OSError as error:
            os.ftruncate(self._fd, start)
            os.lseek(self._fd, start, os.SEEK_SET)
            raise refusal_of(self._path, error, len(data)) from error

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._fd)


class JournalReader:
    """Reads frames as they come; the file need not be there yet.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._offset = path, 0

    def new_frames(self) -> list[CommittedFrame]:
        """The frames of whole lines that were not read before."""
        try:
            with open(self._path, "rb") as file:
                file.seek(self._offset)
                data = file.read()
        except FileNotFoundError:
            return []
        whole = data.rfind(b"\n") + 1
        self._offset += whole
        return [CommittedFrame.from_plain(json.loads(line)) for line in data[:whole].splitlines()]

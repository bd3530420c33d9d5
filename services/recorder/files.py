"""Recordings as the settings ask for them."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from itertools import count, islice, takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from vtslam.common.settings import RecorderSettings
from vtslam.storage.atomic import remove_files
from vtslam.storage.errors import WriteFailed

if TYPE_CHECKING:
    from vtslam.storage.recording.writer import RecordingWriter


def check_way(settings: RecorderSettings, *, overwrite: bool, used: Sequence[str] = ()) -> None:
    """Refuse a recording that cannot be made, before anything is started; nothing is removed.

    Args:
        settings: What to record, and where.
        overwrite: Whether an earlier recording may be given up.
        used: Files that are read meanwhile, or written by somebody else; texts that name no file do no harm.

    Raises:
        WriteFailed: There is one and it is not to be given up, or it is used, or the folder is not there.
    """
    if not settings.file:
        return
    path = Path(settings.file)
    if not path.parent.is_dir():
        raise WriteFailed(f"{path}: expected a folder for the recording, found none")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise WriteFailed(f"{path}: expected a folder that can be written, found one that cannot")
    for part in _parts(path):
        if not part.is_file():
            raise WriteFailed(f"{part}: expected a file to record in, found no regular file")
        if any(os.path.exists(each) and part.samefile(each) for each in used):
            raise WriteFailed(f"{part}: expected a file that nobody uses, found one that is read or written meanwhile")
        if not overwrite:
            raise WriteFailed(f"{part}: expected no recording yet, found a file (--overwrite gives it up)")


def make_way(settings: RecorderSettings, *, overwrite: bool) -> None:
    """Remove an earlier recording with all its parts, once nothing can be refused any more; see :func:`check_way`.

    Raises:
        WriteFailed: The operating system refused.
    """
    if settings.file and overwrite:
        remove_files(list(_parts(Path(settings.file))))


def open_recording(settings: RecorderSettings, *, family: str) -> "RecordingWriter":
    """A new recording; where one is (its recorder died, or the run is resumed) another part of it, ``-2`` in its name.

    Raises:
        WriteFailed: It cannot be made.
    """
    from vtslam.storage.recording.writer import ColorFormat, RecordingWriter

    path = next(path for path in _names(Path(settings.file)) if not path.exists())
    color = ColorFormat(name=settings.color, jpeg_quality=settings.jpeg_quality)
    return RecordingWriter(path, family=family, color=color)


def maybe_recording(settings: RecorderSettings, *, family: str) -> AbstractContextManager["RecordingWriter | None"]:
    """The recording if the settings ask for one, closed on leaving; raises as :func:`open_recording`."""
    return open_recording(settings, family=family) if settings.file else contextlib.nullcontext()


def _names(path: Path) -> Iterator[Path]:
    """The names of a recording's parts, without end."""
    yield path
    for part in count(2):
        yield path.with_name(f"{path.stem}-{part}{path.suffix}")


def _parts(path: Path) -> Iterator[Path]:
    """The parts that there are, also where the first is gone."""
    if path.exists():
        yield path
    yield from takewhile(Path.exists, islice(_names(path), 1, None))

"""Recordings as the settings ask for them."""

import contextlib
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from vtslam.common.settings import RecorderSettings
from vtslam.storage.errors import WriteFailed

if TYPE_CHECKING:
    from vtslam.storage.recording.writer import RecordingWriter


def make_way(settings: RecorderSettings, *, overwrite: bool) -> None:
    """Remove an earlier recording, or refuse to, before anything is started.

    Raises:
        WriteFailed: It is there and not to be overwritten, or the folder is not there.
    """
    if not settings.file:
        return
    path = Path(settings.file)
    if not path.parent.is_dir():
        raise WriteFailed(f"{path}: expected a folder for the recording, found none")
    if path.exists() and not overwrite:
        raise WriteFailed(f"{path}: expected no recording yet, found a file (--overwrite gives it up)")
    path.unlink(missing_ok=True)


def open_recording(settings: RecorderSettings, *, family: str) -> "RecordingWriter":
    """A new recording; where one is (its recorder died, or the run is resumed) another part of it, ``-2`` in its name.

    Raises:
        WriteFailed: It cannot be made.
    """
    from vtslam.storage.recording.writer import ColorFormat, RecordingWriter

    path, part = Path(settings.file), 1
    while path.exists():
        part += 1
        path = Path(settings.file).with_name(f"{Path(settings.file).stem}-{part}{path.suffix}")
    color = ColorFormat(name=settings.color, jpeg_quality=settings.jpeg_quality)
    return RecordingWriter(path, family=family, color=color)


def maybe_recording(settings: RecorderSettings, *, family: str) -> AbstractContextManager["RecordingWriter | None"]:
    """The recording if the settings ask for one, closed on leaving; raises as :func:`open_recording`."""
    return open_recording(settings, family=family) if settings.file else contextlib.nullcontext()

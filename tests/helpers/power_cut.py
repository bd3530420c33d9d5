"""A disk that remembers what was made durable, and what it may hold after a power cut at any moment."""

import shutil
import sqlite3
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from vtslam.storage import atomic


@dataclass(slots=True)
class _Inode:
    """A file apart from its names: what it holds, and what it certainly held after the last sync."""

    content: bytearray = field(default_factory=bytearray)
    synced: bytes = b""
    is_loose: bool = False  # written since the last sync


@dataclass(slots=True)
class Moment:
    """The disk at one moment, and the catalogue of then, which looks after itself.

    Attributes:
        names: Files by path as processes see them.
        durable: Files by path as the last syncs of their folders left them.
        sections: Sections that were committed.
        catalog: Content of the catalogue's file.
    """

    names: dict[Path, _Inode]
    durable: dict[Path, _Inode]
    sections: int
    catalog: bytes


class RecordingDisk(atomic.Disk):
    """Does everything for real, and keeps a moment before each call that changes something."""

    def __init__(self, run: Path) -> None:
        self._run = run
        self._names = {path: _Inode(bytearray(path.read_bytes()), path.read_bytes()) for path in _files(run)}
        self._durable = dict(self._names)
        self._open: dict[int, _Inode] = {}
        self.sections = 0
        self.moments: list[Moment] = []

    def keep(self) -> None:
        """Note the disk as it is now."""
        copies: dict[int, _Inode] = {}

        def copied(inode: _Inode) -> _Inode:
            return copies.setdefault(id(inode), _Inode(bytearray(inode.content), inode.synced, inode.is_loose))

        self.moments.append(
            Moment(
                names={path: copied(inode) for path, inode in self._names.items()},
                durable={path: copied(inode) for path, inode in self._durable.items()},
                sections=self.sections,
                catalog=_catalog_bytes(self._run),
            )
        )

    def create(self, path: Path) -> int:
        self.keep()
        descriptor = super().create(path)
        self._names[path] = self._open[descriptor] = _Inode()
        return descriptor

    def open_at_end(self, path: Path) -> int:
        self.keep()
        descriptor = super().open_at_end(path)
        self._open[descriptor] = self._names.setdefault(path, _Inode())
        return descriptor

    def write(self, descriptor: int, data: bytes | memoryview) -> int:
        self.keep()
        count = super().write(descriptor, data)
        inode = self._open[descriptor]
        inode.content += bytes(data[:count])
        inode.is_loose = True
        return count

    def sync(self, descriptor: int) -> None:
        self.keep()
        super().sync(descriptor)
        inode = self._open[descriptor]
        inode.synced, inode.is_loose = bytes(inode.content), False

    def rename(self, source: Path, target: Path) -> None:
        self.keep()
        super().rename(source, target)
        self._names[target] = self._names.pop(source)

    def unlink(self, path: Path) -> None:
        self.keep()
        super().unlink(path)
        self._names.pop(path, None)

    def sync_folder(self, folder: Path) -> None:
        self.keep()
        super().sync_folder(folder)
        for path in [path for path in self._durable if path.parent == folder and path not in self._names]:
            del self._durable[path]
        self._durable.update({path: inode for path, inode in self._names.items() if path.parent == folder})


def after_power_cut(moment: Moment, rng: Random, run: Path, folder: Path) -> None:
    """Make in ``folder`` what may be left of the run folder ``run``: what was not synced is there, torn, or gone."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "sections").mkdir(parents=True)
    for path in sorted({*moment.names, *moment.durable}):
        new, old = moment.names.get(path), moment.durable.get(path)
        inode = new if new is old else rng.choice([new, old])
        if inode is not None and "catalog" not in path.name:
            (folder / path.relative_to(run)).write_bytes(_torn(inode, rng))
    (folder / "catalog.sqlite").write_bytes(moment.catalog)


def _torn(inode: _Inode, rng: Random) -> bytes:
    """What a file may hold: all, or the synced part and then something of what came after it."""
    content, synced = bytes(inode.content), len(inode.synced)
    if not inode.is_loose:
        return content
    kept = rng.randint(synced, len(content))
    rest = rng.choice([b"", bytes(len(content) - kept), rng.randbytes(len(content) - kept)])
    return content[:kept] + rest


def _files(run: Path) -> list[Path]:
    return [path for path in run.rglob("*") if path.is_file()]


def _catalog_bytes(run: Path) -> bytes:
    """The catalogue with all that was committed, as one file."""
    source = sqlite3.connect(run / "catalog.sqlite")
    target = sqlite3.connect(":memory:")
    try:
        source.backup(target)
        return bytes(target.serialize())
    finally:
        source.close()
        target.close()

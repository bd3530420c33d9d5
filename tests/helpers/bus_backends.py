"""The two buses behind one face, so that one class of tests holds both to the same behaviour."""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from vtslam.common.bus import Bus, Member
from vtslam.common.bus_memory import MemoryWorld
from vtslam.common.bus_schedule import SeededSchedule
from vtslam.common.bus_zenoh import Hub, join
from vtslam.common.topics import Role


class Backend(Protocol):
    """Opens sessions that reach each other."""

    def join(self, role: Role, name: str = "") -> Bus: ...


class MemoryBackend:
    def __init__(self) -> None:
        self._world = MemoryWorld(SeededSchedule(3))

    def join(self, role: Role, name: str = "") -> Bus:
        return self._world.join(Member(fleet="test", role=role, name=name))


class ZenohBackend:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._open: list[Bus] = []

    def join(self, role: Role, name: str = "") -> Bus:
        bus = join(Member(fleet="test", role=role, name=name), self._folder)
        self._open.append(bus)
        return bus

    def close(self) -> None:
        for bus in self._open:
            bus.close()


@contextmanager
def short_folder() -> Iterator[Path]:
    """A new private folder whose path is short enough for a socket; it must be empty in the end."""
    base = Path(tempfile.mkdtemp(prefix="vts-"))
    try:
        yield base
    finally:
        left = [path for path in base.rglob("*") if path.is_socket() or path.suffix == ".lock"]
        shutil.rmtree(base)
        assert not left


@contextmanager
def zenoh_backend() -> Iterator[ZenohBackend]:
    """A hub of its own; closes every session that was opened."""
    with short_folder() as base, Hub(base / "run", "test"):
        backend = ZenohBackend(base / "run")
        try:
            yield backend
        finally:
            backend.close()


def keep_trying(bus: Bus, attempt: Callable[[], bool], *, timeout_s: float = 60.0) -> bool:
    """Call ``attempt``, which may publish, again and again until it is true; False if it never is."""
    deadline_ns = bus.clock.monotonic_ns() + int(timeout_s * 1e9)
    while not attempt():
        if bus.clock.monotonic_ns() >= deadline_ns:
            return False
        bus.wait(0.02)
    return True

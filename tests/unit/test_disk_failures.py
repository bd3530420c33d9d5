"""Full and read-only disks: a clear message, and what was stored before stays as it was."""

import errno
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from helpers.small_runs import check_whole, result_bytes, small_run, write_sections

from vtslam.storage import atomic
from vtslam.storage.errors import CatalogError, DiskFull, WriteFailed
from vtslam.storage.run_folder import RunFolder


class FailingDisk(atomic.Disk):
    """Refuses everything that needs room, from its n-th call on; of the write that is refused, a part was taken."""

    def __init__(self, passes: int, number: int) -> None:
        self.left, self._error = passes, OSError(number, os.strerror(number))

    def _pass(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise self._error

    def create(self, path: Path) -> int:
        self._pass()
        return super().create(path)

    def open_at_end(self, path: Path) -> int:
        self._pass()
        return super().open_at_end(path)

    def write(self, descriptor: int, data: bytes | memoryview) -> int:
        if self.left == 0:
            super().write(descriptor, data[: len(data) // 2])
        self._pass()
        return super().write(descriptor, data)

    def sync(self, descriptor: int) -> None:
        self._pass()
        super().sync(descriptor)

    def rename(self, source: Path, target: Path) -> None:
        self._pass()
        super().rename(source, target)

    def sync_folder(self, folder: Path) -> None:
        self._pass()
        super().sync_folder(folder)


@pytest.mark.parametrize(("number", "kind"), [(errno.ENOSPC, DiskFull), (errno.EDQUOT, DiskFull), (errno.EROFS, None)])
def test_a_disk_that_refuses_at_any_call_takes_nothing_away(
    number: int, kind: type[WriteFailed] | None, folder_in_memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, refused = 0, True
    whole = result_bytes(small_run(folder_in_memory / "whole", 3))
    begun = small_run(folder_in_memory / "begun", 1)
    while refused:
        path = shutil.copytree(begun, folder_in_memory / f"run{calls}")
        with RunFolder.open(path, writable=True) as run:
            monkeypatch.setattr(atomic, "DISK", FailingDisk(calls, number))
            error = refused_by(partial(write_sections, run, 1, 3))
            monkeypatch.undo()
        refused = error is not None
        if error is not None:
            assert type(error) is (kind or WriteFailed)
            assert os.strerror(number) in str(error)
        sections = check_whole(path, at_least=1)
        with RunFolder.open(path, writable=True) as run:
            write_sections(run, sections, 3)
        assert result_bytes(path) == whole
        calls += 1
    assert calls > 20


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 300 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=300k", "vtslam-test", str(folder)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"this process may not mount file systems: {mounted.stderr.decode().strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_a_small_disk_fills_up_and_is_used_again_once_there_is_room(small_disk: Path) -> None:
    path, ballast = small_disk / "run", small_disk / "ballast"
    small_run(path, 2)
    ballast.write_bytes(bytes(_free_bytes(small_disk) - 40_000))
    told = refusal(lambda: grow(path))
    assert "cannot write: No space left on device" in told or "no space left on the disk" in told
    ballast.unlink()
    sections = check_whole(path, at_least=2)
    with RunFolder.open(path, writable=True) as run:
        write_sections(run, sections, sections + 1)
    assert check_whole(path, at_least=sections + 1) == sections + 1


def test_a_read_only_disk_can_be_read_and_refuses_writers(small_disk: Path) -> None:
    path = small_run(small_disk / "run", 2)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with RunFolder.open(path) as run:
        assert run.catalog.num_frames == 6
        assert run.read_section(1).section_id == 1
    assert "cannot write: Read-only file system" in refusal(lambda: RunFolder.open(path, writable=True))


def test_a_read_only_disk_with_transactions_in_a_log_is_refused(small_disk: Path, folder_in_memory: Path) -> None:
    path = small_run(small_disk / "run", 1)
    with RunFolder.open(path, writable=True) as run:
        write_sections(run, 1, 2)
        for file in path.glob("catalog.sqlite*"):  # as they are if the writer dies now
            shutil.copyfile(file, folder_in_memory / file.name)
    for name in ("catalog.sqlite", "catalog.sqlite-wal"):
        shutil.copyfile(folder_in_memory / name, path / name)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(CatalogError, match=r"catalog\.sqlite-wal: expected a catalogue that was closed, found trans"):
        _ = RunFolder.open(path).catalog


def grow(path: Path) -> None:
    with RunFolder.open(path, writable=True) as run:
        write_sections(run, len(run.catalog.sections()), 1000)


def refusal(action: Callable[[], object]) -> str:
    error = refused_by(action)
    assert error is not None
    return str(error)


def refused_by(action: Callable[[], object]) -> WriteFailed | None:
    try:
        action()
    except WriteFailed as error:
        return error
    return None


def _free_bytes(folder: Path) -> int:
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize

"""Shared memory that is full is an error with numbers, and never a signal."""

import errno
import os
from pathlib import Path

import pytest
from helpers.forks import run_script
from helpers.shm_sections import SmallSection, frame_of, sealed_section, spec_of, state_bytes
from helpers.small_tmpfs import can_mount, mounting

from vtslam.common.shm.errors import MapStoreFull, SharedMemoryFull
from vtslam.common.shm.frame_ring import FrameRingWriter
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.ring_layout import RingSpec


def test_small_tmpfs(tmp_path: Path) -> None:
    if not can_mount(tmp_path):
        pytest.skip("this user may not mount a tmpfs in a namespace of its own")
    assert run_script("shm_full", str(tmp_path), prefix=mounting(tmp_path, size="2m")) == ["ring", "commit", "sealed"]


def test_refused_reservations_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(fd: int, offset: int, length: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(SharedMemoryFull, match=r"ring: \d+ bytes of shared memory wanted, \d+ free"):
        FrameRingWriter.create(tmp_path / "ring", RingSpec(width=16, height=12))
    store = MapStore(tmp_path / "map", budget_bytes=1 << 30)
    with pytest.raises(SharedMemoryFull):
        store.create_active(spec_of(1))
    with pytest.raises(SharedMemoryFull):
        store.put_sealed(sealed_section(SmallSection(), 2))
    assert [path.name for path in tmp_path.rglob("*")] == ["map"]


def test_any_reservation_of_a_commit_may_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = MapStore(tmp_path / "map", budget_bytes=1 << 30)
    small, writer = SmallSection(section_id=1, rows=5000), store.create_active(spec_of(1))
    real, left = os.posix_fallocate, 0

    def refuse_later(fd: int, offset: int, length: int) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(fd, offset, length)

    monkeypatch.setattr(os, "posix_fallocate", refuse_later)
    failures = 0
    for frames in (1, 2, 3):
        allowed, done = 0, False
        while not done:
            left, allowed = allowed, allowed + 1
            try:
                writer.commit(small.commit(frames))
                done = True
            except SharedMemoryFull:
                failures += 1
                state = writer.state()
                assert (0 if state is None else state.generation) == frames - 1
                assert state is None or state_bytes(state) == small.expected(frames - 1)
    assert failures > 10
    state = writer.state()
    assert state is not None
    assert state_bytes(state) == small.expected(3)


def test_the_budget_stops_admission(tmp_path: Path) -> None:
    section = sealed_section(SmallSection(section_id=7, rows=1000), 4)
    roomy = MapStore(tmp_path / "roomy", budget_bytes=1 << 30)
    roomy.put_sealed(section)
    budget = roomy.used_bytes()
    store = MapStore(tmp_path / "map", budget_bytes=budget)
    store.put_sealed(section)
    assert store.used_bytes() <= budget
    with pytest.raises(MapStoreFull, match=f"of the map store's {budget} bytes are in use") as refused:
        store.create_active(spec_of(8))
    assert refused.value.used_bytes == store.used_bytes()
    store.unlink_sealed(7, verified_on_disk=True)
    assert store.used_bytes() == 0
    writer = store.create_active(spec_of(8))
    small = SmallSection(section_id=8, rows=3000)
    with pytest.raises(MapStoreFull, match="active-000008"):
        writer.commit(small.commit(1))
    assert writer.state() is None
    roomier = MapStore(tmp_path / "map", budget_bytes=1 << 30).adopt_active()
    assert roomier is not None
    roomier.commit(small.commit(1))
    state = roomier.state()
    assert state is not None
    assert state_bytes(state) == small.expected(1)


def test_a_frame_that_does_not_fit_the_ring(tmp_path: Path) -> None:
    ring = FrameRingWriter.create(tmp_path / "ring", RingSpec(width=8, height=8, slots=3, pins=2))
    with pytest.raises(ValueError, match="expected 8x8, got 16x12"):
        ring.publish_newest(frame_of(1))

"""Script: a writer that never waits, and readers beside it that copy, pin, stop and die.

Each reader checks every value of what it got; the writer goes on until all readers had their share, so that a reader
that starves shows as a test that does not end. Prints what was counted.
"""

import json
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from helpers.forks import Progress, ended, forked, killed
from helpers.shm_sections import SmallSection, frame_bytes, frame_with_prior_of, shared_folder, spec_of

from vtslam.common.geometry.camera import Camera
from vtslam.common.shm.active_layout import LEARNED_NAME
from vtslam.common.shm.errors import FrameGone, GenerationGone
from vtslam.common.shm.frame_ring import FrameRingReader, FrameRingWriter
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.records import ActiveState, Commit
from vtslam.common.shm.ring_layout import RingSpec

_CAMERA = Camera(width=160, height=120, fx=100.0, fy=100.0, cx=80.0, cy=60.0)
_SHARE = 150  # looks of each reader
_RING_PINS, _STORE_PINS, _KEPT = 4, 5, 2  # one stopped, up to three that look, one that dies
Action = Callable[[Progress], None]  # reports once when it is at work
Holder = Callable[[Progress, bool], None]


def _all_served(folder: Path, writer: Action, readers: list[Action], holder: Holder) -> int:
    """Run a writer and its readers; meanwhile holders of pins die, more than there are pins, and one is stopped.

    Returns:
        Holders that died.
    """
    living: list[int] = []
    try:
        written, writing = _started(living, writer)
        stopped, _ = _started(living, lambda say: holder(say, True))
        os.kill(stopped, signal.SIGSTOP)
        looking = [_started(living, reader)[0] for reader in readers]
        deaths = 2 * max(_RING_PINS, _STORE_PINS)
        for _ in range(deaths):
            pid, _ = _started(living, lambda say: holder(say, False))
            killed(pid)
            living.remove(pid)
        for pid in looking:
            _end_well(living, pid)
        (folder / "stop").touch()
        _end_well(living, written)
        os.kill(stopped, signal.SIGCONT)
        _end_well(living, stopped)  # what it held all the time is what it was
        assert writing.rest() == "+"
    finally:
        for pid in living:
            killed(pid)
    return deaths


def _started(living: list[int], act: Action) -> tuple[int, Progress]:
    """A process that has said so itself."""
    progress = Progress()
    pid = forked(lambda: act(progress))
    living.append(pid)
    progress.listen()
    progress.wait_for(1)
    assert progress.text == "+"
    return pid, progress


def _end_well(living: list[int], pid: int) -> None:
    living.remove(pid)
    assert ended(pid) == 0


def _wait_for_stop(folder: Path, stays: bool) -> None:
    """Come back once the writer has been told to stop; otherwise wait for the end."""
    if not stays:
        signal.pause()
    # Stopped by a signal before this is reached or soon after; either way it comes back late.
    while not (folder / "stop").exists():
        os.sched_yield()


# --- frame ring -------------------------------------------------------------------------------------------------------


def _ring(folder: Path, *, waiting: bool) -> dict[str, int]:
    path = folder / "ring"
    spec = RingSpec(width=_CAMERA.width, height=_CAMERA.height, slots=_RING_PINS + 2, pins=_RING_PINS)

    def write(progress: Progress) -> None:
        writer, sequence = FrameRingWriter.create(path, spec), 0
        progress.say("+")
        while not (folder / "stop").exists():
            sequence += 1
            if not waiting:
                writer.publish_newest(frame_with_prior_of(sequence, _CAMERA))
            elif writer.try_publish(frame_with_prior_of(sequence, _CAMERA), credit=2) is None:
                sequence -= 1
                os.sched_yield()

    def look(progress: Progress, pin: bool) -> None:
        reader, seen = FrameRingReader(path), 0
        progress.say("+")
        while seen < _SHARE:
            newest = reader.newest()
            if newest is None:
                continue
            try:
                if pin:
                    with reader.using(newest) as frame:
                        assert frame_bytes(frame) == frame_bytes(frame_with_prior_of(newest.sequence, _CAMERA))
                else:
                    assert frame_bytes(reader.copied(newest)) == frame_bytes(
                        frame_with_prior_of(newest.sequence, _CAMERA)
                    )
            except FrameGone:
                continue
            seen += 1

    def take_all(progress: Progress) -> None:
        """Every frame once, in order, as lockstep does."""
        reader, taken = FrameRingReader(path), 0
        progress.say("+")
        while taken < _SHARE:
            for descriptor in reader.unacknowledged():
                taken += 1
                assert descriptor.sequence == taken
                with reader.using(descriptor) as frame:
                    assert frame_bytes(frame) == frame_bytes(frame_with_prior_of(taken, _CAMERA))
                reader.acknowledge(taken)

    def hold(pinned: Progress, stays: bool) -> None:
        reader = FrameRingReader(path)
        while True:
            newest = reader.newest()
            if newest is None:
                continue
            try:
                held = reader.pinned(newest)
            except FrameGone:
                continue
            break
        pinned.say("+")
        _wait_for_stop(folder, stays)
        assert frame_bytes(held.frame) == frame_bytes(frame_with_prior_of(newest.sequence, _CAMERA))

    if waiting:
        deaths = _all_served(folder, write, [take_all], hold)
    else:
        deaths = _all_served(folder, write, [partial(look, pin=pin) for pin in (True, False, False)], hold)
    reader = FrameRingReader(path)
    return {"deaths": deaths, "published": reader.published, "lost": reader.lost}


# --- map store --------------------------------------------------------------------------------------------------------


def _learned_commit(base: Commit, generation: int) -> Commit:
    """The same section with all learned values and the facts naming the generation."""
    g = base.section.gaussians
    value = np.float32(generation)
    gaussians = g.with_attributes(
        colors=np.full_like(g.colors, value),
        log_radii=np.full_like(g.log_radii, value),
        opacity_logits=np.full_like(g.opacity_logits, value),
    )
    section = replace(base.section, gaussians=gaussians)
    return replace(base, section=section, new_frames=(), facts=str(generation).encode())


def _check_generation(state: ActiveState) -> None:
    g = state.section.gaussians
    assert state.facts == str(state.generation).encode()
    for values in (g.colors, g.log_radii, g.opacity_logits):
        assert values.size > 0
        assert (values == np.float32(state.generation)).all()


def _store(folder: Path) -> dict[str, int]:
    store = MapStore(folder / "map", budget_bytes=1 << 26, pins=_STORE_PINS)
    first = SmallSection(section_id=1, rows=3000, with_moments=False).commit(1)

    def write(progress: Progress) -> None:
        writer = store.create_active(spec_of(1, with_moments=False, kept_generations=_KEPT))
        writer.commit(replace(_learned_commit(first, 1), new_frames=first.new_frames))
        progress.say("+")
        while not (folder / "stop").exists():
            writer.commit(_learned_commit(first, writer.generation + 1))

    def look(progress: Progress, behind: int) -> None:
        reader, seen = store.active_reader(1), 0
        progress.say("+")
        while seen < _SHARE:
            try:
                held = reader.pinned(None if behind == 0 else max(reader.generation - behind, 1))
            except GenerationGone:
                continue
            for _ in range(3):
                _check_generation(held.state)
            held.release()
            seen += 1

    def hold(pinned: Progress, stays: bool) -> None:
        held = store.pinned_active(1)
        pinned.say("+")
        _wait_for_stop(folder, stays)
        _check_generation(held.state)

    deaths = _all_served(folder, write, [partial(look, behind=behind) for behind in (0, 0, 1)], hold)
    buffers = [name for name in os.listdir(folder / "map" / "active-000001") if LEARNED_NAME.fullmatch(name)]
    return {"deaths": deaths, "generations": store.active_reader(1).generation, "buffers": len(buffers)}


def main() -> None:
    """The argument says what is shared: `ring`, `ring-waiting` or `store`."""
    with shared_folder() as folder:
        what = sys.argv[1]
        counted = _store(folder) if what == "store" else _ring(folder, waiting=what == "ring-waiting")
    print(json.dumps(counted))


if __name__ == "__main__":
    main()

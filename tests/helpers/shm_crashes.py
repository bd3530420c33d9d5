"""Script: writers that die at every fail point, and at any instruction; others go on from what they left.

Prints, for each schedule, what died where; asserts that the next process finds the former or the new state, whole,
and that going on from there ends with the same bytes as without a crash.
"""

import json
import os
import random
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from helpers.forks import Progress, ended, forked
from helpers.shm_sections import (
    SmallSection,
    frame_bytes,
    frame_of,
    sealed_section,
    section_bytes,
    shared_folder,
    spec_of,
    state_bytes,
)

from vtslam.common import failpoints
from vtslam.common.shm.active_writer import ActiveWriter
from vtslam.common.shm.errors import SectionNotResident
from vtslam.common.shm.frame_ring import FrameRingReader, FrameRingWriter
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.ring_layout import RingSpec

_RING_FRAMES = 9
GoOn = Callable[[Path, Progress], None]


# --- map store: what happens in order; a position is a number of steps done -------------------------------------------


def _small(section_id: int) -> SmallSection:
    return SmallSection(section_id=section_id, rows=2100)  # two commits need more than one chunk


_STEPS: list[tuple[str, int, int]] = [
    ("begin", 1, 0),
    *(("commit", 1, n) for n in (1, 2, 3, 4)),
    ("seal", 1, 4),
    ("begin", 2, 0),
    *(("commit", 2, n) for n in (1, 2)),
    ("seal", 2, 2),
    ("begin", 3, 0),
    ("commit", 3, 1),
]


def _store(folder: Path) -> MapStore:
    return MapStore(folder / "map", budget_bytes=1 << 26, pins=4)


def _store_position(store: MapStore, writer: ActiveWriter | None) -> int:
    """How many steps are in the store; what is there must be whole."""
    last = store.last_commit()
    if writer is not None and writer.generation:
        state = writer.state()
        assert state is not None
        assert state_bytes(state) == _small(writer.section_id).expected(writer.generation)
        assert last is not None
        assert last.facts == state.facts
        return _STEPS.index(("commit", writer.section_id, writer.generation)) + 1
    sealed = store.sealed_ids()
    if sealed:
        frames = next(n for step, section_id, n in _STEPS if (step, section_id) == ("seal", sealed[-1]))
        assert last is not None
        assert (last.section_id, last.is_sealed, last.facts) == (sealed[-1], True, b"end")
        assert frame_bytes(last.frame) == frame_bytes(_small(sealed[-1]).frame(frames - 1))
        done = _STEPS.index(("seal", sealed[-1], frames)) + 1
    else:
        assert last is None
        done = 0
    return done if writer is None else done + 1


def _look(store: MapStore) -> None:
    """What a reader sees before anybody has taken over."""
    section_id = store.active_id()
    for sealed_id in store.sealed_ids():
        frames = next(n for step, i, n in _STEPS if (step, i) == ("seal", sealed_id))
        held = store.pinned_sealed(sealed_id, verify=True)
        assert section_bytes(held.section) == section_bytes(sealed_section(_small(sealed_id), frames))
        held.release()
    if section_id is None:
        return
    try:
        seen = store.pinned_active(section_id)
    except SectionNotResident:
        return
    small = SmallSection(section_id=section_id, rows=2100, with_moments=False)
    assert state_bytes(seen.state) == small.expected(seen.state.generation)
    seen.release()


def _go_on_store(folder: Path, progress: Progress) -> None:
    """Take over and do the rest."""
    store = _store(folder)
    _look(store)
    writer = store.adopt_active()
    position = _store_position(store, writer)
    progress.say(f"{position}:")
    for step, section_id, frames in _STEPS[position:]:
        if step == "begin":
            writer = store.create_active(spec_of(section_id))
        elif step == "commit":
            assert writer is not None
            writer.commit(_small(section_id).commit(frames))
        else:
            assert writer is not None
            store.seal(writer, sealed_section(_small(section_id), frames), b"end")
        progress.say("+")


def _check_store_end(folder: Path) -> None:
    store = _store(folder)
    _look(store)
    assert store.sealed_ids() == [1, 2]
    assert store.active_id() == 3
    assert store.active_reader(3).generation == 1
    assert sorted(os.listdir(folder / "map")) == ["active-000003", "sealed-000001", "sealed-000002", "tail-000002"]


# --- frame ring -------------------------------------------------------------------------------------------------------


def _go_on_ring(folder: Path, progress: Progress) -> None:
    path = folder / "ring"
    if path.exists():
        writer = FrameRingWriter.adopt(path)
    else:
        camera = frame_of(0).camera
        writer = FrameRingWriter.create(path, RingSpec(width=camera.width, height=camera.height, slots=4, pins=2))
    position = writer.published
    progress.say(f"{position}:")
    reader = FrameRingReader(path)
    for descriptor in writer.unacknowledged():
        assert frame_bytes(reader.copied(descriptor)) == frame_bytes(frame_of(descriptor.sequence))
    assert len(writer.unacknowledged()) == position - writer.acknowledged
    for sequence in range(position + 1, _RING_FRAMES + 1):
        writer.acknowledge(max(sequence - 2, 0))
        descriptor = writer.publish_waiting(frame_of(sequence), credit=2, timeout_s=0.0)
        assert descriptor.sequence == sequence
        progress.say("+")


def _check_ring_end(folder: Path) -> None:
    reader = FrameRingReader(folder / "ring")
    newest = reader.newest()
    assert newest is not None
    assert newest.sequence == _RING_FRAMES
    assert frame_bytes(reader.copied(newest)) == frame_bytes(frame_of(_RING_FRAMES))


# --- crashes ----------------------------------------------------------------------------------------------------------


def _done_after(report: str, done: int) -> int:
    """Steps that are surely visible after a process, by what it reported; checks where it started."""
    if ":" not in report:
        return done
    position, _, steps = report.partition(":")
    # The last step of the process before may or may not have become visible when that one died.
    assert done <= int(position) <= done + 1, f"{done} steps were done, {position} found"
    return int(position) + len(steps)


def _died_at(points: Sequence[str], go_on: GoOn, check_end: Callable[[Path], None]) -> bool:
    """Die at one point after the other, each in a process that goes on from the last; whether all were reached."""
    with shared_folder() as folder:
        done = 0
        for point in [*points, ""]:
            progress = Progress()

            def act(point: str = point, progress: Progress = progress) -> None:
                failpoints.arm(point)
                go_on(folder, progress)

            pid = forked(act)
            progress.listen()
            status = ended(pid)
            done = _done_after(progress.rest(), done)
            assert status in (0, -signal.SIGKILL), f"{points}: {status}"
            if status == 0:
                check_end(folder)
                return point == ""
    raise AssertionError("the last process has no fail point")


def _at_every_point(prefixes: tuple[str, ...], go_on: GoOn, check_end: Callable[[Path], None]) -> dict[str, int]:
    """Passages of each fail point at which a process died."""
    passages = {}
    for name in (name for name in failpoints.NAMES if name.startswith(prefixes)):
        passages[name] = 0
        # Points of taking over are passed when there is something to take over.
        first = [f"{prefixes[-1]}:3"] if name.startswith("shm.adopt") else []
        while _died_at([*first, f"{name}:{passages[name] + 1}"], go_on, check_end):
            passages[name] += 1
    return passages


def _at_any_instruction(seed: int, wanted: int, go_on: GoOn, check_end: Callable[[Path], None]) -> int:
    """Kills from outside, some reported steps after the start of each process, until so many hit; how many did."""
    choice, kills = random.Random(seed), 0
    while kills < wanted:
        with shared_folder() as folder:
            done, status = 0, -1
            while status != 0:
                progress = Progress()
                pid = forked(lambda folder=folder, progress=progress: go_on(folder, progress))  # type: ignore[misc]
                progress.listen()
                progress.wait_for(choice.randrange(1, 6))
                for _ in range(choice.randrange(20_000)):
                    pass  # the victim is somewhere else each time
                os.kill(pid, signal.SIGKILL)
                status = ended(pid)
                done = _done_after(progress.rest(), done)
                kills += status != 0
            check_end(folder)
    return kills


def main() -> None:
    """What to crash is the argument: `ring` or `store`; then `points`, or `anywhere` with a seed."""
    what, how = sys.argv[1:3]
    if what == "ring":
        names: tuple[str, ...] = ("shm.adopt.before", "shm.adopt.after_epoch", "shm.ring.", "shm.ring.after_pixels")
        go_on, check_end = _go_on_ring, _check_ring_end
    else:
        names = ("shm.adopt.", "shm.active.", "shm.commit.", "shm.seal", "shm.remove.", "shm.commit.before_flip")
        go_on, check_end = _go_on_store, _check_store_end
    with shared_folder() as folder:  # undisturbed; the sections made here need not be made again by what is forked
        go_on(folder, Progress())
        check_end(folder)
    if how == "points":
        print(json.dumps(_at_every_point(names, go_on, check_end)))
    else:
        print(json.dumps(_at_any_instruction(int(sys.argv[3]), 12, go_on, check_end)))


if __name__ == "__main__":
    main()

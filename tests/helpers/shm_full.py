"""Script: ring and map store on a file system that is too small (the argument is a folder on it).

Prints the kinds of refusals; asserts that what was there before stays whole and that freed space is used.
"""

import json
import sys
from pathlib import Path

from helpers.shm_sections import SmallSection, frame_of, sealed_section, spec_of, state_bytes

from vtslam.common.shm.errors import SharedMemoryFull
from vtslam.common.shm.frame_ring import FrameRingWriter
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.ring_layout import RingSpec

_ROWS = 3000


def main() -> None:
    """Fill the file system."""
    folder, refusals = Path(sys.argv[1]), []
    try:
        FrameRingWriter.create(folder / "ring", RingSpec(width=640, height=480))
    except SharedMemoryFull as error:
        refusals.append("ring" if error.wanted_bytes > error.free_bytes else "ring, though there was room")
    assert list(folder.iterdir()) == []
    store = MapStore(folder / "map", budget_bytes=1 << 30)
    store.put_sealed(sealed_section(SmallSection(section_id=0, rows=20_000), 1))
    small = SmallSection(section_id=1, rows=_ROWS)
    writer, frames = store.create_active(spec_of(1)), 0
    while not refusals or refusals[-1] != "commit":
        try:
            writer.commit(small.commit(frames + 1))
            frames += 1
        except SharedMemoryFull:
            refusals.append("commit")
    state = writer.state()
    assert state is not None
    assert state_bytes(state) == small.expected(frames)
    try:
        store.put_sealed(sealed_section(SmallSection(section_id=9, rows=30_000), 1))
    except SharedMemoryFull:
        refusals.append("sealed")
    assert store.sealed_ids() == [0]
    store.unlink_sealed(0, verified_on_disk=True)
    assert writer.commit(small.commit(frames + 1)) == frames + 1
    last = store.last_commit()
    assert last is not None
    assert last.frame.frame_id == frame_of(100 + frames).frame_id
    print(json.dumps(refusals))


if __name__ == "__main__":
    main()

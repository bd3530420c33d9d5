"""A mapper that takes over from the store goes on with the same bytes."""

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.small_map import SMALL_MAPPER, room_frame, room_pose, section_bytes, small_mapper

from vtslam.common.section import Section
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.records import ActiveSpec
from vtslam.services.mapper.state import ActiveSection
from vtslam.services.shared_sections import active_section_of, commit_of

_FRAMES = 5
_HELD_OUT = 2


def _sealed(folder: Path | None, *, keep_moments: bool) -> tuple[Section, MapStore | None]:
    """A section mapped and sealed; by way of a map store in a folder, a new mapper for every frame takes over there."""
    settings = replace(SMALL_MAPPER, keep_moments=keep_moments, exposure=True, edge_supplement=True)
    mapper = small_mapper(settings)
    store = MapStore(folder, budget_bytes=1 << 28) if folder else None
    active: ActiveSection | None = None
    for row in range(_FRAMES):
        frame, pose, held_out = room_frame(row), room_pose(row), row == _HELD_OUT
        if store is not None and row:
            writer = store.adopt_active()
            assert writer is not None
            state = writer.state()
            assert state is not None
            active = active_section_of(state, settings)
        if active is None:
            active, _ = mapper.map_head(frame, pose, section_id=0, neighbours=[])
        else:
            active, _ = mapper.map_regular(frame, pose, active, neighbours=[], held_out=held_out)
        if store is not None:
            writer = store.adopt_active() if row else store.create_active(_spec(active.section, keep_moments))
            assert writer is not None
            writer.commit(commit_of(active, frame, held_out=held_out, keep_moments=keep_moments, facts=b""))
    assert active is not None
    sealed, _ = mapper.seal(active, neighbours=[])
    if store is not None:
        writer = store.adopt_active()
        assert writer is not None
        store.seal(writer, sealed, b"")
    return sealed, store


def _spec(section: Section, with_moments: bool) -> ActiveSpec:
    pixels = section.camera.width * section.camera.height
    return ActiveSpec(
        section_id=section.section_id,
        camera=section.camera,
        depth_scale_m=section.depth_scale_m,
        depth_factor=section.depth_factor,
        max_frames=_FRAMES,
        max_gaussians=5 * pixels * _FRAMES,
        with_moments=with_moments,
    )


@pytest.mark.parametrize("keep_moments", [True, False])
def test_taking_over_at_every_frame_changes_nothing(keep_moments: bool, tmp_path: Path) -> None:
    expected, _ = _sealed(None, keep_moments=keep_moments)
    found, store = _sealed(tmp_path / "map", keep_moments=keep_moments)
    assert section_bytes(found) == section_bytes(expected)
    assert store is not None
    held = store.pinned_sealed(0, verify=True)
    read = held.section.retied()
    assert section_bytes(read) == section_bytes(expected)
    assert read.surface.tobytes() == expected.surface.tobytes()
    held.release()

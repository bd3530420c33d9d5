"""The catalogue: one transaction a section, versions of schema and poses, refusals."""

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.sections import frames_of, small_section

from vtslam.common.geometry import se3
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.storage import catalog_schema
from vtslam.storage.catalog import Catalog
from vtslam.storage.catalog_rows import SectionRow
from vtslam.storage.errors import BadMagic, CatalogError, DiskFull, UnsupportedVersion
from vtslam.storage.section_record import SectionRecord

EMPTY_DISK_PAGES = 4


def record(section_id: int) -> SectionRecord:
    """A section whose frames follow those of the one before."""
    first = small_section(section_id=section_id)
    ids = np.arange(3, dtype=np.int64) + 3 * section_id
    return replace(first, frame_ids=ids, capture_times_ns=1_000_000_000 * (1 + ids))


def row_of(section: SectionRecord) -> SectionRow:
    return SectionRow(
        section_id=section.section_id,
        first_frame_id=int(section.frame_ids[0]),
        num_frames=section.num_frames,
        num_gaussians=section.num_gaussians,
        camera=section.camera,
        depth_scale_m=section.depth_scale_m,
        num_bytes=1000 + section.section_id,
        sha256=bytes([section.section_id]) * 32,
        codec="raw",
    )


def enter(catalog: Catalog, section_id: int, *, resume: bytes | None = None) -> None:
    section = record(section_id)
    catalog.add_section(section, row_of(section), frames_of(section), resume=resume)


def enter_many(catalog: Catalog) -> None:
    for section_id in range(3, 100):
        enter(catalog, section_id)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "catalog.sqlite"
    catalog = Catalog.create(path)
    for section_id in range(3):
        enter(catalog, section_id, resume=b"after %d" % section_id)
    catalog.close()
    return path


def test_what_was_entered_is_there_also_for_readers_while_it_grows(path: Path) -> None:
    writer, reader = Catalog.open(path, writable=True), Catalog.open(path)
    assert reader.num_frames == 9
    enter(writer, 3)
    assert reader.num_frames == 12
    assert [row.section_id for row in reader.sections()] == [0, 1, 2, 3]
    row = reader.section(2)
    assert row is not None
    assert (row.end_frame_id, row.num_bytes, row.sha256, row.state) == (9, 1002, b"\2" * 32, "stored")
    assert row.camera == record(2).camera
    assert reader.section(4) is None
    assert (reader.resume_record(1), reader.resume_record(3), reader.resume_record(4)) == (b"after 1", None, None)
    totals = reader.totals()
    assert (totals.frames, totals.sections, totals.gaussians, totals.states) == (12, 4, 80, {"ok": 12})
    for catalog in (reader, writer):
        catalog.close()
    assert [entry.name for entry in path.parent.iterdir()] == ["catalog.sqlite"]


def test_poses_come_back_bit_for_bit_and_corrections_count(path: Path) -> None:
    catalog = Catalog.open(path, writable=True)
    committed = [frame.T_world_camera for section_id in range(3) for frame in frames_of(record(section_id))]
    times_ns, poses = catalog.poses()
    assert times_ns.tolist() == [10**9 * (1 + i) for i in range(9)]
    assert poses.tobytes() == np.stack(committed).tobytes()

    moved = se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    assert catalog.correct({1: moved}, {}) == 1
    assert catalog.correct({}, {8: moved}) == 2
    corrected = catalog.poses()[1]
    expected = committed[:3] + [moved @ T for T in record(1).T_section_frame] + committed[6:8]
    assert corrected[:8].tobytes() == np.stack(expected).tobytes()
    assert corrected[8].tobytes() == (record(2).T_world_section @ moved).tobytes()
    assert [frame.T_world_camera.tobytes() for frame in catalog.frames()] == [T.tobytes() for T in committed]
    views = list(catalog.views(1, 2))
    assert [view.T_world_camera.tobytes() for view in views] == [T.tobytes() for T in expected[3:5]]
    catalog.close()


def test_candidate_views(path: Path) -> None:
    catalog, section = Catalog.open(path), record(2)
    views = list(catalog.views(2, 9))
    assert [(view.section_id, view.section_row, view.frame_id) for view in views] == [(2, 0, 6), (2, 1, 7)]
    depth = section.view_depth[1]
    assert views[1].farthest == int(depth.max())
    assert (views[1].camera, views[1].depth_scale_m) == (section.camera, section.depth_scale_m)
    coarse = catalog.coarse_depth(7)
    assert coarse is not None
    assert coarse.packed() == CoarseDepth.of(depth).packed()
    assert catalog.coarse_depth(8) is None
    catalog.close()


def test_dropped_sections_take_all_their_rows_along(path: Path) -> None:
    catalog = Catalog.open(path, writable=True)
    catalog.drop_from(1)
    assert [row.section_id for row in catalog.sections()] == [0]
    assert [frame.frame_id for frame in catalog.frames()] == [0, 1, 2]
    enter(catalog, 1)
    assert catalog.num_frames == 6
    catalog.close()


def test_a_section_is_entered_as_a_whole_or_not_at_all(path: Path) -> None:
    catalog = Catalog.open(path, writable=True)
    section = replace(record(3), frame_ids=np.array([7, 9, 10], np.int64))  # frame 7 is section 2's
    with pytest.raises(CatalogError, match="UNIQUE constraint failed"):
        catalog.add_section(section, row_of(section), frames_of(section))
    assert (catalog.num_frames, len(catalog.sections())) == (9, 3)
    enter(catalog, 3)
    catalog.close()


def test_a_full_disk_takes_nothing_away(path: Path) -> None:
    catalog = Catalog.open(path, writable=True)
    (pages,) = catalog._connection.execute("PRAGMA page_count").fetchone()
    catalog._connection.execute(f"PRAGMA max_page_count = {pages + EMPTY_DISK_PAGES}")
    with pytest.raises(DiskFull, match=r"catalog\.sqlite: cannot write: no space left on the disk"):
        enter_many(catalog)
    last = len(catalog.sections()) - 1
    assert 3 < last < 99
    assert [row.section_id for row in catalog.sections()] == list(range(last + 1))
    assert catalog.num_frames == 3 * (last + 1)
    catalog._connection.execute("PRAGMA max_page_count = 100000")
    enter(catalog, last + 1)
    catalog.close()


def test_events_are_kept_in_order(path: Path) -> None:
    catalog = Catalog.open(path, writable=True)
    catalog.add_event("resumed", "after 9 frames")
    catalog.add_event("finished", "12 frames")
    for _ in range(2):  # told again, as after a restart
        catalog.add_event("restarted", "mapper", time_ns=7)
    first, second, told = catalog.events()
    assert (told.time_ns, told.kind, told.text) == (7, "restarted", "mapper")
    assert (first.kind, first.text, second.kind) == ("resumed", "after 9 frames", "finished")
    assert 10**18 < first.time_ns <= second.time_ns
    catalog.close()


# --- versions and refusals -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("writable", [False, True])
def test_a_later_programs_catalogue_is_refused_and_left_alone(writable: bool, path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA user_version = 7")
    connection.close()
    kept = path.read_bytes()
    with pytest.raises(UnsupportedVersion, match=r"schema version: expected at most 1, found 7; a later version of vt"):
        Catalog.open(path, writable=writable)
    assert path.read_bytes() == kept


def test_an_earlier_catalogue_is_brought_up_to_date_by_its_writer(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    later = (*catalog_schema.MIGRATIONS, "ALTER TABLE events ADD COLUMN place TEXT;", "CREATE TABLE more (a INTEGER);")
    monkeypatch.setattr(catalog_schema.migrate, "__defaults__", (later,))
    monkeypatch.setattr(catalog_schema.check_version, "__defaults__", (later,))
    catalog = Catalog.open(path, writable=True)
    assert catalog._connection.execute("PRAGMA user_version").fetchone() == (3,)
    assert catalog._connection.execute("SELECT place FROM events").fetchall() == []
    assert catalog.num_frames == 9
    catalog.close()


def test_a_migration_that_fails_changes_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = (*catalog_schema.MIGRATIONS, "CREATE TABLE more (a INTEGER); INSERT INTO nowhere VALUES (1);")
    monkeypatch.setattr(catalog_schema.migrate, "__defaults__", (broken,))
    with pytest.raises(CatalogError, match="no such table: nowhere"):
        Catalog.open(path, writable=True)
    monkeypatch.undo()
    catalog = Catalog.open(path, writable=True)
    assert catalog._rows("SELECT name FROM sqlite_master WHERE name = 'more'") == []
    assert catalog.num_frames == 9
    catalog.close()


def test_other_files_are_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(CatalogError, match="expected the catalogue of a run, found none"):
        Catalog.open(tmp_path / "nothing.sqlite")
    text = tmp_path / "text.sqlite"
    text.write_text("notes " * 1000)
    with pytest.raises(CatalogError, match="expected the catalogue of a run, found a damaged file"):
        Catalog.open(text, writable=True)
    other = tmp_path / "other.sqlite"
    with sqlite3.connect(other) as connection:
        connection.execute("CREATE TABLE notes (text TEXT)")
    connection.close()
    with pytest.raises(BadMagic, match="application id: expected 0x76747363, found 0x0"):
        Catalog.open(other)

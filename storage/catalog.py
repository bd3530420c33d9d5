"""The catalogue of a run: which sections are durable, their frames, poses, candidate views, and what happened.

A section counts once its row is here, and its row is written, with all that belongs to it, in one transaction after
its file is durable and verified. One process writes, the one that holds the run folder's lock; any may read meanwhile.
Payloads never change, so poses and anchors carry versions: 0 is what the section's file says, a correction is a later
one, and the newest counts.
"""

import contextlib
import json
import sqlite3
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry.camera import Camera
from vtslam.common.overlap.coarse import CoarseDepth
from vtslam.common.overlap.view_index import ViewFacts
from vtslam.storage.catalog_connection import connected, translated
from vtslam.storage.catalog_rows import (
    MISSING,
    Event,
    FrameRow,
    Pose,
    SectionRow,
    Totals,
    packed_facts,
    packed_pose,
    packed_views,
    unpacked_pose,
)
from vtslam.storage.catalog_schema import check_version, migrate
from vtslam.storage.errors import CatalogError, RunFolderError
from vtslam.storage.section_record import SectionRecord

_FRAMES = """
SELECT f.frame_id, f.capture_time_ns, f.T_world_committed, q.facts
FROM frames f JOIN quality q USING (frame_id) ORDER BY f.frame_id"""
_NEWEST = """
SELECT f.frame_id, f.capture_time_ns, f.T_world_committed, a.version, a.T_world_section, p.version, p.T_section_frame
FROM frames f
LEFT JOIN poses p ON p.frame_id = f.frame_id
  AND p.version = (SELECT max(version) FROM poses WHERE frame_id = f.frame_id)
LEFT JOIN anchors a ON a.section_id = f.section_id
  AND a.version = (SELECT max(version) FROM anchors WHERE section_id = f.section_id)
ORDER BY f.frame_id"""
_VIEWS = """
SELECT f.section_id, f.section_row, f.frame_id, v.farthest, a.T_world_section, p.T_section_frame
FROM frames f
JOIN views v ON v.frame_id = f.frame_id
JOIN poses p ON p.frame_id = f.frame_id
  AND p.version = (SELECT max(version) FROM poses WHERE frame_id = f.frame_id)
JOIN anchors a ON a.section_id = f.section_id
  AND a.version = (SELECT max(version) FROM anchors WHERE section_id = f.section_id)
WHERE f.section_id >= ? AND f.section_id < ? ORDER BY f.frame_id"""
_ADD_EVENT = """INSERT INTO events (time_ns, kind, text)
SELECT ?1, ?2, ?3 WHERE NOT EXISTS (SELECT 1 FROM events WHERE time_ns = ?1 AND kind = ?2 AND text = ?3)"""
_SECTION_COLUMNS = (
    "section_id, first_frame_id, num_frames, num_gaussians, camera, depth_scale_m, num_bytes, sha256, codec, state, "
    "next_sha256"
)


class Catalog:
    """An open catalogue; made by :meth:`create` or :meth:`open`, closed by :meth:`close`.

    Attributes:
        path: The file.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, *, writable: bool) -> None:
        self.path, self._connection, self._writable = path, connection, writable

    @classmethod
    def create(cls, path: Path) -> Self:
        """Make an empty catalogue where there is none.

        Raises:
            WriteFailed: The operating system refused.
        """
        assert not path.exists(), path
        return cls._opened(path, "rwc")

    @classmethod
    def open(cls, path: Path, *, writable: bool = False) -> Self:
        """Open a catalogue; for writing, one of an earlier version is brought to the present one.

        Raises:
            CatalogError: There is none, or it is damaged.
            UnsupportedVersion: A later program made it.
            BadMagic: It is a database of something else.
        """
        if not path.is_file():
            raise CatalogError(f"{path}: expected the catalogue of a run, found none")
        return cls._opened(path, "rw" if writable else "ro")

    @classmethod
    def _opened(cls, path: Path, mode: str) -> Self:
        with translated(path):
            connection = connected(path, mode)
        try:
            with translated(path):
                version = 0 if mode == "rwc" else check_version(connection, path)
                if mode != "ro":
                    connection.execute("PRAGMA journal_mode = WAL")
                    connection.execute("PRAGMA synchronous = FULL")
                    connection.execute("PRAGMA foreign_keys = ON")
                    migrate(connection, version)
        except BaseException:
            connection.close()
            raise
        return cls(path, connection, writable=mode != "ro")

    def close(self) -> None:
        """Give the file back; a writer leaves all in that one file."""
        if self._writable:
            with contextlib.suppress(sqlite3.Error):  # a full disk: what is in the log counts as well
                self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self._connection.close()

    def check(self) -> None:
        """Look at every page; raises CatalogError if the file is damaged."""
        (found,) = self._rows("PRAGMA integrity_check(1)")[0]
        if found != "ok":
            raise CatalogError(f"{self.path}: expected a whole catalogue, found {found}")

    # --- sections and their frames ----------------------------------------------------------------------------------

    def add_section(
        self, record: SectionRecord, row: SectionRow, frames: Sequence[FrameRow], *, resume: bytes | None = None
    ) -> None:
        """Enter a section whose file is durable, with its frames; all of it or nothing.

        Args:
            record: The section.
            row: The same with its file.
            frames: All its frames, in order.
            resume: What a run goes on from after it.

        Raises:
            RunFolderError: A fact of a frame has no JSON form.
            StorageError: It cannot be written.
        """
        assert [frame.frame_id for frame in frames] == record.frame_ids.tolist()
        facts = self._packed_facts(row.section_id, frames)
        with self._transaction() as db:
            db.execute(
                f"INSERT INTO sections ({_SECTION_COLUMNS}, resume) VALUES (?,?,?,?,?,?,?,?,?,?,?,?)",
                (*_section_values(row), resume),
            )
            db.execute("INSERT INTO anchors VALUES (?,0,?)", (row.section_id, packed_pose(record.T_world_section)))
            _insert_frames(db, row.section_id, frames, facts)
            poses = [(frame.frame_id, packed_pose(T)) for frame, T in zip(frames, record.T_section_frame, strict=True)]
            db.executemany("INSERT INTO poses VALUES (?,0,?)", poses)
            db.executemany("INSERT INTO views VALUES (?,?,?)", packed_views(record))

    def add_loose_frames(self, section_id: int, frames: Sequence[FrameRow]) -> None:
        """Enter the frames of a section that will never be on disk; raises as :meth:`add_section`."""
        facts = self._packed_facts(section_id, frames)
        with self._transaction() as db:
            _insert_frames(db, section_id, frames, facts)

    def _packed_facts(self, section_id: int, frames: Sequence[FrameRow]) -> list[str]:
        try:
            return [packed_facts(frame.facts) for frame in frames]
        except TypeError as error:
            text = f"{self.path}: facts of section {section_id} have no JSON form: {error}"
            raise RunFolderError(text) from error

    def sections(self) -> list[SectionRow]:
        """All sections, in order."""
        return [_section_row(row) for row in self._rows(f"SELECT {_SECTION_COLUMNS} FROM sections ORDER BY section_id")]

    def section(self, section_id: int) -> SectionRow | None:
        """A section; None if there is none."""
        rows = self._rows(f"SELECT {_SECTION_COLUMNS} FROM sections WHERE section_id = ?", section_id)
        return _section_row(rows[0]) if rows else None

    def resume_record(self, section_id: int) -> bytes | None:
        """What a run goes on from after a section; None if that was not kept."""
        rows = self._rows("SELECT resume FROM sections WHERE section_id = ?", section_id)
        return rows[0][0] if rows else None

    def frames(self) -> Iterator[FrameRow]:
        """The frames of all sections with their committed poses, in order."""
        for frame_id, time_ns, T_world, facts in self._each(_FRAMES):
            yield FrameRow(
                frame_id=frame_id,
                capture_time_ns=time_ns,
                T_world_camera=unpacked_pose(T_world),
                facts=json.loads(facts),
            )

    @property
    def num_frames(self) -> int:
        """Frames of all sections."""
        return int(self._rows("SELECT count(*) FROM frames")[0][0])

    @property
    def last_frame_id(self) -> int:
        """The last frame; -1 if there is none."""
        return int(self._rows("SELECT coalesce(max(frame_id), -1) FROM frames")[0][0])

    def totals(self) -> Totals:
        """Sums over all sections."""
        sections = "SELECT count(*), coalesce(sum(num_gaussians), 0), coalesce(sum(num_bytes), 0) FROM sections"
        count, gaussians, num_bytes = self._rows(sections)[0]
        states = self._rows("SELECT json_extract(facts, '$.state'), count(*) FROM quality GROUP BY 1")
        return Totals(
            frames=self.num_frames,
            sections=count,
            gaussians=gaussians,
            num_bytes=num_bytes,
            states={state: frames for state, frames in states if state is not None},
        )

    def drop_from(self, section_id: int) -> None:
        """Forget a section and all later ones, all at once; their files are the caller's to delete afterwards."""
        with self._transaction() as db:
            db.execute("DELETE FROM sections WHERE section_id >= ?", (section_id,))
            db.execute("DELETE FROM frames WHERE section_id >= ?", (section_id,))

    def set_missing(self, section_id: int) -> None:
        """Note that a section's file was set aside."""
        with self._transaction() as db:
            db.execute("UPDATE sections SET state = ? WHERE section_id = ?", (MISSING, section_id))

    def announce_file(self, section_id: int, sha256: bytes) -> None:
        """Note that a file with this checksum is about to take the place of a section's."""
        with self._transaction() as db:
            db.execute("UPDATE sections SET next_sha256 = ? WHERE section_id = ?", (sha256, section_id))

    def set_file(self, section_id: int, *, sha256: bytes, num_bytes: int, codec: str) -> None:
        """Note which file a section is in."""
        with self._transaction() as db:
            db.execute(
                "UPDATE sections SET sha256 = ?, num_bytes = ?, codec = ?, next_sha256 = NULL WHERE section_id = ?",
                (sha256, num_bytes, codec, section_id),
            )

    # --- poses ------------------------------------------------------------------------------------------------------

    def poses(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Capture times (ns) int64 [F] and newest ``T_world_camera`` float64 [F,4,4] of all frames.

        A pose that was never corrected is the committed one, bit for bit.
        """
        times, poses = [], []
        for _, time_ns, committed, anchor_version, anchor, pose_version, pose in self._each(_NEWEST):
            times.append(time_ns)
            corrected = (anchor_version or 0) > 0 or (pose_version or 0) > 0
            poses.append(unpacked_pose(anchor) @ unpacked_pose(pose) if corrected else unpacked_pose(committed))
        return np.array(times, np.int64), np.array(poses, np.float64).reshape(-1, 4, 4)

    def correct(self, T_world_section: Mapping[int, Pose], T_section_frame: Mapping[int, Pose]) -> int:
        """Add a version of anchors by section and poses by frame, all at once; its number."""
        with self._transaction() as db:
            (version,) = db.execute(
                "SELECT max(version) + 1 FROM (SELECT version FROM anchors UNION ALL SELECT version FROM poses)"
            ).fetchone()
            anchors = [(key, version, packed_pose(T)) for key, T in T_world_section.items()]
            db.executemany("INSERT INTO anchors VALUES (?,?,?)", anchors)
            poses = [(key, version, packed_pose(T)) for key, T in T_section_frame.items()]
            db.executemany("INSERT INTO poses VALUES (?,?,?)", poses)
        return int(version)

    # --- candidate views --------------------------------------------------------------------------------------------

    def views(self, first_section_id: int, end_section_id: int) -> Iterator[ViewFacts]:
        """The candidate views of a range of sections, in order."""
        of_section = {row.section_id: row for row in self.sections()}
        for section_id, section_row, frame_id, farthest, anchor, pose in self._each(
            _VIEWS, first_section_id, end_section_id
        ):
            yield ViewFacts(
                section_id=section_id,
                section_row=section_row,
                frame_id=frame_id,
                T_world_camera=unpacked_pose(anchor) @ unpacked_pose(pose),
                farthest=farthest,
                camera=of_section[section_id].camera,
                depth_scale_m=of_section[section_id].depth_scale_m,
            )

    def coarse_depth(self, frame_id: int) -> CoarseDepth | None:
        """The coarse depth of a candidate view; None if it is not one on disk."""
        rows = self._rows(
            "SELECT v.coarse, s.camera FROM views v JOIN frames f USING (frame_id) JOIN sections s USING (section_id) "
            "WHERE v.frame_id = ?",
            frame_id,
        )
        if not rows:
            return None
        camera = json.loads(rows[0][1])
        return CoarseDepth.unpacked(rows[0][0], width=camera["width"], height=camera["height"])

    # --- events -----------------------------------------------------------------------------------------------------

    def add_event(self, kind: str, text: str, *, time_ns: int | None = None) -> None:
        """Note that something happened: now, or at ``time_ns`` (Unix time), unless the same is noted already."""
        with self._transaction() as db:
            db.execute(_ADD_EVENT, (time_ns or time.time_ns(), kind, text))

    def events(self) -> list[Event]:
        """What happened, in order."""
        rows = self._rows("SELECT time_ns, kind, text FROM events ORDER BY event_id")
        return [Event(time_ns=time_ns, kind=kind, text=text) for time_ns, kind, text in rows]

    # --- parts ------------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """All of what is executed, durably, or nothing."""
        with translated(self.path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException:
                with contextlib.suppress(sqlite3.Error):  # a full disk has ended the transaction already
                    self._connection.execute("ROLLBACK")
                raise

    def _rows(self, sql: str, *values: object) -> list[Any]:
        with translated(self.path):
            return self._connection.execute(sql, values).fetchall()

    def _each(self, sql: str, *values: object) -> Iterator[Any]:
        with translated(self.path):
            yield from self._connection.execute(sql, values)


def _insert_frames(db: sqlite3.Connection, section_id: int, frames: Sequence[FrameRow], facts: Sequence[str]) -> None:
    rows = [
        (frame.frame_id, section_id, index, frame.capture_time_ns, packed_pose(frame.T_world_camera))
        for index, frame in enumerate(frames)
    ]
    db.executemany("INSERT INTO frames VALUES (?,?,?,?,?)", rows)
    quality = [(frame.frame_id, text) for frame, text in zip(frames, facts, strict=True)]
    db.executemany("INSERT INTO quality VALUES (?,?)", quality)


def _section_values(row: SectionRow) -> tuple[object, ...]:
    return (
        row.section_id,
        row.first_frame_id,
        row.num_frames,
        row.num_gaussians,
        json.dumps(row.camera.as_dict()),
        row.depth_scale_m,
        row.num_bytes,
        row.sha256,
        row.codec,
        row.state,
        row.next_sha256,
    )


def _section_row(values: Sequence[Any]) -> SectionRow:
    fields = dict(zip(_SECTION_COLUMNS.split(", "), values, strict=True))
    return SectionRow(**{**fields, "camera": Camera(**json.loads(fields["camera"]))})

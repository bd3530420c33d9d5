"""The tables of the catalogue, and how an earlier version becomes a later one."""

import sqlite3
from collections.abc import Sequence
from pathlib import Path

from vtslam.storage.errors import BadMagic, UnsupportedVersion

APPLICATION_ID = 0x76747363  # "vtsc", in the file's header

_FIRST = """
CREATE TABLE sections (
  section_id INTEGER PRIMARY KEY,
  first_frame_id INTEGER NOT NULL,
  num_frames INTEGER NOT NULL,
  num_gaussians INTEGER NOT NULL,
  camera TEXT NOT NULL,            -- JSON, the fields of Camera
  depth_scale_m REAL NOT NULL,
  num_bytes INTEGER NOT NULL,      -- of the file
  sha256 BLOB NOT NULL,            -- of the file, as in its footer
  codec TEXT NOT NULL,
  state TEXT NOT NULL CHECK (state IN ('stored', 'missing')),
  next_sha256 BLOB,                -- of a file that is about to take its place
  resume BLOB                      -- what a run goes on from after this section
);
CREATE TABLE anchors (
  section_id INTEGER NOT NULL REFERENCES sections ON DELETE CASCADE,
  version INTEGER NOT NULL,
  T_world_section BLOB NOT NULL,   -- float64 [4,4], row by row, little-endian; as all poses
  PRIMARY KEY (section_id, version)
) WITHOUT ROWID;
CREATE TABLE frames (
  frame_id INTEGER PRIMARY KEY,
  section_id INTEGER NOT NULL,     -- none of the table for frames of a section that never was finished
  section_row INTEGER NOT NULL,
  capture_time_ns INTEGER NOT NULL,
  T_world_committed BLOB NOT NULL  -- T_world_camera as it was committed
);
CREATE INDEX frames_by_section ON frames (section_id);
CREATE TABLE poses (
  frame_id INTEGER NOT NULL REFERENCES frames ON DELETE CASCADE,
  version INTEGER NOT NULL,
  T_section_frame BLOB NOT NULL,
  PRIMARY KEY (frame_id, version)
) WITHOUT ROWID;
CREATE TABLE quality (
  frame_id INTEGER PRIMARY KEY REFERENCES frames ON DELETE CASCADE,
  facts TEXT NOT NULL              -- JSON object: tracking state, losses, uncertainty, times
);
CREATE TABLE views (
  frame_id INTEGER PRIMARY KEY REFERENCES frames ON DELETE CASCADE,
  farthest INTEGER NOT NULL,       -- largest raw depth in the image
  coarse BLOB NOT NULL             -- CoarseDepth.packed
);
CREATE TABLE events (
  event_id INTEGER PRIMARY KEY,
  time_ns INTEGER NOT NULL,        -- Unix time
  kind TEXT NOT NULL,
  text TEXT NOT NULL
);
"""

MIGRATIONS: Sequence[str] = (_FIRST,)  # the n-th makes version n of version n-1; never changed once it was released


def check_version(connection: sqlite3.Connection, path: Path, migrations: Sequence[str] = MIGRATIONS) -> int:
    """The version of a catalogue.

    Raises:
        BadMagic: It is a database of something else.
        UnsupportedVersion: A later program made it.
    """
    (found,) = connection.execute("PRAGMA application_id").fetchone()
    if found != APPLICATION_ID:
        raise BadMagic.differing(path, "application id", expected=f"{APPLICATION_ID:#x}", found=f"{found:#x}")
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version > len(migrations):
        raise UnsupportedVersion(
            f"{path}: schema version: expected at most {len(migrations)}, found {version}; "
            "a later version of vtslam made it, and is needed to open it"
        )
    return int(version)


def migrate(connection: sqlite3.Connection, version: int, migrations: Sequence[str] = MIGRATIONS) -> None:
    """Bring a catalogue of ``version`` (0: an empty database) to the last one, all at once or not at all."""
    if version == len(migrations):
        return
    steps = "".join(migrations[version:])
    connection.executescript(
        f"BEGIN IMMEDIATE; {steps} PRAGMA application_id = {APPLICATION_ID}; "
        f"PRAGMA user_version = {len(migrations)}; COMMIT;"
    )

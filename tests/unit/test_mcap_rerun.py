"""Recordings held against another program's checks: rerun's, where it is installed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.mcap_bytes import frames, write_recording

from vtslam.storage.recording import topics
from vtslam.storage.recording import writer as writer_module

_LIMIT_S = 120.0
_TOPICS = (
    topics.COLOR,
    topics.DEPTH,
    topics.CALIBRATION,
    topics.PRIOR,
    topics.POSE,
    topics.TRANSFORMS,
    topics.EVENTS,
)


def _rerun(*words: str, home: Path) -> str:
    """What ``rerun`` says, its colours left out; fails unless it is content. Skips the test where it is missing."""
    program = shutil.which("rerun", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
    if program is None:
        pytest.skip("needs the program rerun (rerun-sdk), which is not installed")
    environment = {**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": str(home), "NO_COLOR": "1"}
    done = subprocess.run([program, *words], env=environment, capture_output=True, text=True, timeout=_LIMIT_S)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def _checked_topics(report: str) -> dict[str, str]:
    """Status by topic, of the table that ``rerun mcap check`` prints."""
    rows = [line.split() for line in report.splitlines()]
    return {row[3]: row[0] for row in rows if len(row) > 3 and row[3].startswith("/")}


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(writer_module, "CHUNK_BYTES", 12_000)  # a few frames
    return write_recording(tmp_path / "x.mcap", frames(12, priors=True))


def test_rerun_finds_nothing_wrong(recording: Path, tmp_path: Path) -> None:
    report = _rerun("mcap", "check", "--full", str(recording), home=tmp_path)
    assert _checked_topics(report) == dict.fromkeys(_TOPICS, "ok")


def test_rerun_converts_it(recording: Path, tmp_path: Path) -> None:
    converted = tmp_path / "x.rrd"
    said = _rerun("mcap", "convert", str(recording), "-o", str(converted), home=tmp_path)
    assert all(topic in said for topic in _TOPICS)
    assert "ERROR" not in said
    assert "verified without error" in _rerun("rrd", "verify", str(converted), home=tmp_path)


def test_rerun_recovers_one_that_was_cut(recording: Path, tmp_path: Path) -> None:
    data = recording.read_bytes()
    recording.write_bytes(data[: len(data) * 2 // 3])
    report = _rerun("mcap", "check", "--full", "--recover", str(recording), home=tmp_path)
    assert _checked_topics(report).get(topics.COLOR) == "ok"
    assert set(_checked_topics(report).values()) == {"ok"}

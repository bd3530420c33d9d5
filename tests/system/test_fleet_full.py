"""A fleet whose ``/dev/shm`` is too small for one section: a reason and an end in order, never a signal."""

import re
from pathlib import Path

import pytest
from helpers.fleet_runs import SmallRecording
from helpers.forks import run_script
from helpers.small_tmpfs import can_mount, mounting

from vtslam.storage.run_folder import RunFolder


@pytest.mark.parametrize(
    ("size", "error", "frames"),
    [("64k", "SourceError: .*/.new-[0-9a-f]+-ring", 0), ("1300k", "ProcessRefused: .*/map/active-000000/", 1)],
)
def test_a_file_system_that_is_too_small(
    size: str, error: str, frames: int, small: SmallRecording, tmp_path: Path
) -> None:
    base = tmp_path / "shm"
    base.mkdir()
    if not can_mount(base):
        pytest.skip("this user may not mount a tmpfs in a namespace of its own")
    words = (str(base), str(small.files.folder), str(tmp_path / "run"))
    told = run_script("fleet_full", *words, prefix=mounting(base, size=size))

    assert (told["events"], told["running"], told["left"]) == ([], [], [])
    assert re.match(rf"{error}.*: \d+ bytes of shared memory wanted, \d+ free$", told["error"])
    with RunFolder.open(tmp_path / "run") as run:
        facts = run.read_info().facts
    assert (facts.finished, facts.frames >= frames) == (False, True)

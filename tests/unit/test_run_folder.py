"""Run folders: made only where that loses nothing, written by one process at a time, readable after a crash."""

import fcntl
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import small_runs
from helpers.sections import assert_same_section, frames_of, small_section

from vtslam.storage import run_folder
from vtslam.storage.errors import MalformedSection, RunFolderError, RunLocked, UnreadableFile, WriteFailed
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_file import write_section

INFO = replace(
    small_runs.INFO,
    settings={"seed": 2, "tracker": {"optimizer": "gauss_newton", "weights": [1.0, 0.5]}},
    versions={"vtslam": "0.1.0", "numpy": "2.4"},
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "a"


# --- making and opening ----------------------------------------------------------------------------------------------


def test_new_folder(path: Path) -> None:
    with RunFolder.create(path, INFO) as run:
        assert run.read_info() == INFO
    assert RunFolder.open(path).read_info() == INFO
    assert sorted(entry.name for entry in path.iterdir()) == ["catalog.sqlite", "lock", "run.toml", "sections"]


def test_info_is_the_same_text_each_time(tmp_path: Path) -> None:
    other = replace(INFO, versions={name: INFO.versions[name] for name in reversed(list(INFO.versions))})
    RunFolder.create(tmp_path / "a", INFO).close()
    RunFolder.create(tmp_path / "b", other).close()
    assert (tmp_path / "a/run.toml").read_bytes() == (tmp_path / "b/run.toml").read_bytes()


def test_empty_folder_is_used(path: Path) -> None:
    path.mkdir(parents=True)
    RunFolder.create(path, INFO).close()
    assert RunFolder.open(path).read_info() == INFO


def test_what_a_crash_while_making_leaves_is_used(path: Path) -> None:
    (path / "sections").mkdir(parents=True)
    (path / "lock").write_text("1\n")
    (path / ".run.toml.0123abcd.tmp").write_text("half")
    RunFolder.create(path, INFO).close()
    assert sorted(entry.name for entry in path.iterdir()) == ["catalog.sqlite", "lock", "run.toml", "sections"]


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["holiday.jpg", "sections/000000.vts"])
def test_folder_of_something_else_is_refused(path: Path, name: str, overwrite: bool) -> None:
    (path / name).parent.mkdir(parents=True)
    (path / name).write_text("precious")
    with pytest.raises(RunFolderError, match="not empty and not a run folder"):
        RunFolder.create(path, INFO, overwrite=overwrite)
    assert (path / name).read_text() == "precious"
    assert not (path / "lock").exists()


def test_file_in_the_way(path: Path) -> None:
    path.parent.mkdir(parents=True)
    path.write_text("precious")
    with pytest.raises(RunFolderError, match="expected a folder or nothing, found a file"):
        RunFolder.create(path, INFO, overwrite=True)
    with pytest.raises(WriteFailed, match="cannot write: Not a directory"):
        RunFolder.create(path / "deeper", INFO)
    assert path.read_text() == "precious"


def test_run_is_overwritten_only_when_asked(path: Path) -> None:
    with RunFolder.create(path, INFO) as run:
        record = small_section()
        run.write_section(record)
        run.commit_section(record, frames_of(record))
        assert len(run.trajectory_path.read_text().splitlines()) == 3
    (path / "metrics.json").write_text("{}")
    (path / "notes.txt").write_text("mine")
    with pytest.raises(RunFolderError, match="there is already a run here; choose another folder or ask to overwrite"):
        RunFolder.create(path, INFO)
    assert RunFolder.open(path).section_ids() == [7]

    other = replace(INFO, facts=replace(INFO.facts, source="sim:room?seed=4"))
    RunFolder.create(path, other, overwrite=True).close()
    run = RunFolder.open(path)
    assert run.read_info() == other
    assert run.section_ids() == []
    assert sorted(entry.name for entry in path.iterdir()) == [
        "catalog.sqlite",
        "lock",
        "notes.txt",
        "run.toml",
        "sections",
    ]


def test_opening_what_is_no_run(path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"not a run folder: expected .*/a/run\.toml, found none"):
        RunFolder.open(path)


def test_opening_for_writing_sweeps_unfinished_files(path: Path) -> None:
    RunFolder.create(path, INFO).close()
    leftovers = [path / ".run.toml.00.tmp", path / "sections" / ".000003.vts.00.tmp"]
    for leftover in leftovers:
        leftover.write_text("half")
    RunFolder.open(path)
    assert all(leftover.exists() for leftover in leftovers)
    RunFolder.open(path, writable=True).close()
    assert not any(leftover.exists() for leftover in leftovers)


# --- one writer ------------------------------------------------------------------------------------------------------


def test_second_writer_is_refused_and_told_who_is_first(path: Path) -> None:
    with RunFolder.create(path, INFO) as run:
        told = rf"another process is writing this run \(process {os.getpid()}\)"
        with pytest.raises(RunLocked, match=told):
            RunFolder.open(path, writable=True)
        with pytest.raises(RunLocked, match=told):
            RunFolder.create(path, INFO, overwrite=True)
        run.write_section(small_section())
        assert RunFolder.open(path).section_ids() == [7]
    RunFolder.open(path, writable=True).close()


def test_run_made_between_look_and_lock_is_kept(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow_lock(folder: Path) -> int:
        monkeypatch.undo()
        with RunFolder.create(folder, INFO) as first:
            first.write_section(small_section())
        return run_folder._take_lock(folder)

    monkeypatch.setattr(run_folder, "_take_lock", slow_lock)
    with pytest.raises(RunFolderError, match="there is already a run here"):
        RunFolder.create(path, INFO)
    with RunFolder.open(path, writable=True) as run:
        assert run.section_ids() == [7]


def test_lock_ends_with_its_process(path: Path) -> None:
    RunFolder.create(path, INFO).close()
    code = (
        "import os, sys; from pathlib import Path; from vtslam.storage.run_folder import RunFolder\n"
        "run = RunFolder.open(Path(sys.argv[1]), writable=True); os.kill(os.getpid(), 9)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run([sys.executable, "-c", code, str(path)], env=environment, check=False).returncode == -9
    RunFolder.open(path, writable=True).close()


def test_lock_is_a_plain_file_lock(path: Path) -> None:
    RunFolder.create(path, INFO).close()
    with (path / "lock").open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(RunLocked, match="another process"):
            RunFolder.open(path, writable=True)


def test_reader_cannot_write(path: Path) -> None:
    RunFolder.create(path, INFO).close()
    run = RunFolder.open(path)
    with pytest.raises(RunFolderError, match="open for reading only"):
        run.write_section(small_section())
    with pytest.raises(RunFolderError, match="open for reading only"):
        run.commit_section(small_section(), frames_of(small_section()))
    with pytest.raises(RunFolderError, match="open for reading only"):
        run.drop_sections(0)
    with pytest.raises(RunFolderError, match="open for reading only"):
        run.write_info(INFO)


# --- content ---------------------------------------------------------------------------------------------------------


def test_sections(path: Path) -> None:
    with RunFolder.create(path, INFO) as run:
        for section_id in (12, 3, 1_000_000):
            written = run.write_section(small_section(section_id=section_id))
            assert written == path / "sections" / f"{section_id:06d}.vts"
        (path / "sections" / "0000012.vts").write_text("a name that no section has")
        (path / "sections" / "notes.txt").write_text("mine")
        assert run.section_ids() == [3, 12, 1_000_000]
        assert_same_section(run.read_section(12), small_section(section_id=12))


def test_finished_section_never_changes(path: Path) -> None:
    with RunFolder.create(path, INFO) as run:
        run.write_section(small_section())
        with pytest.raises(RunFolderError, match="section 7 is already written; it never changes"):
            run.write_section(small_section(num_gaussians=3))
        assert_same_section(run.read_section(7), small_section())


def test_missing_and_misplaced_sections(path: Path) -> None:
    with RunFolder.create(path, INFO) as run:
        with pytest.raises(UnreadableFile, match=r"000004\.vts: cannot open"):
            run.read_section(4)
        write_section(run.section_path(4), small_section(section_id=5))
        with pytest.raises(MalformedSection, match="section_id: expected 4, found 5"):
            run.read_section(4)


def test_finished_mark(path: Path) -> None:
    finished = replace(INFO, facts=replace(INFO.facts, finished=True, end_frame=41))
    with RunFolder.create(path, INFO) as run:
        run.write_info(finished)
    assert RunFolder.open(path).read_info() == finished


def test_facts_of_frames(path: Path) -> None:
    record = small_section(section_id=0)
    facts: list[dict[str, Any]] = [
        {"frame_id": np.int64(30), "loss": np.float32(0.5)},
        {"frame_id": 31, "x": [float("nan"), {"y": np.inf}]},
        {"frame_id": 33},
    ]
    with RunFolder.create(path, INFO) as run:
        run.write_section(record)
        with pytest.raises(RunFolderError, match=r"facts of section 0 have no JSON form: .*bytes"):
            run.commit_section(record, frames_of(record, [{}, {"a": b"x"}, {}]))
        assert run.read_frames() == []
        run.commit_section(record, frames_of(record, facts))
        expected = [{"frame_id": 30, "loss": 0.5}, {"frame_id": 31, "x": [None, {"y": None}]}, {"frame_id": 33}]
        assert run.read_frames() == expected


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format = 1", "format = 2", r"run\.toml: format: expected 1, found 2"),
        ("format = 1", "", r"run\.toml: format: expected 1, found none"),
        (
            "[versions]",
            "[version]",
            r"expected format, \[run\], \[versions\] and \[settings\], found ",
        ),
        ('numpy = "2.4"', "numpy = 2.4", r"versions\.numpy: expected a string, found 2\.4"),
        ("width = 6", "width = -1", r"run\.toml \[run\]: width = -1: expected an integer >= 0"),
        ("width = 6", "widht = 320", r"widht = 320: unknown key; did you mean width\?"),
        ("width = 6\n", "", "width: no value given; expected an integer >= 0"),
        ("end_frame = 60", "end_frame = -1", r"end_frame = -1: expected an integer >= 0"),
        ("first_frame = 0", "first_frame = 61", "frames: expected first_frame <= end_frame, found 61:60"),
        ('source = "sim', 'source = "sim\n', r"run\.toml:\d+: not TOML: "),
    ],
)
def test_damaged_info(path: Path, old: str, new: str, message: str) -> None:
    RunFolder.create(path, INFO).close()
    text = (path / "run.toml").read_text()
    assert old in text
    (path / "run.toml").write_text(text.replace(old, new))
    with pytest.raises(RunFolderError, match=message):
        RunFolder.open(path).read_info()

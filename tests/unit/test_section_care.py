"""Damaged, missing and swapped section files are told of, set aside, and harm nothing else."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.small_runs import check_whole, result_bytes, section_record, small_run

from vtslam.services.cli.__main__ import main
from vtslam.storage import section_care
from vtslam.storage.atomic import rename_file
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.errors import ChecksumMismatch, UnreadableFile
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_codecs import SectionCodec, codec_of_header
from vtslam.storage.section_facts import file_facts
from vtslam.storage.section_file import read_columns, write_section
from vtslam.storage.section_record import SectionRecord


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return small_run(tmp_path / "run", 4)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-9])


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)


def swap(file: Path) -> None:
    other = file.with_name("000002.vts")
    mine = file.read_bytes()
    file.write_bytes(other.read_bytes())
    other.write_bytes(mine)


def delete(file: Path) -> None:
    file.unlink()


HARMS: list[tuple[Callable[[Path], None], list[int], str]] = [
    (cut, [1], "000001.vts: (CRC-32 of footer|size in bytes): expected"),
    (flip, [1], "000001.vts: .*CRC-32 of column"),
    (swap, [1, 2], "000001.vts: SHA-256: expected"),
    (delete, [1], "000001.vts: cannot open: No such file"),
]


@pytest.mark.parametrize(("harm", "harmed", "message"), HARMS, ids=lambda value: getattr(value, "__name__", ""))
def test_what_is_wrong_is_told_and_set_aside(
    harm: Callable[[Path], None], harmed: list[int], message: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sections", "verify", str(path)]) == 0
    assert "4 sections, 0 problems" in capsys.readouterr().out
    before = result_bytes(path)
    harm(path / "sections" / "000001.vts")
    left = {file.name: file.read_bytes() for file in (path / "sections").iterdir()}

    assert main(["sections", "verify", str(path), "--json", "-"]) == 1
    told = capsys.readouterr()
    problems = json.loads(told.out)["problems"]
    assert [problem["section_id"] for problem in problems] == harmed
    assert re.search(message, problems[0]["problem"])
    assert f"vtslam sections repair {path}" in told.err

    assert main(["sections", "repair", str(path), "--json", "-"]) == 1
    told = capsys.readouterr()
    assert json.loads(told.out)["missing"] == harmed
    assert f"vtslam run --resume {path}" in told.err
    for section_id in {0, 1, 2, 3} - set(harmed):
        name = f"{section_id:06d}.vts"
        assert (path / "sections" / name).read_bytes() == before[name]
    for section_id in harmed:
        if harm is not delete:
            assert (path / "damaged" / f"{section_id:06d}-0.vts").read_bytes() == left[f"{section_id:06d}.vts"]
    assert main(["sections", "ls", str(path)]) == 0
    assert capsys.readouterr().out.count("missing") >= len(harmed)


def test_repair_brings_what_was_cut_off_in_order(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = result_bytes(path)
    write_section(path / "sections" / "000004.vts", section_record(4))  # never came to the catalogue
    (path / "trajectory.txt").write_bytes(before["trajectory.txt"][:-20])
    (path / "sections" / ".000005.vts.0123.tmp").write_bytes(b"half")

    assert main(["sections", "repair", str(path)]) == 0
    told = capsys.readouterr().out
    assert "000004.vts: not in the catalogue" in told
    assert "trajectory.txt: made anew" in told
    assert result_bytes(path) == before
    assert (path / "damaged" / "000004-0.vts").exists()
    assert main(["sections", "verify", str(path)]) == 0
    assert main(["sections", "repair", str(path)]) == 0
    assert "0 repairs" in capsys.readouterr().out


def test_repacking_gives_the_same_sections(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = result_bytes(path)
    held = sum(len(before[f"00000{i}.vts"]) for i in range(4))
    for codec in ("raw", "lossless"):
        assert main(["sections", "repack", str(path), "--codec", codec, "--json", "-"]) == 0
        values = json.loads(capsys.readouterr().out)
        assert (values["sections"], values["codec"], values["bytes_before"]) == (4, codec, held)
        held = sum(file.stat().st_size for file in (path / "sections").iterdir())
        assert values["bytes_after"] == held
        assert main(["sections", "verify", str(path)]) == 0
        capsys.readouterr()
    assert result_bytes(path) == before
    assert main(["sections", "repack", str(path), "--codec", "zip"]) == 2
    assert "--codec: expected one of raw, lossless, fast, dense, found 'zip'" in capsys.readouterr().err


class _CutOff(Exception):
    """Stands for the end of the process."""


@pytest.mark.parametrize("point", ["write", "announce_file", "rename_file", "set_file"])
@pytest.mark.parametrize("after", [False, True])
def test_repacking_that_is_cut_off_leaves_one_whole_file(
    point: str, after: bool, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def other_section(file: Path, record: SectionRecord, codec: SectionCodec, grid: DenseGrid | None) -> None:
        write_section(file, record, "raw")

    def cut_off(function: Callable[..., object]) -> Callable[..., object]:
        def cut_off_function(*args: object, **keywords: object) -> None:
            if after:
                function(*args, **keywords)
            raise _CutOff

        return cut_off_function

    with RunFolder.open(path, writable=True) as run:
        write = other_section
        if point == "write":
            write = cut_off(other_section)  # type: ignore[assignment]
        elif point == "rename_file":
            monkeypatch.setattr(section_care, point, cut_off(rename_file))
        else:
            monkeypatch.setattr(type(run.catalog), point, cut_off(getattr(type(run.catalog), point)))
        with pytest.raises(_CutOff):
            section_care.repack(run, 1, codec="raw", write=write)
        monkeypatch.undo()
        row = run.catalog.section(1)
        assert row is not None
        if file_facts(run.section_path(1)).sha256 != row.sha256:
            with pytest.raises(ChecksumMismatch, match=rf"\(vtslam sections repair {path} brings it in order\)$"):
                section_care.require_intact(run, row)
        section_care.repair(run)
        row = run.catalog.section(1)
        assert row is not None
        assert row.codec == codec_of_header(read_columns(run.section_path(1), [])[0])
        section_care.require_intact(run, row)
        assert list((path / "sections").glob(".*")) == []
    assert check_whole(path, at_least=4) == 4


def test_only_sections_on_disk_are_repacked(path: Path) -> None:
    with RunFolder.open(path, writable=True) as run:
        with pytest.raises(UnreadableFile, match="expected a section on disk, found none"):
            section_care.repack(run, 9, codec="raw")
        flip(run.section_path(2))
        with pytest.raises(ChecksumMismatch):
            section_care.repack(run, 2, codec="raw")

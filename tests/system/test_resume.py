"""A run that was cut off goes on, and leaves the bytes of an undisturbed one."""

import json
import os
import signal
import sqlite3
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from random import Random

import pytest
from helpers.cli_runs import start_vtslam, wait_for
from helpers.fleet_runs import (
    ASSIGNMENTS,
    FRAMES,
    SECTION,
    CutOff,
    Disturbance,
    SmallRecording,
    cut_off_at,
    result_bytes,
    small_plan,
)
from helpers.forks import run_script
from helpers.processes import leftovers
from helpers.recordings import cut_in_half
from helpers.small_runs import small_run
from helpers.small_tmpfs import can_mount, mounting

from vtslam.common.fleet_folder import sweep_dead_fleets
from vtslam.services.cli.__main__ import main
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.process_facts import children_of
from vtslam.services.run_plan import plan_resume
from vtslam.services.sensor.sources.base import SourceError
from vtslam.storage import section_care
from vtslam.storage.errors import ChecksumMismatch, RunFolderError, RunLocked, UnreadableFile
from vtslam.storage.run_folder import RunFolder

_CATALOG_BYTES = 280_000  # with its log, and what else a run of some frames takes


@pytest.mark.parametrize("seed", range(4))
def test_cut_off_at_random_frames_again_and_again(seed: int, small: SmallRecording, tmp_path: Path) -> None:
    run, rng = tmp_path / "run", Random(seed)
    with pytest.raises(CutOff):
        small_plan(small.files).execute(run, on_frame=cut_off_at(rng.randrange(FRAMES)))
    for _ in range(2):
        durable = RunFolder.open(run).catalog.num_frames
        if durable < FRAMES:
            with pytest.raises(CutOff):
                plan_resume(run).resume(run, on_frame=cut_off_at(rng.randrange(durable, FRAMES)))
        assert RunFolder.open(run).catalog.num_frames >= durable
    seen: list[int] = []
    summary = plan_resume(run).resume(run, on_frame=lambda facts: seen.append(facts.frame_id))

    assert result_bytes(run) == small.undisturbed
    assert seen == list(range(FRAMES - len(seen), FRAMES))
    assert (summary.frames, summary.sections) == (FRAMES, 4)
    with RunFolder.open(run) as folder:
        assert folder.read_info().facts.finished
        assert [row["frame_id"] for row in folder.read_frames()] == list(range(FRAMES))
        kinds = [event.kind for event in folder.catalog.events()]
    assert kinds == ["resumed"] * (len(kinds) - 1) + ["finished"]


def test_a_run_in_one_process_goes_on_in_a_fleet(small: SmallRecording, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(CutOff):
        small_plan(small.files).execute(run, on_frame=cut_off_at(2 * SECTION + 1))
    again = Disturbance(frames=2 * SECTION)
    summary = plan_resume(run).resume_in_fleet(run, again.hooks())

    assert result_bytes(run) == small.undisturbed
    assert (again.frames, summary.frames, summary.sections) == (FRAMES, FRAMES, 4)


def test_a_fleet_killed_as_a_whole_goes_on_twice(small: SmallRecording, tmp_path: Path) -> None:
    run, words = tmp_path / "run", [word for each in ASSIGNMENTS for word in ("--set", each)]
    commands = [["run", small.files.uri, "--out", str(run), "--family", "tum", *words], ["run", "--resume", str(run)]]
    for command, section_id in zip(commands, (0, 2), strict=True):
        process = start_vtslam(*command)
        try:
            wait_for(run / "sections" / f"{section_id:06d}.vts", process)
            for pid in (process.pid, *children_of(process.pid)):
                os.kill(pid, signal.SIGKILL)
        finally:
            process.kill()
            process.communicate()
    assert main(["sections", "repair", str(run)]) == 0
    assert RunFolder.open(run).catalog.num_frames >= 2 * SECTION
    assert main(["run", "--resume", str(run), "--json", str(tmp_path / "summary.json")]) == 0

    assert result_bytes(run) == small.undisturbed
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == FRAMES
    assert main(["sections", "verify", str(run)]) == 0
    sweep_dead_fleets()
    assert leftovers() == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run"], "run: expected SOURCE and --out RUN, or --resume RUN"),
        (["run", "sim:room"], "run: expected SOURCE and --out RUN, or --resume RUN"),
        (["run", "sim:room", "--resume", "RUN"], "goes on with the run's own source and settings"),
        (["run", "--resume", "RUN", "--holdout", "3"], "goes on with the run's own source and settings"),
        (["run", "--resume", "RUN", "--preset", "fast"], "goes on with the run's own source and settings"),
        (["run", "--resume", "RUN", "--family", "kitti"], "goes on with the run's own source and settings"),
        (["run", "--resume", "RUN", "--record", "x.mcap"], "a run that records goes on recording"),
    ],
)
def test_arguments_that_do_not_go_together(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    assert message in capsys.readouterr().err


def test_a_full_disk_ends_the_run_in_words_and_resume_finishes_it(small: SmallRecording, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if not can_mount(disk):
        pytest.skip("this user may not mount a tmpfs in a namespace of its own")
    one_section = len(small.undisturbed["000000.vts"])
    enough_for_two = f"{(2 * one_section + _CATALOG_BYTES) // 1024}k"
    found = run_script("disk_full", str(disk), str(small.files.folder), prefix=mounting(disk, size=enough_for_two))

    assert (found["status"], found["resumed"]) == (1, 0)
    refused = [line for line in found["told"] if "cannot write: " in line]
    assert "no space left on" in refused[-1].lower()
    assert refused[-1].endswith(f"what was stored is kept: vtslam run --resume {disk / 'run'}")
    assert SECTION <= found["durable"] < FRAMES
    assert found["files"] == {name: sha256(data).hexdigest() for name, data in small.undisturbed.items()}


def test_a_run_that_was_set_aside_in_part_is_mapped_again_from_there(small: SmallRecording, tmp_path: Path) -> None:
    run = tmp_path / "run"
    small_plan(small.files).execute(run)
    cut_in_half(run / "sections" / "000001.vts")
    assert main(["sections", "repair", str(run)]) == 1
    assert main(["run", "--resume", str(run), "--in-process"]) == 0

    assert result_bytes(run) == small.undisturbed
    assert (run / "damaged" / "000001-0.vts").exists()


def test_a_run_that_publishers_fed_cannot_be_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = small_run(tmp_path / "run", 1)
    with RunFolder.open(path, writable=True) as run:
        info = run.read_info()
        run.write_info(replace(info, facts=replace(info.facts, source="live:")))
    assert main(["run", "--resume", str(path)]) == 1
    assert "publishers fed this run, and their frames are gone" in capsys.readouterr().err


def test_a_run_that_dropped_frames_cannot_be_resumed(small: SmallRecording, tmp_path: Path) -> None:
    plan = small_plan(small.files, "fleet.pacing='realtime'")
    RunFolder.create(tmp_path / "run", plan.info()).close()
    with pytest.raises(RunFolderError, match="dropped frames to keep up with time; it cannot be resumed"):
        plan_resume(tmp_path / "run")


def test_sections_that_ended_after_a_distance_are_kept_and_cut_off_ones_are_not(
    small: SmallRecording, tmp_path: Path
) -> None:
    calm, run = tmp_path / "calm", tmp_path / "run"
    plan = small_plan(small.files, "section.length_m=0.06")
    plan.execute(calm)
    lengths = [row.num_frames for row in RunFolder.open(calm).catalog.sections()]
    assert min(lengths[:-1]) < SECTION
    durable = sum(lengths[:-2])
    seen: list[int] = []
    stopped = plan.execute(
        run, on_frame=lambda facts: seen.append(facts.frame_id), should_stop=lambda: len(seen) > durable
    )
    assert (stopped.interrupted, stopped.frames) == (True, durable + 1)
    again = Disturbance(frames=durable)
    plan_resume(run).resume_in_fleet(run, again.hooks())

    assert result_bytes(run) == result_bytes(calm) != small.undisturbed
    assert again.frames == FRAMES


def test_a_finished_run_is_left_as_it_is(small: SmallRecording, tmp_path: Path) -> None:
    run = tmp_path / "run"
    first = small_plan(small.files).execute(run)
    again, in_fleet = plan_resume(run).resume(run), plan_resume(run).resume_in_fleet(run, Disturbance().hooks())

    assert first == again == in_fleet
    assert result_bytes(run) == small.undisturbed


def test_a_frame_that_could_not_be_read_is_read_when_it_can_be(small: SmallRecording, tmp_path: Path) -> None:
    run, path = tmp_path / "run", small.files.color_path(SECTION + 2)
    whole = path.read_bytes()
    plan = small_plan(small.files)
    cut_in_half(path)
    try:
        with pytest.raises(SourceError, match=path.name):
            plan.execute(run)
    finally:
        path.write_bytes(whole)
    plan_resume(run).resume(run)

    assert result_bytes(run) == small.undisturbed


def test_another_recording_in_its_place_is_refused(small: SmallRecording, tmp_path: Path) -> None:
    run, path, other = tmp_path / "run", small.files.color_path(SECTION - 1), small.files.color_path(0)
    with pytest.raises(CutOff):
        small_plan(small.files).execute(run, on_frame=cut_off_at(SECTION))
    whole = path.read_bytes()
    path.write_bytes(other.read_bytes())
    try:
        with pytest.raises(RunFolderError, match=r"frame 5 of replica:.* is not the one that was mapped"):
            plan_resume(run).resume(run)
    finally:
        path.write_bytes(whole)


def _stopped_after(frames: int, small: SmallRecording, run: Path) -> None:
    """A run that was asked to stop there; its last section is kept as far as it came."""
    seen: list[int] = []
    small_plan(small.files).execute(
        run, on_frame=lambda facts: seen.append(facts.frame_id), should_stop=lambda: len(seen) >= frames
    )


@pytest.mark.parametrize("harm", ["another frame", "no frame", "nothing to go on from"])
def test_a_resumption_that_is_refused_takes_nothing_away(harm: str, small: SmallRecording, tmp_path: Path) -> None:
    run, path = tmp_path / "run", small.files.color_path(SECTION - 1)
    _stopped_after(SECTION + 2, small, run)  # the second section would be dropped, and mapped again
    (run / "metrics.json").write_text("{}")
    kept, whole = result_bytes(run), path.read_bytes()
    assert len(kept) == 3
    try:
        if harm == "another frame":
            path.write_bytes(small.files.color_path(0).read_bytes())
        elif harm == "no frame":
            cut_in_half(path)
        else:
            with sqlite3.connect(run / "catalog.sqlite") as catalog:
                catalog.execute("UPDATE sections SET resume = NULL")
            catalog.close()
        with pytest.raises((RunFolderError, SourceError)):
            plan_resume(run).resume(run)
    finally:
        path.write_bytes(whole)
    assert result_bytes(run) == kept
    assert RunFolder.open(run).catalog.num_frames == SECTION + 2
    assert (run / "metrics.json").exists()


def test_a_run_goes_on_from_what_it_mapped_only(
    small: SmallRecording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    _stopped_after(SECTION, small, run)
    kept = result_bytes(run)
    assert main(["sections", "repack", str(run)]) == 1
    assert "--codec dense rounds: expected a finished run, found one that may go on; finish it first (vtslam run " in (
        capsys.readouterr().err
    )
    assert result_bytes(run) == kept
    assert main(["sections", "repack", str(run), "--codec", "raw"]) == 0
    with RunFolder.open(run, writable=True) as folder:
        section_care.repack(folder, 0, codec="dense")
    with pytest.raises(RunFolderError, match=r"000000\.vts: expected what was mapped, .*rounded by the codec dense"):
        plan_resume(run).resume(run)
    assert RunFolder.open(run).catalog.num_frames == SECTION


def test_a_finished_run_may_be_rounded_and_is_left_so(small: SmallRecording, tmp_path: Path) -> None:
    run = tmp_path / "run"
    small_plan(small.files).execute(run)
    assert main(["sections", "repack", str(run)]) == 0
    packed = result_bytes(run)
    plan_resume(run).resume(run)
    assert {row.codec for row in RunFolder.open(run).catalog.sections()} == {"dense"}
    assert result_bytes(run) == packed


def test_two_fleets_on_one_run_folder_are_refused(small: SmallRecording, tmp_path: Path) -> None:
    run, told = tmp_path / "run", []

    def try_another(facts: FrameFacts) -> None:
        if facts.frame_id == SECTION:
            with pytest.raises(RunLocked, match="another process is writing this run"):
                plan_resume(run).resume_in_fleet(run, Disturbance().hooks())
            with pytest.raises(RunLocked, match="another process is writing this run"):
                small_plan(small.files).execute(run, overwrite=True)
            told.append(facts.frame_id)

    small_plan(small.files).execute(run, on_frame=try_another)
    assert told == [SECTION]
    assert result_bytes(run) == small.undisturbed


@pytest.mark.parametrize("harm", ["cut", "deleted", "swapped"])
def test_damaged_sections_are_named_before_anything_is_mapped(harm: str, small: SmallRecording, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(CutOff):
        small_plan(small.files).execute(run, on_frame=cut_off_at(2 * SECTION))
    first, second = run / "sections" / "000000.vts", run / "sections" / "000001.vts"
    kept = second.read_bytes()
    if harm == "cut":
        cut_in_half(first)
    elif harm == "deleted":
        first.unlink()
    else:
        first.write_bytes(kept)
    with pytest.raises((ChecksumMismatch, UnreadableFile), match=r"000000\.vts: .*(expected|cannot open)"):
        plan_resume(run).resume(run)
    assert second.read_bytes() == kept
    assert RunFolder.open(run).catalog.num_frames == 2 * SECTION

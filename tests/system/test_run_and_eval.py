"""A tiny recording through the command line: what it leaves, twice the same, and what it is worth."""

import json
import os
import shutil
import sqlite3
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recordings import cut_in_half, write_replica

from vtslam.common import metrics
from vtslam.common.trajectory_io import read_trajectory
from vtslam.services.cli.__main__ import main
from vtslam.services.evaluation import evaluate_run
from vtslam.services.film import write_film
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.run_view import show_run
from vtslam.services.viewer.parts import Part
from vtslam.storage.catalog import Catalog
from vtslam.storage.errors import RunFolderError
from vtslam.storage.run_folder import RunFolder

FRAMES, LENGTH, HOLDOUT = 12, 5, 2
SMALL = ("--in-process", "--size", "64x48", "--set", f"section.length={LENGTH}")
METRICS = {
    "ate_rmse_m",
    "ate_mean_m",
    "rpe_trans_rmse_m",
    "rpe_rot_rmse_deg",
    "psnr_paper_db",
    "psnr_valid_db",
    "psnr_full_db",
    "psnr_heldout_db",
    "psnr_next_db",
    "psnr_last_db",
    "seam_db",
    "ssim_paper",
    "ms_ssim_paper",
    "depth_l1_m",
    "frames",
    "gaussians",
    "sections",
    "seconds_per_frame",
    "renders_per_frame",
    "peak_rss_mb",
    "per_frame",
}


def run_room(out: Path, *words: str) -> int:
    source = f"sim:room?frames=60&range=0:{FRAMES}"
    return main(["run", source, *SMALL, "--holdout", str(HOLDOUT), "--out", str(out), *words])


@pytest.fixture(scope="module")
def room_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of 12 frames in sections of 5."""
    folder = tmp_path_factory.mktemp("run")
    out = folder / "run"
    assert run_room(out, "--json", str(folder / "summary.json")) == 0
    return out


def loaded(path: Path) -> Any:  # noqa: ANN401
    return json.loads(path.read_text())


def test_a_run_leaves_what_the_folder_promises(room_run: Path) -> None:
    with RunFolder.open(room_run) as run:
        facts, rows = run.read_info().facts, run.read_frames()
        trajectory = read_trajectory(run.trajectory_path)
        assert run.section_ids() == [0, 1, 2]
        frame_ids = [run.read_section(section_id).frame_ids.tolist() for section_id in run.section_ids()]

    assert frame_ids == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9], [10, 11]]
    assert (facts.finished, facts.interrupted, facts.frames) == (True, False, FRAMES)
    assert (facts.width, facts.height, facts.preset, facts.family) == (64, 48, "fast", "tum")
    assert facts.peak_rss_mb > 30
    assert [row["frame_id"] for row in rows] == list(range(FRAMES))
    assert [row["state"] for row in rows] == ["first"] + ["ok"] * (FRAMES - 1)
    assert trajectory.poses.shape == (FRAMES, 4, 4)
    np.testing.assert_array_equal(trajectory.poses[0], np.eye(4))


def test_committed_poses_are_those_of_the_sections(room_run: Path) -> None:
    with RunFolder.open(room_run) as run:
        poses = read_trajectory(run.trajectory_path).poses
        records = [run.read_section(section_id) for section_id in run.section_ids()]

    stored = np.concatenate([record.T_world_section @ record.T_section_frame for record in records])
    np.testing.assert_allclose(stored, poses, atol=1e-12)


def test_the_summary_is_there_as_json(room_run: Path) -> None:
    summary = loaded(room_run.parent / "summary.json")

    assert (summary["frames"], summary["sections"], summary["lost"]) == (FRAMES, 3, 0)
    assert summary["source"].startswith("sim:room?")
    assert summary["interrupted"] is False


def test_held_out_frames_leave_nothing_in_the_map(room_run: Path) -> None:
    with RunFolder.open(room_run) as run:
        held_out = [row["frame_id"] for row in run.read_frames() if row["held_out"]]
        record = run.read_section(0)

    assert held_out == [2, 4, 7, 9]  # every 2nd regular frame of each section
    assert not set(np.unique(record.frame_index)) & {2, 4}


def test_a_second_run_gives_the_same_bytes_with_other_threads_too(room_run: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    assert run_room(again, "--set", "splat.threads=3") == 0

    names = ["trajectory.txt", *(f"sections/{i:06d}.vts" for i in range(3))]
    assert [(again / name).read_bytes() for name in names] == [(room_run / name).read_bytes() for name in names]


def test_eval_writes_the_defined_figures_and_no_others(room_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(room_run), "--json", "-"]) == 0
    printed = capsys.readouterr()
    values = loaded(room_run / "metrics.json")

    assert json.loads(printed.out) == values
    assert set(values) == METRICS
    assert set(values["seconds_per_frame"]) == {"track", "map", "total"}
    assert set(values["renders_per_frame"]) == {"track", "map"}
    assert [frame["frame"] for frame in values["per_frame"]] == [0, 5, 10]
    assert [frame["section"] for frame in values["per_frame"]] == [0, 1, 2]
    assert (values["frames"], values["sections"]) == (FRAMES, 3)
    assert values["gaussians"] == loaded(room_run.parent / "summary.json")["gaussians"]
    assert values["ms_ssim_paper"] is None  # the images are too small for it
    assert values["psnr_full_db"] > 20
    assert values["psnr_heldout_db"] > 18
    assert values["ate_rmse_m"] < 0.05
    assert values["seam_db"] == pytest.approx(values["psnr_last_db"] - values["psnr_next_db"])
    assert any(line.split()[:1] == ["ate_rmse_m"] for line in printed.err.splitlines())


def test_seams_are_seen_from_the_section_that_ends(room_run: Path) -> None:
    run = RecordedRun(room_run)
    next_db, last_db = [], []
    for section_id, last, following in ((0, range(0, 5), range(5, 10)), (1, range(5, 10), range(10, 12))):
        section = run.section(section_id)
        db = {i: metrics.seam_psnr_db(run.render(section, i), run.frame(i)) for i in (*last, *following)}
        next_db.append(np.mean([db[i] for i in following]))
        last_db.append(np.mean([db[i] for i in last]))

    values = evaluate_run(run)
    assert values["psnr_next_db"] == pytest.approx(np.mean(next_db))
    assert values["psnr_last_db"] == pytest.approx(np.mean(last_db))


class _Sink:
    def __init__(self) -> None:
        self.frames: list[int] = []

    def send(self, frame_id: int, update: Iterable[Part]) -> bool:
        self.frames += [frame_id] if not self.frames or self.frames[-1] != frame_id else []
        return True


@pytest.mark.parametrize("state", ["cut off", "set aside"])
def test_sections_that_do_not_count_are_not_looked_at(state: str, room_run: Path, tmp_path: Path) -> None:
    path, frames = shutil.copytree(room_run, tmp_path / "run"), list(range(10))
    with RunFolder.open(path, writable=True) as run:
        if state == "set aside":
            run.catalog.set_missing(1)
            run.section_path(1).unlink()
            frames = [*range(5), 10, 11]
        else:  # the last section's file is there, and not in the catalogue
            run.catalog.drop_from(2)
    recorded = RecordedRun(path)
    values, sink = evaluate_run(recorded), _Sink()
    assert values["sections"] == len(recorded.section_ids()) == 2
    assert [frame["frame"] for frame in values["per_frame"]] == [each for each in (0, 5, 10) if each in frames]  # type: ignore[attr-defined]
    show_run(recorded, sink, section_gaussians=100, gaussians=1000)
    assert sink.frames == frames
    write_film(tmp_path / "film.gif", recorded)
    assert recorded.frames_in_sections() == frames


def test_a_run_without_a_finished_section_cannot_be_filmed(room_run: Path, tmp_path: Path) -> None:
    path = shutil.copytree(room_run, tmp_path / "run")
    with RunFolder.open(path, writable=True) as run:
        for section_id in range(3):
            run.catalog.set_missing(section_id)
    with pytest.raises(RunFolderError, match="expected a finished section to film, found none"):
        write_film(tmp_path / "film.gif", RecordedRun(path))


@pytest.mark.parametrize("command", [["eval"], ["view", "--film", "film.gif"]])
def test_runs_that_cannot_be_judged_say_why(
    command: list[str], room_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fed, realtime = (shutil.copytree(room_run, tmp_path / name) for name in ("fed", "realtime"))
    with RunFolder.open(fed, writable=True) as run:
        info = run.read_info()
        run.write_info(replace(info, facts=replace(info.facts, source="live:")))
    assert main([*command, str(fed)]) == 1
    told = capsys.readouterr().err
    assert "publishers fed this run, and their frames, which its map is held against, are gone; record the next" in told
    with closing(sqlite3.connect(realtime / "catalog.sqlite")) as catalog, catalog:
        catalog.execute("DELETE FROM quality WHERE frame_id = 3")
        catalog.execute("DELETE FROM frames WHERE frame_id = 3")
    assert main([*command, str(realtime)]) == 1
    assert (
        "expected every frame up to frame 11, found 11 of 12: a run that leaves frames out, as --pacing realtime"
        in (capsys.readouterr().err)
    )


def test_what_to_do_next_is_said_if_it_can_be_done(
    room_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = shutil.copytree(room_run, tmp_path / "run")
    words = ["run", "--resume", str(path), "--in-process"]
    assert main(words) == 0
    assert f"(next: vtslam eval {path})" in capsys.readouterr().out
    monkeypatch.setattr(Catalog, "last_frame_id", FRAMES)  # one was left out
    assert main(words) == 0
    assert "next:" not in capsys.readouterr().out


def test_an_existing_run_is_kept_unless_overwriting_is_asked_for(
    room_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (room_run / "run.toml").read_bytes()

    assert run_room(room_run) == 1
    assert "already a run here" in capsys.readouterr().err
    assert (room_run / "run.toml").read_bytes() == before


def test_a_frame_that_cannot_be_read_ends_the_run_but_not_what_was_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = write_replica(tmp_path / "recording", num_frames=4)
    cut_in_half(recording.depth_path(3))
    out = tmp_path / "run"

    assert main(["run", recording.uri, "--in-process", "--out", str(out), "--set", "section.length=2"]) == 1
    assert "depth000003.png" in capsys.readouterr().err.splitlines()[-1]
    with RunFolder.open(out) as run:
        assert (run.section_ids(), run.read_info().facts.finished) == ([0, 1], False)
        assert len(read_trajectory(run.trajectory_path).poses) == 3


def test_without_ground_truth_the_trajectory_figures_are_null(tmp_path: Path) -> None:
    recording = write_replica(tmp_path / "recording", num_frames=2)
    os.unlink(recording.pose_path(0))
    out = tmp_path / "run"
    assert main(["run", recording.uri, "--in-process", "--out", str(out)]) == 0

    assert main(["eval", str(out)]) == 0
    values = loaded(out / "metrics.json")
    assert values["ate_rmse_m"] is None
    assert values["per_frame"][0]["position_error_m"] is None
    assert values["psnr_full_db"] is not None


def test_eval_refuses_a_recording_that_has_changed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = write_replica(tmp_path / "recording", num_frames=3)
    out = tmp_path / "run"
    assert main(["run", recording.uri, "--in-process", "--out", str(out)]) == 0
    recording.color_path(2).unlink()
    recording.depth_path(2).unlink()
    recording.write_poses(["1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"] * 2)

    assert main(["eval", str(out)]) == 1
    assert "expected the 3 frames of 48x36 that the run was made from, found 2" in capsys.readouterr().err


def test_a_dense_run_is_the_same_run_in_small_files(room_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "dense"
    assert run_room(out, "--set", "storage.codec=dense") == 0
    plain, dense = RunFolder.open(room_run), RunFolder.open(out)
    # The third section is tracked against earlier ones, which the codec has not touched while the run lasted.
    assert dense.trajectory_path.read_bytes() == plain.trajectory_path.read_bytes()
    for section_id in plain.section_ids():
        assert dense.read_section(section_id).pixel.tobytes() == plain.read_section(section_id).pixel.tobytes()
        assert dense.section_path(section_id).stat().st_size < plain.section_path(section_id).stat().st_size / 2
    loss_db = [float(str(evaluate_run(RecordedRun(path))["psnr_paper_db"])) for path in (room_run, out)]
    assert 0 < loss_db[0] - loss_db[1] < 0.5

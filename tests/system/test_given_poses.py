"""Poses from elsewhere: as priors of tracking, and in place of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.fleet_runs import ASSIGNMENTS, Disturbance, SmallRecording, result_bytes, small_plan
from helpers.fleet_runs import FRAMES as FRAMES_OF_RECORDING
from helpers.mcap_bytes import BagWriter

from vtslam.common.config import ConfigError
from vtslam.common.trajectory_io import read_trajectory, write_trajectory
from vtslam.services.cli.__main__ import main
from vtslam.services.evaluation import evaluate_run
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.run_plan import plan_run
from vtslam.services.sensor.sources.registry import open_source
from vtslam.storage.recording.writer import RecordingWriter
from vtslam.storage.run_folder import RunFolder

FRAMES = 8


@pytest.fixture
def poses(small: SmallRecording, tmp_path: Path) -> Path:
    """The true poses of the small recording, as a file."""
    source, path = open_source(small.files.uri), tmp_path / "poses.txt"
    truth = source.ground_truth()
    assert truth is not None
    write_trajectory(path, [source.frame(index).capture_time_ns for index in range(len(source))], truth)
    return path


def _words(*assignments: str) -> list[str]:
    return [word for text in (*ASSIGNMENTS, f"source.frames=0:{FRAMES}", *assignments) for word in ("--set", text)]


def _number(value: object) -> float:
    assert isinstance(value, float)
    return value


def _states(run: Path) -> list[str]:
    return [str(row["state"]) for row in RecordedRun(run).rows]


def test_given_poses_take_the_place_of_tracking(small: SmallRecording, poses: Path, tmp_path: Path) -> None:
    for name, mode in (("one", ["--in-process"]), ("many", [])):
        words = ["--poses", str(poses), "--tracking", "off", "--out", str(tmp_path / name)]
        assert main(["run", small.files.uri, *mode, *words, *_words()]) == 0
    assert result_bytes(tmp_path / "one") == result_bytes(tmp_path / "many")
    given, found = read_trajectory(poses), read_trajectory(tmp_path / "one" / "trajectory.txt")
    np.testing.assert_allclose(found.poses, given.poses[:FRAMES], atol=1e-12)
    for name in ("one", "many"):
        assert _states(tmp_path / name) == ["first", *["known"] * (FRAMES - 1)]


def test_the_poses_of_tracking_given_back_make_the_same_map(small: SmallRecording, tmp_path: Path) -> None:
    small_plan(small.files).execute(tmp_path / "tracked")
    given = tmp_path / "tracked" / "trajectory.txt"
    words = ["--poses", str(given), "--tracking", "off", "--in-process", "--out", str(tmp_path / "given")]
    assert main(["run", small.files.uri, *words, *_words(f"source.frames=0:{FRAMES_OF_RECORDING}")]) == 0
    tracked, mapped = (RunFolder.open(tmp_path / name) for name in ("tracked", "given"))
    assert tracked.section_ids() == mapped.section_ids()
    for section_id in tracked.section_ids():
        before, after = tracked.read_section(section_id), mapped.read_section(section_id)
        for name, column in before.columns().items():
            if column.dtype.kind == "f":
                np.testing.assert_allclose(after.columns()[name], column, atol=1e-3, err_msg=name)
            else:
                np.testing.assert_array_equal(after.columns()[name], column, err_msg=name)


def test_true_poses_make_no_worse_a_map_than_tracking(small: SmallRecording, poses: Path, tmp_path: Path) -> None:
    small_plan(small.files).execute(tmp_path / "tracked")
    words = ["--poses", str(poses), "--tracking", "off", "--in-process", "--out", str(tmp_path / "given")]
    assert main(["run", small.files.uri, *words, *_words(f"source.frames=0:{FRAMES_OF_RECORDING}")]) == 0
    tracked, given = (evaluate_run(RecordedRun(tmp_path / name)) for name in ("tracked", "given"))
    for figure in ("psnr_paper_db", "psnr_heldout_db"):
        assert _number(given[figure]) > _number(tracked[figure]) - 0.02


def test_given_poses_guide_tracking(small: SmallRecording, poses: Path, tmp_path: Path) -> None:
    settings = [*ASSIGNMENTS, f"source.frames=0:{FRAMES}", f'source.poses="{poses}"', 'source.poses_sigma="1e-5,1e-4"']
    plan_run(small.files.uri, family="tum", assignments=settings).execute(tmp_path / "run")
    given, found = read_trajectory(poses), read_trajectory(tmp_path / "run" / "trajectory.txt")
    np.testing.assert_allclose(found.poses, given.poses[:FRAMES], atol=1e-3)
    assert "known" not in _states(tmp_path / "run")


def test_poses_of_a_bag_are_mapped_at_in_a_fleet(small: SmallRecording, tmp_path: Path) -> None:
    source, bag = open_source(small.files.uri), BagWriter()
    truth = source.ground_truth()
    assert truth is not None
    for index in range(FRAMES):
        frame = source.frame(index)
        bag.add_frame(frame)
        bag.add_transform("/tf", "world", "optical", truth[index], frame.capture_time_ns)
    path = bag.write(tmp_path / "bag.mcap")
    settings = [*ASSIGNMENTS, f"source.frames=0:{FRAMES}", 'source.poses="/tf"', "tracker.enabled=false"]
    uri = f"mcap:{path}?depth_scale={1.0 / source.depth_scale_m!r}"
    plan_run(uri, assignments=settings).execute_in_fleet(tmp_path / "run", Disturbance().hooks())
    found = read_trajectory(tmp_path / "run" / "trajectory.txt")
    np.testing.assert_allclose(found.poses, truth[:FRAMES], atol=1e-9)


def test_without_poses_tracking_cannot_be_off(small: SmallRecording) -> None:
    with pytest.raises(ConfigError, match=r"--tracking off: .*expected a pose for the first frame"):
        plan_run(small.files.uri, assignments=["tracker.enabled=false"])


def _poses_from(path: Path, poses: Path, first: int) -> Path:
    """A file of the poses from frame ``first`` on."""
    path.write_text("".join(poses.read_text().splitlines(keepends=True)[first:]))
    return path


@pytest.mark.parametrize("tracking", ["on", "off"])
def test_poses_that_begin_after_the_first_frame_are_refused(
    tracking: str, small: SmallRecording, poses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late, words = str(_poses_from(tmp_path / "late.txt", poses, 5)), ["--tracking", tracking, "--in-process"]
    for frames, told in (("2:9", "--frames 5:9"), ("0:5", "found none for the first 5"), ("1:", "--frames 5:20")):
        out = ["--frames", frames, "--out", str(tmp_path / "run")]
        assert main(["run", small.files.uri, "--poses", late, *words, *out]) == 2
        error = capsys.readouterr().err
        assert "expected a pose for the first frame, which says where the world is, found none" in error
        assert told in error
    assert not (tmp_path / "run").exists()
    plan_run(small.files.uri, assignments=["source.frames=5:9", f'source.poses="{late}"'])


def test_recorded_poses_that_begin_late_are_ignored_and_told_of(
    small: SmallRecording, poses: Path, tmp_path: Path
) -> None:
    settings = [*ASSIGNMENTS, f"source.frames=0:{FRAMES}"]
    source = open_source(small.files.uri, frames=(0, FRAMES), overrides={"poses": str(poses)})
    with RecordingWriter(tmp_path / "x.mcap", family="tum") as recording:
        for index in range(FRAMES):
            frame = source.frame(index)
            recording.add_frame(frame if index > 1 else replace(frame, pose_prior=None))
    plan = plan_run(f"mcap:{tmp_path / 'x.mcap'}", assignments=settings)
    plan.execute(tmp_path / "one")
    plan.execute_in_fleet(tmp_path / "many", Disturbance().hooks())
    plan_run(small.files.uri, family="tum", assignments=settings).execute(tmp_path / "without")
    without = result_bytes(tmp_path / "without")
    for name in ("one", "many"):
        assert result_bytes(tmp_path / name) == without
        told = [event.text for event in RunFolder.open(tmp_path / name).catalog.events() if event.kind == "priors"]
        assert [text.partition(" comes with a pose")[0] for text in told] == ["frame 2"]

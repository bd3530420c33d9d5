"""Recordings of runs and fleets, and what comes of playing them."""

import os
import random
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_runs import DEADLINE_S, POLL_S, start_vtslam
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
from helpers.mcap_bytes import BagWriter
from helpers.shared_data import shared_data

from vtslam.common.fleet_folder import running_fleets
from vtslam.common.trajectory_io import read_trajectory
from vtslam.services.cli.__main__ import main
from vtslam.services.run_plan import plan_resume, plan_run
from vtslam.services.sensor.sources.base import SourceUri
from vtslam.services.sensor.sources.mcap_recording import open_mcap
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.supervisor.fleet_run import FleetHooks
from vtslam.services.supervisor.live_run import run_live
from vtslam.storage.errors import RunFolderError, RunLocked, WriteFailed
from vtslam.storage.run_folder import RunFolder

_NO_CHUNK_BYTES = 100  # of a recording whose writer was killed before the first frame was on disk


def test_a_recording_on_the_command_line_gives_the_run_again(tmp_path: Path) -> None:
    recording, one, other = tmp_path / "x.mcap", tmp_path / "A", tmp_path / "B"
    words = ["--size", "64x48", "--frames", "0:8", "--record", str(recording), "--set", "section.length=5"]
    assert main(["run", "sim:room", *words, "--out", str(one)]) == 0
    assert main(["run", f"mcap:{recording}", "--set", "section.length=5", "--out", str(other)]) == 0
    assert result_bytes(one) == result_bytes(other)
    assert main(["run", "sim:room", *words, "--out", str(tmp_path / "C")]) == 1  # the recording is there


@pytest.mark.parametrize("in_process", [True, False])
def test_frames_and_poses_of_a_run_are_recorded(in_process: bool, small: SmallRecording, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    plan = small_plan(small.files, f'recorder.file="{path}"')
    if in_process:
        plan.execute(tmp_path / "run")
    else:
        plan.execute_in_fleet(tmp_path / "run", Disturbance().hooks())
    assert result_bytes(tmp_path / "run") == small.undisturbed
    _assert_plays(path, small, FRAMES)
    recorded, committed = open_mcap(SourceUri.parse(f"mcap:{path}")), read_trajectory(tmp_path / "run/trajectory.txt")
    pose_at = recorded.poses("/tf")
    assert pose_at is not None
    for time_ns, pose in zip(committed.capture_times_ns, committed.poses, strict=True):
        found = pose_at(int(time_ns))
        assert found is not None
        np.testing.assert_allclose(found, pose, atol=1e-12)
    with pytest.raises(WriteFailed, match="--overwrite"):
        plan.execute(tmp_path / "again")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize("start", ["in_process", "in_fleet", "live"])
def test_a_run_that_is_refused_takes_no_recording_away(start: str, small: SmallRecording, tmp_path: Path) -> None:
    path, busy, foreign = tmp_path / "x.mcap", tmp_path / "busy", tmp_path / "foreign"
    path.write_bytes(b"kept")
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("mine")
    plan, hooks, setting = small_plan(small.files, f'recorder.file="{path}"'), FleetHooks(), f'recorder.file="{path}"'
    run: dict[str, Callable[[Path], object]] = {
        "in_process": lambda out: plan.execute(out, overwrite=True),
        "in_fleet": lambda out: plan.execute_in_fleet(out, hooks, overwrite=True),
        "live": lambda out: run_live(
            out, hooks, fleet="test", preset="fast", family="tum", assignments=[setting], overwrite=True
        ),
    }
    with RunFolder.create(busy, plan.info()), pytest.raises(RunLocked):
        run[start](busy)
    with pytest.raises(RunFolderError, match="not empty and not a run folder"):
        run[start](foreign)
    assert path.read_bytes() == b"kept"


def test_a_recording_does_not_take_the_place_of_its_source(
    small: SmallRecording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "k.mcap"
    small_plan(small.files, f'recorder.file="{path}"', "source.frames=0:2").execute(tmp_path / "run")
    whole = path.read_bytes()
    for record in (path, tmp_path / "."):
        words = ["--record", str(record), "--overwrite", "--in-process", "--out", str(tmp_path / "again")]
        assert main(["run", f"mcap:{path}", *words]) == 1
    told = capsys.readouterr().err
    assert "k.mcap: expected a file that nobody uses, found one that is read or written meanwhile" in told
    assert "expected a file to record in, found no regular file" in told
    assert path.read_bytes() == whole
    assert not (tmp_path / "again").exists()


def test_an_earlier_recording_is_given_up_with_all_its_parts(small: SmallRecording, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    for part in (path, tmp_path / "x-2.mcap"):
        part.write_bytes(b"of an earlier run")
    plan = small_plan(small.files, f'recorder.file="{path}"', "source.frames=0:2")
    plan.execute(tmp_path / "run", overwrite=True)
    assert [each.name for each in tmp_path.glob("*.mcap")] == ["x.mcap"]
    assert len(open_source(f"mcap:{path}")) == 2


def test_a_recorder_that_dies_goes_on_in_another_part(small: SmallRecording, tmp_path: Path) -> None:
    killed = Disturbance(signals=[(8, "recorder", signal.SIGKILL)])
    small_plan(small.files, f'recorder.file="{tmp_path / "x.mcap"}"').execute_in_fleet(tmp_path / "run", killed.hooks())
    assert killed.deaths["recorder"] == 1
    assert result_bytes(tmp_path / "run") == small.undisturbed
    first, second = (open_source(f"mcap:{tmp_path / name}") for name in ("x.mcap", "x-2.mcap"))
    plain = open_source(small.files.uri)
    assert first.frame(0).capture_time_ns == plain.frame(0).capture_time_ns
    last = second.frame(len(second) - 1)
    np.testing.assert_array_equal(last.rgb, plain.frame(FRAMES - 1).rgb)
    assert len(second) <= FRAMES - 8


@pytest.mark.parametrize("in_process", [True, False])
def test_a_run_that_is_resumed_goes_on_recording(in_process: bool, small: SmallRecording, tmp_path: Path) -> None:
    run, durable = tmp_path / "run", 2 * SECTION
    with pytest.raises(CutOff):
        small_plan(small.files, f'recorder.file="{tmp_path / "x.mcap"}"').execute(run, on_frame=cut_off_at(durable + 1))
    plan = plan_resume(run)
    if in_process:
        plan.resume(run)
    else:
        plan.resume_in_fleet(run, Disturbance(frames=durable).hooks())
    assert result_bytes(run) == small.undisturbed
    _assert_plays(tmp_path / "x.mcap", small, durable + 2)
    rest = tmp_path / "x-2.mcap"
    _assert_plays(rest, small)
    assert len(open_source(f"mcap:{rest}")) == FRAMES - durable
    pose_at = open_mcap(SourceUri.parse(f"mcap:{rest}")).poses("/tf")
    last = read_trajectory(run / "trajectory.txt")
    assert pose_at is not None
    found = pose_at(int(last.capture_times_ns[-1]))
    assert found is not None
    np.testing.assert_allclose(found, last.poses[-1], atol=1e-12)


def test_a_running_fleet_is_recorded(small: SmallRecording, tmp_path: Path) -> None:
    fleet, path = f"test-record-{os.getpid()}", tmp_path / "x.mcap"
    fleet_words = ["--fleet", fleet, "--out", str(tmp_path / "run"), "--pacing", "lockstep"]
    up = start_vtslam("up", *fleet_words, "--set", "section.length=3")
    recorder = None
    try:
        _wait(lambda: fleet in running_fleets())
        recorder = start_vtslam("record", "--fleet", fleet, "--out", str(path))
        _wait(path.exists)
        assert main(["publish", small.files.uri, "--frames", "0:6", "--fleet", fleet]) == 0
        up.send_signal(signal.SIGINT)
        up.communicate(timeout=DEADLINE_S)
        assert up.returncode == 0
        output, _ = recorder.communicate(timeout=DEADLINE_S)
    finally:
        for process in filter(None, (up, recorder)):
            process.kill()
            process.communicate()
    assert recorder.returncode == 0, output
    assert "6 frames recorded, 0 missed" in output
    _assert_plays(path, small, 6)


def test_recorders_killed_at_random_leave_files_that_play(
    small: SmallRecording, tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    kills, per_run = pytestconfig.getoption("recorder_kills"), 4
    rng = random.Random(7)
    for run in range(-(-kills // per_run)):
        path = tmp_path / f"{run}.mcap"
        moments = sorted(rng.sample(range(1, FRAMES - 6), min(per_run, kills - run * per_run)))
        killed = Disturbance(signals=[(moment, "recorder", signal.SIGKILL) for moment in moments])
        plan = small_plan(small.files, f'recorder.file="{path}"')
        plan.execute_in_fleet(tmp_path / f"run{run}", killed.hooks())
        assert result_bytes(tmp_path / f"run{run}") == small.undisturbed
        assert 1 <= killed.deaths["recorder"] <= len(moments)  # two kills may meet one process
        parts = sorted(tmp_path.glob(f"{run}*.mcap"))
        assert 1 <= len(parts) <= len(moments) + 1  # a part without a frame is removed
        for part in parts:
            if part.stat().st_size > _NO_CHUNK_BYTES:
                _assert_plays(part, small)


def test_a_ros_2_bag_gives_the_trajectory_of_its_frames(small: SmallRecording, tmp_path: Path) -> None:
    _assert_bag_tracks_alike(small.files.uri, tmp_path, [*ASSIGNMENTS, "source.frames=0:10"])


def test_a_ros_2_bag_of_a_real_recording_gives_its_trajectory(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    frames = pytestconfig.getoption("bag_frames")
    uri = f"replica:{shared_data('redkitchen')}"
    _assert_bag_tracks_alike(uri, tmp_path, [f"source.frames=0:{frames}", "source.size=160x120"])


def _assert_bag_tracks_alike(uri: str, folder: Path, assignments: Sequence[str]) -> None:
    """A bag of the frames of ``uri``, at their full size, gives the trajectory that they give."""
    plain = plan_run(uri, family="tum", assignments=assignments)
    bag, recording = BagWriter(chunk_size=768 * 1024), open_source(uri)
    for index in range(len(plain.source)):
        bag.add_frame(recording.frame(index), apart_ns=2_000_000)
    path = bag.write(folder / "bag.mcap")
    units_per_m = repr(1.0 / recording.depth_scale_m)
    played = plan_run(f"mcap:{path}?depth_scale={units_per_m}", family="tum", assignments=assignments)
    plain.execute(folder / "plain")
    played.execute(folder / "played")
    assert (folder / "plain/trajectory.txt").read_bytes() == (folder / "played/trajectory.txt").read_bytes()


def _assert_plays(path: Path, small: SmallRecording, num_frames: int | None = None) -> None:
    """The recording has these frames of the small one, from some frame on without a gap, bit by bit."""
    played, plain = open_source(f"mcap:{path}"), open_source(small.files.uri)
    of_time = {plain.frame(index).capture_time_ns: index for index in range(FRAMES)}
    first = of_time[played.frame(0).capture_time_ns]
    assert num_frames is None or (len(played), first) == (num_frames, 0)
    for index in range(len(played)):
        frame, expected = played.frame(index), plain.frame(first + index)
        assert frame.capture_time_ns == expected.capture_time_ns
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        np.testing.assert_array_equal(frame.depth, expected.depth)


def _wait(is_so: Callable[[], bool]) -> None:
    for _ in range(int(DEADLINE_S / POLL_S)):
        if is_so():
            return
        time.sleep(POLL_S)
    raise AssertionError("it did not come to that in time")


def test_a_run_whose_poses_are_read_is_not_given_up(
    small: SmallRecording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    small_plan(small.files, "source.frames=0:2").execute(run)
    whole = (run / "trajectory.txt").read_bytes()
    words = ["--poses", str(run / "trajectory.txt"), "--frames", "0:2", "--in-process", "--overwrite"]
    assert main(["run", small.files.uri, *words, "--out", str(run)]) == 1
    assert "expected a run that nobody reads, found poses of the new one" in capsys.readouterr().err
    assert (run / "trajectory.txt").read_bytes() == whole
    assert main(["run", small.files.uri, *words, "--out", str(tmp_path / "again")]) == 0

"""A fleet that waits for publishers, and what they send."""

import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.cli_runs import DEADLINE_S, POLL_S, start_vtslam
from helpers.fleet_runs import FRAMES, Disturbance, SmallRecording, live_run, result_bytes

from vtslam.common.fleet_folder import running_fleets
from vtslam.common.trajectory_io import read_trajectory
from vtslam.services.cli.__main__ import main
from vtslam.services.sensor.publisher import FramePublisher
from vtslam.services.sensor.sources.registry import open_source
from vtslam.storage.run_folder import RunFolder

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "publish-your-sensor.md"


@pytest.mark.parametrize(
    "signals",
    [[], [(4, "sensor", signal.SIGKILL), (9, "mapper", signal.SIGKILL), (12, "sensor", signal.SIGKILL)]],
    ids=["calm", "killed"],
)
def test_what_is_published_is_mapped_as_the_recording_is(
    signals: list[tuple[int, str, signal.Signals]], small: SmallRecording, tmp_path: Path
) -> None:
    source, disturbance = open_source(small.files.uri), Disturbance(signals=list(signals))

    def publish() -> None:
        for part in (range(7), range(7, FRAMES)):  # two publishers, one after the other
            with FramePublisher("test-live") as publisher:
                for index in part:
                    assert publisher.publish(source.frame(index)) == index

    summary = live_run(tmp_path / "run", "test-live", disturbance, publish)

    assert result_bytes(tmp_path / "run") == small.undisturbed
    assert (summary.frames, summary.interrupted) == (FRAMES, False)
    assert sum(disturbance.deaths.values()) == len(signals)
    with RunFolder.open(tmp_path / "run") as run:
        facts = run.read_info().facts
    assert (facts.finished, facts.width, facts.height, facts.end_frame) == (True, 64, 48, FRAMES)


def test_a_clock_that_goes_back_ends_nothing(small: SmallRecording, tmp_path: Path) -> None:
    source = open_source(small.files.uri)

    def publish() -> None:
        with FramePublisher("test-clock") as publisher:
            for index, time_ns in enumerate([1000, 2000, 1500, 3000]):
                publisher.publish(replace(source.frame(index), capture_time_ns=time_ns))

    summary = live_run(tmp_path / "run", "test-clock", Disturbance(), publish)

    assert summary.frames == 4
    with RunFolder.open(tmp_path / "run") as run:
        assert read_trajectory(run.trajectory_path).capture_times_ns.tolist() == [1000, 2000, 2001, 3000]


def test_up_and_publish_on_the_command_line(small: SmallRecording, tmp_path: Path) -> None:
    out, fleet = tmp_path / "run", f"test-up-{os.getpid()}"
    process = start_vtslam(
        "up", "--fleet", fleet, "--out", str(out), "--pacing", "lockstep", "--set", "section.length=3"
    )
    try:
        for _ in range(int(DEADLINE_S / POLL_S)):
            if fleet in running_fleets():
                break
            time.sleep(POLL_S)
        assert main(["publish", small.files.uri, "--frames", "0:4", "--fleet", fleet]) == 0
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=DEADLINE_S)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 0
    assert "4 frames in" in output


def test_the_documented_example_publishes_its_frames(tmp_path: Path) -> None:
    code = DOCUMENT.read_text().split("```python\n")[1].split("```")[0]
    assert len(code.splitlines()) < 30

    summary = live_run(tmp_path / "run", "kitchen", Disturbance(), lambda: exec(code, {}))

    assert summary.frames == 3

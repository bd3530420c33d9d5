"""A fleet of processes leaves what one process leaves, whichever of them dies and whenever."""

import signal
import socket
from dataclasses import replace
from pathlib import Path
from urllib.error import URLError
from urllib.request import urlopen

import pytest
from helpers.fleet_runs import FRAMES, SECTION, Disturbance, SmallRecording, fleet_run, result_bytes, small_plan
from helpers.processes import leftovers
from helpers.recordings import cut_in_half, read_once_told
from helpers.shared_data import shared_data

from vtslam.common.config import ConfigError
from vtslam.common.trajectory_io import read_trajectory
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.process_facts import is_gone
from vtslam.services.run_plan import plan_resume, plan_run
from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.supervisor.errors import FleetError
from vtslam.storage.run_folder import RunFolder

KILL = signal.SIGKILL


def test_a_fleet_gives_the_same_bytes_as_one_process(small: SmallRecording, tmp_path: Path) -> None:
    calm = Disturbance()
    summary = fleet_run(small.files, tmp_path / "run", calm)

    assert result_bytes(tmp_path / "run") == small.undisturbed
    assert (summary.frames, summary.sections, summary.interrupted) == (FRAMES, 4, False)
    assert calm.events == []
    assert len(calm.pids) == 4
    assert all(is_gone(pid) for pid in calm.pids)
    with RunFolder.open(tmp_path / "run") as run:
        assert run.read_info().facts.finished
        assert [row["frame_id"] for row in run.read_frames()] == list(range(FRAMES))


def test_a_kinect_recording_with_default_settings_gives_the_same_bytes(tmp_path: Path) -> None:
    recording = shared_data("redkitchen")
    words = ["source.frames=0:10", "source.size=80x60", "section.length=4"]
    plan = plan_run(f"replica:{recording}", family="tum", assignments=words)
    plan.execute(tmp_path / "one")
    plan.execute_in_fleet(tmp_path / "many", Disturbance().hooks())

    assert result_bytes(tmp_path / "many") == result_bytes(tmp_path / "one")


def test_prometheus_is_answered_on_this_host_while_the_fleet_runs(small: SmallRecording, tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    calm = Disturbance(signals=[(3, "tracker", KILL)])
    pages: list[str] = []

    def look() -> bool:
        if calm.frames > SECTION and not pages:
            with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as page:
                pages.append(page.read().decode())
        return False

    plan = small_plan(small.files, f"fleet.metrics_port={port}")
    plan.execute_in_fleet(tmp_path / "run", calm.hooks(look))

    values = dict(line.rsplit(" ", 1) for line in pages[0].splitlines() if not line.startswith("#"))
    assert float(values["vtslam_map_bytes"]) > 10_000
    assert values['vtslam_service_deaths_total{service="tracker"}'] == "1"
    assert values['vtslam_service_starts_total{service="mapper"}'] == "1"
    committed = sum(int(n) for key, n in values.items() if key.startswith("vtslam_frames_committed_total"))
    assert SECTION < committed == int(values['vtslam_frame_seconds_bucket{step="map",le="+Inf"}'])
    with pytest.raises(URLError):
        urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60)


def test_processes_that_are_killed_twice_change_nothing(small: SmallRecording, tmp_path: Path) -> None:
    names = ("sensor", "tracker", "mapper", "archiver")
    moments = [*enumerate(names, 2), *enumerate(names, SECTION + 2)]
    killed = Disturbance(signals=[(frames, name, KILL) for frames, name in moments])
    fleet_run(small.files, tmp_path / "run", killed)

    assert result_bytes(tmp_path / "run") == small.undisturbed
    assert killed.deaths == dict.fromkeys(names, 2)
    assert len(killed.events) == len(moments)
    assert all("killed by signal 9" in event for event in killed.events)
    assert all(is_gone(pid) for pid in killed.pids)


def test_priors_of_poses_are_used_and_outlive_processes(small: SmallRecording, tmp_path: Path) -> None:
    plan = small_plan(small.files, source="?prior=0.02,0.5")
    plan.execute(tmp_path / "one")
    killed = Disturbance(signals=[(3, "tracker", KILL), (7, "sensor", KILL), (9, "tracker", KILL)])
    plan.execute_in_fleet(tmp_path / "many", killed.hooks())

    assert result_bytes(tmp_path / "many") == result_bytes(tmp_path / "one")
    assert result_bytes(tmp_path / "one") != small.undisturbed


def test_sections_leave_memory_within_the_budget_and_are_read_again(small: SmallRecording, tmp_path: Path) -> None:
    words = ("section.length=2", "mapper.keep_moments=false", "tracker.overlap.max_sections=5")
    plan = small_plan(small.files, *words, "fleet.map_budget_mb=3")
    plan.execute(tmp_path / "one")
    calm = Disturbance()
    plan.execute_in_fleet(tmp_path / "many", calm.hooks())

    assert result_bytes(tmp_path / "many") == result_bytes(tmp_path / "one")
    counters = calm.children["archiver"].counters
    assert counters["sections.reloaded"] > 0
    assert counters["sections.archived"] == FRAMES // 2
    assert calm.map_sealed_bytes > 0
    assert 0 < calm.map_peak_bytes <= 3_000_000
    waits = ("mapper: waits: ", "archiver: mapping waits")  # for a disk that is slower than mapping, if it is
    assert [event for event in calm.events if not event.startswith(waits)] == []


def test_a_map_that_cannot_fit_ends_the_fleet_in_order(small: SmallRecording, tmp_path: Path) -> None:
    words = ("source.size=640x480", "section.length=2", "mapper.iterations_seal=1")
    with pytest.raises(ConfigError, match=r"fleet.map_budget_mb = 16: expected at least \d+ for frames of 640x480"):
        small_plan(small.files, *words, "fleet.map_budget_mb=16")
    roomy, calm = small_plan(small.files, *words), Disturbance()
    fleet = replace(roomy.settings.fleet, map_budget_mb=16)  # as a camera may have it that is known only when it comes
    plan = replace(roomy, settings=replace(roomy.settings, fleet=fleet))
    with pytest.raises(FleetError, match=r"\d+ bytes wanted, \d+ of the map store's 16000000 bytes are in use"):
        plan.execute_in_fleet(tmp_path / "many", calm.hooks())

    assert calm.events == []
    assert all(is_gone(pid) for pid in calm.pids)
    assert leftovers() == []


def test_deaths_within_writes_to_shared_memory_change_nothing(small: SmallRecording, tmp_path: Path) -> None:
    points = {
        ("mapper", 1): "shm.active.after_rename:1",
        ("mapper", 2): "shm.commit.after_colors:3",
        ("mapper", 3): "shm.commit.before_flip:1",
        ("mapper", 4): "shm.commit.after_flip:1",
        ("mapper", 5): "shm.seal.after_tail:1",
        ("mapper", 6): "shm.seal.after_rename:1",
        ("sensor", 1): "shm.ring.after_color:5",
        ("sensor", 2): "shm.ring.after_publish:3",
    }
    killed = Disturbance(failpoints=points)
    fleet_run(small.files, tmp_path / "run", killed)

    assert result_bytes(tmp_path / "run") == small.undisturbed
    assert killed.deaths == {"mapper": 6, "sensor": 2, "tracker": 0, "archiver": 0}


def test_deaths_within_writes_to_the_run_folder_change_nothing(small: SmallRecording, tmp_path: Path) -> None:
    words = ("source.frames=0:10", "section.length=2", "storage.codec='dense'")
    points = {
        ("archiver", 1): "run.section.after_write:2",
        ("archiver", 2): "run.section.after_catalog:1",
        ("archiver", 3): "run.section.after_trajectory:1",
    }
    plan = small_plan(small.files, *words)
    plan.execute(tmp_path / "one")
    killed = Disturbance(failpoints=points)
    plan.execute_in_fleet(tmp_path / "many", killed.hooks())

    assert result_bytes(tmp_path / "many") == result_bytes(tmp_path / "one")
    assert killed.deaths == {"mapper": 0, "sensor": 0, "tracker": 0, "archiver": len(points)}
    assert sorted(path.name for path in (tmp_path / "many").iterdir()) == sorted(
        path.name for path in (tmp_path / "one").iterdir()
    )
    with RunFolder.open(tmp_path / "many") as run:
        told = [event.text for event in run.catalog.events() if event.kind == "restarted"]
        assert {row.codec for row in run.catalog.sections()} == {"dense"}
    assert told == [event for event in killed.events if "killed by signal 9" in event]
    assert len(told) == len(points)


def test_processes_that_are_asked_to_end_by_others_than_their_supervisor_do_not(
    small: SmallRecording, tmp_path: Path
) -> None:
    names = ("sensor", "tracker", "mapper", "archiver")
    asked = [(frames, name, number) for frames, number in ((3, signal.SIGTERM), (4, signal.SIGINT)) for name in names]
    calm = Disturbance(signals=asked)
    fleet_run(small.files, tmp_path / "run", calm)

    assert result_bytes(tmp_path / "run") == small.undisturbed
    assert calm.signals == []
    assert calm.events == []


def test_all_processes_killed_at_once_change_nothing(small: SmallRecording, tmp_path: Path) -> None:
    killed = Disturbance(signals=[(SECTION, name, KILL) for name in ("sensor", "tracker", "mapper", "archiver")])
    fleet_run(small.files, tmp_path / "run", killed)

    assert result_bytes(tmp_path / "run") == small.undisturbed
    assert killed.deaths == {"sensor": 1, "tracker": 1, "mapper": 1, "archiver": 1}


def test_a_process_that_hangs_is_killed_and_started_again(small: SmallRecording, tmp_path: Path) -> None:
    stopped = Disturbance(signals=[(4, "tracker", signal.SIGSTOP)])
    fleet_run(small.files, tmp_path / "run", stopped)

    assert result_bytes(tmp_path / "run") == small.undisturbed
    assert stopped.hangs == {"sensor": 0, "tracker": 1, "mapper": 0, "archiver": 0}
    assert len(stopped.events) == 1
    assert stopped.events[0].startswith("tracker: left the bus while it ran after ")


def test_a_process_that_cannot_live_ends_the_fleet_which_may_go_on_later(small: SmallRecording, tmp_path: Path) -> None:
    hopeless = Disturbance(failpoints={("mapper", start): "shm.adopt.before_epoch:1" for start in range(2, 9)})
    hopeless.failpoints["mapper", 1] = f"shm.commit.after_flip:{SECTION + 3}"  # committed, but nobody was told
    with pytest.raises(FleetError, match=f"mapper: killed by signal 9 after {SECTION + 2} frames, for the 6th time"):
        fleet_run(small.files, tmp_path / "run", hopeless)

    with RunFolder.open(tmp_path / "run") as run:
        facts, rows = run.read_info().facts, run.read_frames()
        assert run.section_ids() == [0]
        assert run.catalog.num_frames == len(run.catalog.poses()[1]) == SECTION + 3
    assert (facts.finished, facts.interrupted, facts.frames, len(rows)) == (False, False, SECTION + 3, SECTION + 3)
    known = (tmp_path / "run" / "trajectory.txt").read_bytes()
    assert known.count(b"\n") == SECTION + 3
    assert small.undisturbed["trajectory.txt"].startswith(known)
    assert all(is_gone(pid) for pid in hopeless.pids)
    assert leftovers() == []
    plan_resume(tmp_path / "run").resume(tmp_path / "run")
    assert result_bytes(tmp_path / "run") == small.undisturbed


def test_an_error_of_the_supervisor_loses_nothing_that_was_finished(small: SmallRecording, tmp_path: Path) -> None:
    stopped = Disturbance(signals=[(1, "archiver", signal.SIGSTOP)])
    calm = stopped.hooks()

    def fail(facts: FrameFacts) -> None:
        calm.on_frame(facts)
        if facts.frame_id == SECTION + 1:
            raise OSError("no room for anything")

    with pytest.raises(OSError, match="no room for anything"):
        small_plan(small.files).execute_in_fleet(tmp_path / "run", replace(calm, on_frame=fail))

    with RunFolder.open(tmp_path / "run") as run:
        assert run.section_ids() == [0]
        assert run.catalog.num_frames >= SECTION + 2
        assert not run.read_info().facts.finished
    assert result_bytes(tmp_path / "run")["000000.vts"] == small.undisturbed["000000.vts"]
    assert all(is_gone(pid) for pid in stopped.pids)
    assert leftovers() == []


def test_what_was_done_before_a_stop_is_kept_and_its_short_section_mapped_again(
    small: SmallRecording, tmp_path: Path
) -> None:
    late = small.files.color_path(SECTION + 2)
    with read_once_told(late) as may_be_read:
        steps_with_enough: list[int] = []

        def on_step() -> None:
            if calm.frames > SECTION:
                steps_with_enough.append(calm.frames)
            if len(steps_with_enough) > 1:  # in the first one the stop was asked for, in the second one told
                may_be_read.set()

        calm = Disturbance(on_step=on_step)
        summary = fleet_run(small.files, tmp_path / "run", calm, should_stop=lambda: calm.frames > SECTION)

    assert summary.interrupted
    assert SECTION < summary.frames < 2 * SECTION
    with RunFolder.open(tmp_path / "run") as run:
        facts, poses = run.read_info().facts, read_trajectory(run.trajectory_path).poses
        in_sections = sum(run.read_section(section_id).num_frames for section_id in run.section_ids())
    assert (facts.finished, facts.interrupted) == (False, True)
    assert facts.frames == len(poses) == in_sections == summary.frames
    files = result_bytes(tmp_path / "run")
    assert files["000000.vts"] == small.undisturbed["000000.vts"]
    assert small.undisturbed["trajectory.txt"].startswith(files["trajectory.txt"])

    (tmp_path / "run" / "metrics.json").write_text("{}")
    resumed = plan_resume(tmp_path / "run").resume(tmp_path / "run")
    assert result_bytes(tmp_path / "run") == small.undisturbed
    assert (resumed.frames, resumed.interrupted) == (FRAMES, False)
    assert resumed.seconds > summary.seconds
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_a_frame_that_cannot_be_read_ends_the_run_with_what_was_read(small: SmallRecording, tmp_path: Path) -> None:
    path = small.files.color_path(SECTION + 2)
    whole = path.read_bytes()
    plan = small_plan(small.files)
    cut_in_half(path)
    try:
        with pytest.raises(SourceError, match=path.name):
            plan.execute(tmp_path / "one")
        with pytest.raises(SourceError, match=path.name):
            plan.execute_in_fleet(tmp_path / "many", Disturbance().hooks())
    finally:
        path.write_bytes(whole)

    assert result_bytes(tmp_path / "many") == result_bytes(tmp_path / "one")

"""The viewer: what it shows of runs and fleets, and that nobody waits for it."""

import json
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.chromium import Browser, chromium, shows
from helpers.cli_runs import DEADLINE_S, POLL_S, start_run, start_vtslam, wait_for
from helpers.fleet_runs import result_bytes
from helpers.rerun_files import entities_of, rows_of
from helpers.viewed_runs import ViewedRun, viewed_plan

from vtslam.common.fleet_folder import running_fleets
from vtslam.common.trajectory_io import read_trajectory
from vtslam.services.cli.__main__ import main
from vtslam.services.cli.status_command import listened
from vtslam.services.recorded_run import RecordedRun
from vtslam.services.viewer.rerun_process import page_url
from vtslam.services.viewer.sampling import kept_rows

_FRAMES, _LENGTH = 9, 3
_PAGE_S, _PAGE_POLL_S = 900.0, 1.0  # a browser without a graphics card, on a busy machine


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run."""
    out = tmp_path_factory.mktemp("finished") / "run"
    viewed_plan(frames=_FRAMES).execute(out)
    return out


def test_a_finished_run_in_a_file(finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    assert main(["view", str(finished), "--save", str(path)]) == 0
    run = RecordedRun(finished)
    for name, key in (("loss/color", "color_loss"), ("latency/track_ms", "track_s")):
        found = {int(row["frame"]): row["Scalars:scalars"][0] for row in rows_of(path, f"figures/{name}")}
        factor = 1e3 if key.endswith("_s") else 1.0
        assert found == {row["frame_id"]: pytest.approx(factor * row[key]) for row in run.rows}
    poses = {int(row["frame"]): row for row in rows_of(path, "world/camera")}
    assert set(poses) == set(range(_FRAMES))
    for frame_id, row in poses.items():
        np.testing.assert_allclose(row["Transform3D:translation"][0], run.poses[frame_id][:3, 3], atol=1e-6)
        matrix = np.reshape(row["Transform3D:mat3x3"][0], (3, 3)).T  # by columns
        np.testing.assert_allclose(matrix, run.poses[frame_id][:3, :3], atol=1e-6)
    limit = run.settings.viewer.section_gaussians
    for section_id in run.section_ids():
        section, [row] = run.section(section_id), list(rows_of(path, f"world/map/{section_id:06d}"))
        assert row["frame"] == run.frames_of(section_id)[-1]
        kept = kept_rows(section.gaussians.count, limit, key=section_id)
        T = section.T_world_section
        expected = section.means_m[kept] @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(row["GaussianSplats3D:centers"], expected, atol=1e-5)
    images = list(rows_of(path, "world/camera/input"))
    assert len(images) == _FRAMES
    decoded = cv2.imdecode(np.array(images[4]["EncodedImage:blob"][0], np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert np.abs(decoded[..., ::-1].astype(int) - run.frame(4).rgb).mean() < 8  # JPEG
    depth = list(rows_of(path, "frame/depth"))[4]
    decoded = cv2.imdecode(np.array(depth["EncodedDepthImage:blob"][0], np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    np.testing.assert_array_equal(decoded, run.frame(4).depth)
    names = entities_of(path)
    assert {"frame/rendered", "frame/residual", "world/path/true", "world/map/active", "states/000002"} <= set(names)


def test_a_fleet_shows_itself_while_it_runs_with_the_result_of_one_that_does_not(tmp_path: Path) -> None:
    path, viewed = tmp_path / "live.rrd", ViewedRun(updates=3)
    summary = viewed.execute(viewed_plan(f'viewer.save="{path}"'), tmp_path / "run")
    assert not viewed.events
    viewed_plan(frames=summary.frames).execute(tmp_path / "alone")
    assert result_bytes(tmp_path / "run") == result_bytes(tmp_path / "alone")
    committed = read_trajectory(tmp_path / "run/trajectory.txt").poses
    shown = {int(row["frame"]): row["Transform3D:translation"][0] for row in rows_of(path, "world/camera")}
    assert len(shown) >= 3
    for frame_id, position_m in shown.items():
        np.testing.assert_allclose(position_m, committed[frame_id][:3, 3], atol=1e-5)
    names = entities_of(path)
    assert {"figures/memory/map_mb", "figures/memory/mapper_mb", "frame/rendered", "world/path/true"} <= set(names)
    assert all(count == 1 for name, count in names.items() if name.startswith("world/map/0")), "sections are sent once"
    assert all("frame" not in row for row in rows_of(path, "world/map/000000")), "and hold for good"


@pytest.mark.parametrize("disturbance", [signal.SIGKILL, signal.SIGSTOP])
def test_a_fleet_goes_on_when_its_viewer_is_killed_or_hangs(disturbance: signal.Signals, tmp_path: Path) -> None:
    viewed = ViewedRun(updates=1, disturbance=disturbance)
    summary = viewed.execute(viewed_plan(f'viewer.save="{tmp_path / "live.rrd"}"'), tmp_path / "run")
    assert summary.frames >= viewed.further
    assert viewed.starts == {"sensor": 1, "tracker": 1, "mapper": 1, "archiver": 1, "viewer": 1}, (
        "nothing is started again"
    )
    killed = disturbance is signal.SIGKILL
    assert viewed.deaths == {"sensor": 0, "tracker": 0, "mapper": 0, "archiver": 0, "viewer": int(killed)}
    assert viewed.events == (["viewer: killed by signal 9; the fleet goes on without it"] if killed else [])
    viewed_plan(frames=summary.frames).execute(tmp_path / "alone")
    assert result_bytes(tmp_path / "run") == result_bytes(tmp_path / "alone")


def test_a_fleet_goes_on_without_a_viewer_that_cannot_start(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        viewed = ViewedRun(updates=0, further=0)
        viewed.execute(viewed_plan(f"viewer.web_port={port}", frames=200), tmp_path / "run")
    if viewed.events:  # the run may be over before the viewer has come so far
        assert viewed.events == [f"viewer: port {port} of 127.0.0.1 cannot be had: Address already in use; "
                                 "choose another one; the fleet goes on without it"]  # fmt: skip


def test_a_running_fleet_is_viewed_from_outside(tmp_path: Path) -> None:
    path, run = tmp_path / "live.rrd", start_run(tmp_path / "run", "--set", "viewer.idle=false")
    viewer: subprocess.Popen[str] | None = None
    try:
        wait_for(tmp_path / "run" / "sections" / "000000.vts", run)
        fleet = next(name for name in running_fleets() if name.startswith(f"run-{run.pid}-"))
        viewer = start_vtslam("view", "--live", "--fleet", fleet, "--save", str(path))
        _wait(lambda: any(
            each.name.startswith("viewer-") and each.status is not None and each.status.counters.get("updates.shown")
            for each in listened(fleet)
        ))  # fmt: skip
        run.send_signal(signal.SIGINT)
        assert run.wait(DEADLINE_S) == 130
        output, _ = viewer.communicate(timeout=DEADLINE_S)
    finally:
        for process in filter(None, (run, viewer)):
            process.kill()
            process.communicate()
    assert viewer.returncode == 0, output
    assert f"fleet {fleet}: " in output
    assert len(list(rows_of(path, "world/camera"))) >= 1


def test_refusals_say_what_to_do(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    run, nowhere = str(finished), str(tmp_path / "none" / "x.rrd")
    for words, status, text in (
        (["view"], 2, "expected either RUN or --live"),
        (["view", run, "--live"], 2, "expected either RUN or --live"),
        (["view", str(tmp_path)], 1, "not a run folder"),
        (["view", run], 1, "there is no display to open a window on: use --web, or --save FILE.rrd"),
        (["view", run, "--save", nowhere], 1, "cannot be written: No such file or directory"),
        (["view", run, "--save", str(tmp_path / "x.mp4")], 1, "expected a name that ends in .rrd"),
        (["view", run, "--film", str(tmp_path / "x.mp4")], 1, "expected a name that ends in .webp or .gif"),
        (["view", run, "--web", "--port", "70000"], 2, "expected 1 to 65534"),
        (["view", "--live", "--film", "x.webp"], 2, "expected a finished RUN"),
        (["view", run, "--fleet", "x"], 2, f"--fleet x: expected --live beside it, found the run {run}"),
        (["view", run, "--save", "x.rrd", "--port", "7"], 2, "--port 7: expected --web beside it, found none"),
        (["view", run, "--film", "x.gif", "--web"], 2, "--film x.gif: expected alone, found --web beside it"),
        (["view", run, "--film", "x.gif", "--save", "x.rrd"], 2, "expected alone, found --save beside it"),
        (["view", "--live", "--fleet", "none-of-that-name"], 1, "expected the folder of a fleet, found nothing"),
    ):
        assert main(words) == status, words
        assert text in capsys.readouterr().err


def test_a_film_has_a_picture_for_each_frame_and_grows(finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "film.webp"
    assert main(["view", str(finished), "--film", str(path)]) == 0
    found, animation = cv2.imreadanimation(str(path))
    assert found
    assert len(animation.frames) == _FRAMES
    dark = [int((np.asarray(picture)[30:330, :440, :3].min(axis=2) < 200).sum()) for picture in animation.frames]
    assert dark[0] > 0
    assert dark[-1] > dark[0], "more of the map is there at the end"


def test_a_browser_shows_the_run(finished: Path, tmp_path: Path) -> None:
    chromium()
    with _page(finished) as url, Browser(url, tmp_path / "browser", deadline_s=_PAGE_S) as browser:
        last = np.ascontiguousarray(RecordedRun(finished).frame(_FRAMES - 1).rgb[..., ::-1])
        deadline_s, found = time.monotonic() + _PAGE_S, -1.0
        while found < 0.9:
            assert time.monotonic() < deadline_s, f"the last frame's input is not in the page: {found:.2f}"
            time.sleep(_PAGE_POLL_S)
            found = shows(browser.picture(), last)


@contextmanager
def _page(run: Path) -> Iterator[str]:
    """The run's page, served."""
    port = _two_free_ports()
    server = start_vtslam("view", str(run), "--web", "--port", str(port))
    try:
        assert server.stdout is not None
        assert any(page_url(port) in line for line in server.stdout), "the command says where the page is"
        listening = _listening(port) + _listening(port + 1)
        assert listening == ["127.0.0.1", "127.0.0.1"]
        yield page_url(port)
        server.send_signal(signal.SIGINT)
        server.communicate(timeout=DEADLINE_S)
        assert server.returncode == 0
    finally:
        server.kill()
        server.communicate()


def _two_free_ports() -> int:
    for port in range(42100, 48000, 2):
        try:
            for each in (port, port + 1):
                with socket.socket() as probe:
                    probe.bind(("127.0.0.1", each))
        except OSError:
            continue
        return port
    raise AssertionError("no two free ports")


def _listening(port: int) -> list[str]:
    """Addresses at which somebody listens on a port."""
    found = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text().splitlines()[1:]:
            words = line.split()
            address, _, hexadecimal = words[1].partition(":")
            if words[3] == "0A" and int(hexadecimal, 16) == port:
                found.append(socket.inet_ntoa(bytes.fromhex(address)[::-1]) if len(address) == 8 else address)
    return found


def _wait(is_so: Callable[[], bool]) -> None:
    for _ in range(int(2 * DEADLINE_S / POLL_S)):
        if is_so():
            return
        time.sleep(POLL_S)
    raise AssertionError("it did not come to that in time")


def test_the_cost_of_a_viewer_is_measured(tmp_path: Path) -> None:
    path = tmp_path / "bench.json"
    words = ["--size", "48x36", "--set", "section.length=3", "--set", "mapper.iterations_regular=1"]
    assert main(["bench", "viewer", "sim:room", "--frames", "0:6", "--rounds", "1", *words, "--json", str(path)]) == 0
    found = json.loads(path.read_text())
    assert set(found["updates_shown"]) == {"with", "killed", "hung"}
    for kind in ("with", "killed", "hung"):
        assert found[f"{kind}_wall_ratio"] > 0
        assert len(found[kind]["wall_s"]) == 1

"""``vtslam bench`` as a user runs it: figures on standard output and as JSON, set beside an earlier result."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.fleet_runs import SmallRecording, small_plan

from vtslam.services.bench.chaos import bench_chaos, is_sound
from vtslam.services.bench.codec import RATE_COARSENESS
from vtslam.services.bench.comparison import comparison_table, flat
from vtslam.services.bench.resume import bench_resume, is_whole
from vtslam.services.bench.splat import yardstick_scene
from vtslam.services.cli.__main__ import main

SMALL = ["sim:room?frames=5", "--size", "64x48", "--set", "section.length=3"]


def bench(*arguments: str, result: Path) -> dict[str, Any]:
    assert main(["bench", *arguments, "--json", str(result)]) == 0
    values: dict[str, Any] = json.loads(result.read_text())
    return values


def test_the_yardstick_scene_has_a_gaussian_of_one_pixel_at_each_pixel() -> None:
    splats, camera = yardstick_scene(64, 48)
    assert splats.count == 64 * 48
    assert camera.fx == camera.fy == pytest.approx(0.9 * 64)
    z = splats.means_m[:, 2]
    np.testing.assert_allclose(np.exp(splats.log_radii) * camera.fx / z, 1.0, rtol=1e-5)
    pixels = splats.means_m[:, :2] / z[:, None] * camera.fx + [camera.cx, camera.cy]
    np.testing.assert_allclose(pixels.reshape(48, 64, 2)[7, 11], [11.5, 7.5], atol=1e-4)
    assert not splats.opacity_logits.any()


def test_splat_reports_times_and_where_they_were_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = tmp_path / "first.json"
    values = bench("splat", "--size", "96x64", "--threads", "1", "--repeats", "3", result=first)
    assert 0 < values["forward_ms"] < values["forward_backward_ms"]
    assert values["loss_ms"] > 0
    assert (values["gaussians"], values["threads"], values["repeats"]) == (96 * 64, 1, 3)
    assert values["simd"] in ("avx512", "avx2", "portable")
    assert set(values["about"]) == {"command", "processor", "commit", "versions"}
    capsys.readouterr()
    bench("splat", "--size", "96x64", "--repeats", "1", "--compare", str(first), result=tmp_path / "second.json")
    table = capsys.readouterr().out
    assert "before" in table
    assert "forward_backward_ms" in table


def test_choosing_overlapping_sections_looks_at_few_views_of_many(tmp_path: Path) -> None:
    words = ["--views", "3000", "--size", "80x24"]
    values = bench("overlap", *words, result=tmp_path / "overlap.json")
    assert (values["views"], values["width"], values["height"]) == (3000, 80, 24)
    assert min(values[key] for key in ("select_ms", "select_ms_tenth", "neighbour_ms", "growth")) > 0
    assert 1 <= values["views_looked_at"] < 40
    assert values["bytes_per_view"] < 1000


def test_curves_show_what_more_steps_are_worth(tmp_path: Path) -> None:
    words = ["sim:room?frames=4", "--size", "48x36", "--set", "section.length=2", "--shares", "0.2,1"]
    picture = tmp_path / "curves.png"
    values = bench("curves", *words, "--picture", str(picture), result=tmp_path / "curves.json")
    for preset in ("fast", "paper"):
        few, many = values[preset]["0.2"], values[preset]["1"]
        assert few["renders_per_frame"]["map"] < many["renders_per_frame"]["map"]
        assert few["psnr_paper_db"] < many["psnr_paper_db"]
    assert picture.stat().st_size > 1000
    assert main(["bench", "curves", *words, "--presets", "fast,paper,released"]) == 2
    assert main(["bench", "curves", *words[:-1], "1,x"]) == 2


def test_a_drive_through_town_tells_what_grows(tmp_path: Path) -> None:
    words = ["--frames", "10", "--size", "80x24", "--budget-mb", "3", "--pose-prior", "0.3,0.5"]
    values = bench("city", *words, "--set", "section.length=2", result=tmp_path / "city.json")
    assert (values["frames"], values["sections"], values["lost"]) == (10, 5, 0)
    assert 0 < values["shm_peak_mb"] <= 3.0
    assert min(values[key] for key in ("map_mb", "map_disk_mb", "recording_mb", "disk_mb_per_s")) > 0
    # On a busy machine all frames may lie between two looks at the fleet, so that growth is not known.
    assert set(values["rss_growth_by_process"]) == {"sensor", "tracker", "mapper", "archiver", "supervisor"}
    assert set(values["time_growth_by_process"]) == set(values["rss_growth_by_process"])
    assert all(values[key] is None or values[key] >= 0 for key in ("rss_growth", "time_growth"))
    assert values["sections_reloaded"] >= 0
    assert values["ate_rmse_m"] < 0.3
    assert values["drift_pct"] is None  # of stretches of 100 m


def test_track_stands_beside_opencv_on_the_same_frames(tmp_path: Path) -> None:
    values = bench("track", *SMALL, result=tmp_path / "track.json")
    assert values["ate_rmse_m"] < 0.02
    assert values["opencv_ms"] > 0
    assert values["times_opencv"] == pytest.approx(values["track_ms"] / values["opencv_ms"], abs=1e-3)
    assert values["lost"] == 0


def test_small_errors_of_the_guess_are_mended_by_both_optimisers(tmp_path: Path) -> None:
    values = bench(
        "basin", "sim:room?frames=7", "--size", "64x48", "--trials", "2", "--set", "tracker.adam.iterations=30",
        "--set", "tracker.adam.first_section_iterations=30", result=tmp_path / "basin.json",
    )  # fmt: skip
    assert values["trials"] == 2
    for name in ("gauss_newton", "adam"):
        shares = values[name]["found"]
        assert list(shares) == ["1 cm, 0.5 deg", "2 cm, 1 deg", "5 cm, 2.5 deg", "10 cm, 5 deg"]
        assert shares["1 cm, 0.5 deg"] == 1.0
    assert values["gauss_newton"]["renders_per_frame"] < values["adam"]["renders_per_frame"] == 30


def test_a_basin_needs_frames_to_map_and_to_track(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "basin", "sim:room?frames=5", "--size", "64x48"]) == 2
    assert "expected at least 6 frames, found 5" in capsys.readouterr().err


def test_variants_are_compared_on_the_same_frames_and_guesses(tmp_path: Path) -> None:
    few = ["--only", "forward,inverse,opencv_previous", "--trials", "2"]
    values = bench("variants", "sim:room?frames=8", "--size", "80x60", *few, result=tmp_path / "variants.json")
    assert (values["tracked"], values["trials"]) == (4, 2)
    assert set(values) == {"bench", "tracked", "trials", "gaussians", "forward", "inverse", "opencv_previous", "about"}
    for name, arithmetic in (("forward", "product"), ("inverse", "numpy")):
        row = values[name]
        assert 0 < row["translation_median_mm"] <= row["translation_p95_mm"] < 10
        assert 0 < row["rotation_median_deg"] <= row["rotation_p95_deg"] < 0.5
        assert list(row["found"]) == ["1 cm, 0.5 deg", "2 cm, 1 deg", "5 cm, 2.5 deg", "10 cm, 5 deg"]
        assert row["found_share"] >= 0.75
        assert 1 <= row["full_size_renders"] == row["renders"] <= 3
        assert row["arithmetic"] == arithmetic
    odometry = values["opencv_previous"]
    assert (odometry["found_share"], odometry["found"], odometry["renders"]) == (None, {}, 0)
    assert odometry["translation_median_mm"] < 10


def test_variants_that_there_are_not_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room = ["bench", "variants", "sim:room?frames=6", "--size", "64x48"]
    assert main([*room, "--only", "forward,sideways"]) == 2
    assert "found sideways" in capsys.readouterr().err
    assert main(["bench", "variants", "sim:room?frames=5", "--size", "64x48"]) == 2
    assert "expected at least 6 frames, found 5" in capsys.readouterr().err
    assert main([*room, "--trials", "-1"]) == 2


def test_map_is_done_at_the_true_poses(tmp_path: Path) -> None:
    values = bench("map", *SMALL, result=tmp_path / "map.json")
    assert values["renders_per_frame"]["track"] == 0
    assert values["renders_per_frame"]["map"] > 0
    assert values["psnr_full_db"] > 20


def test_system_tells_where_the_time_goes(tmp_path: Path) -> None:
    values = bench("system", *SMALL, result=tmp_path / "system.json")
    stages = values["stages_ms"]
    parts = sum(stages[name] for name in ("read", "track", "map", "other"))
    assert parts == pytest.approx(stages["total"], abs=0.01)
    assert values["frames"] == 5
    assert values["sections"] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["splat", "--size", "640"], "--size: expected WIDTHxHEIGHT"),
        (["splat", "--size", "0x10"], "--size: expected WIDTHxHEIGHT"),
        (["splat", "--repeats", "0"], "expected --threads and --repeats of at least 1"),
        (["splat", "--compare", "nowhere.json"], "--compare nowhere.json: cannot read"),
    ],
)
def test_bad_arguments_are_told(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_results_of_another_benchmark_are_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"bench": "map"}))
    assert main(["bench", "splat", "--compare", str(other)]) == 2
    assert "expected a result of bench splat, found map" in capsys.readouterr().err
    other.write_text("[]")
    assert main(["bench", "splat", "--compare", str(other)]) == 2
    assert "expected a result of vtslam bench" in capsys.readouterr().err


def test_a_ratio_stands_only_between_numbers() -> None:
    table = comparison_table({"a": 2.0, "b": {"c": None, "d": "x"}}, {"a": 4.0, "b": {"c": 1.0}})
    rows = {line.split()[0]: line.split()[1:] for line in table.splitlines()[1:]}
    assert rows == {"a": ["2", "4", "0.500"], "b.c": ["-", "1"], "b.d": ["x", "-"]}
    assert flat({"b": {"c": {"d": 1}}}) == {"b.c.d": 1}


def test_a_fleet_under_fire_loses_nothing(small: SmallRecording) -> None:
    values = bench_chaos(small_plan(small.files), kills=4, hangs=0, seed=2, on_frame=lambda facts: None)

    assert is_sound(values)
    assert values["kills"] >= 3  # the sensor may have finished before its turn
    assert values["kills_in_shm_write"] >= 1


def test_a_fleet_killed_as_a_whole_and_resumed_gives_the_same(small: SmallRecording) -> None:
    told: list[None] = []
    values = bench_resume(small_plan(small.files), kills=2, seed=3, on_kill=lambda: told.append(None))

    assert is_whole(values, kills=2)
    assert values == {"frames": 20, "kills": 2, "identical": True, "sections": 4, "sections_verified": 4}
    assert len(told) == 2
    assert not is_whole({**values, "sections_verified": 3}, kills=2)
    assert not is_whole({**values, "identical": False}, kills=2)


def test_codec_reports_bytes_quality_and_speed(tmp_path: Path) -> None:
    source = ["--source", "sim:room?frames=8", "--size", "64x48", "--set", "section.length=4", "--holdout", "3"]
    picture = tmp_path / "codec.png"
    values = bench("codec", *source, "--curves", "--picture", str(picture), result=tmp_path / "codec.json")
    assert picture.stat().st_size > 1000
    sizes = [values[codec]["bytes_per_gaussian"] for codec in ("lossless", "fast", "dense")]
    assert sizes == sorted(sizes, reverse=True)
    assert values["lossless"]["exact"]
    assert values["lossless"]["psnr_loss_db"] == values["lossless"]["heldout_loss_db"] == 0.0
    for codec in ("lossless", "fast", "dense", "dense_rate"):
        assert values[codec]["encode_mb_s"] > 0
        assert values[codec]["decode_mb_s"] > 0
        assert values[codec]["file_bytes_per_gaussian"] > values[codec]["bytes_per_gaussian"]
    assert values["rate_coarseness"] == RATE_COARSENESS
    curve = values["curves"]["dense"]
    assert [point["bytes_per_gaussian"] for point in curve] == sorted(
        (point["bytes_per_gaussian"] for point in curve), reverse=True
    )
    # Frames that the map was fitted to: few held-out pixels of so small a map may gain from coarser steps.
    assert curve[0]["psnr_paper_db"] > curve[-1]["psnr_paper_db"]
    assert curve[1]["bytes_per_gaussian"] == values["dense"]["bytes_per_gaussian"]

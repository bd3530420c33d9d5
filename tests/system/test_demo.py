"""The demo, made tiny: figures, pictures, and what it may replace."""

import json
from pathlib import Path

import cv2
import pytest

from vtslam.services.cli.__main__ import main

SMALL = ("--set", "source.size=64x48", "--set", "source.frames=0:6", "--set", "section.length=3")


def test_the_demo_reports_and_draws_and_may_be_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out), *SMALL]) == 0
    first = (out / "trajectory.txt").read_bytes()
    printed = capsys.readouterr().out
    assert main(["demo", "--out", str(out), *SMALL, "--json", str(tmp_path / "report.json")]) == 0

    report = json.loads((out / "report.json").read_text())
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics.items() <= report.items()
    assert report["frames"] == 6
    assert json.loads((tmp_path / "report.json").read_text()) == report
    assert report["run"]["source"].startswith("sim:room?frames=60")
    assert (out / "trajectory.txt").read_bytes() == first
    for name in report["pictures"]:
        assert cv2.imread(str(out / name)) is not None, name
    assert {"pictures/overview.png", "pictures/trajectory.png"} < set(report["pictures"])
    assert printed.splitlines()[-1].split() == ["look", "at:", str(out / "pictures" / "overview.png")]


def test_the_demo_does_not_replace_another_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    words = ["run", "sim:room", "--in-process", "--size", "48x36", "--frames", "0:2", "--out", str(out)]
    assert main(words) == 0
    before = (out / "run.toml").read_bytes()

    assert main(["demo", "--out", str(out), *SMALL]) == 1
    assert "already a run here" in capsys.readouterr().err
    assert (out / "run.toml").read_bytes() == before

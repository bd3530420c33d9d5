"""The command line before it does anything: help, refusals, exit statuses."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.processes import source_environment

from vtslam.services.cli import doctor_gpu
from vtslam.services.cli.__main__ import main

COMMANDS = ("demo", "run", "up", "publish", "status", "eval", "settings", "doctor")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])

    assert end.value.code == 0
    assert f"example:\n  vtslam {command}" in capsys.readouterr().out


def test_help_imports_nothing_slow() -> None:
    code = (
        "import sys; from vtslam.services.cli.__main__ import main\n"
        "try: main(['--help'])\n"
        "finally: print(sorted({'numpy', 'cv2', 'torch', 'tqdm'} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], env=source_environment(), capture_output=True, text=True)

    assert done.stdout.startswith("usage: vtslam")
    assert done.stderr.strip() == "[]"


def test_without_a_command_it_says_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "usage: vtslam" in capsys.readouterr().err


RUN = ("run", "sim:room", "--size", "48x36", "--frames", "0:2", "--out", "out/run")


@pytest.mark.parametrize(
    ("words", "status", "text"),
    [
        ((*RUN, "--set", "fleet.map_budget_mb=0"), 2, "fleet.map_budget_mb = 0: expected an integer"),
        ((*RUN, "--in-process", "--set", "section.lenght=3"), 2, "did you mean section.length?"),
        ((*RUN, "--in-process", "--set", "section.length=1"), 2, "expected an integer in the range [2, 10000]"),
        ((*RUN, "--in-process", "--holdout", "-1"), 2, "holdout = -1: expected an integer >= 0"),
        ((*RUN, "--in-process", "--set", "splat.engine=naive"), 2, "did you mean native?"),
        ((*RUN, "--in-process", "--preset", "best"), 2, "unknown schedule 'best'"),
        ((*RUN, "--in-process", "--family", "mars"), 2, "unknown family 'mars'"),
        ((*RUN, "--in-process", "--config", "none.toml"), 2, "none.toml: cannot read"),
        ((*RUN, "--in-process", "--json", "nowhere/x.json"), 2, "there is no folder nowhere"),
        ((*RUN, "--in-process", "--size", "48"), 1, "expected WxH"),
        ((*RUN, "--in-process", "--frames", "5:2"), 1, "0 <= A < B"),
        ((*RUN, "--in-process", "--set", "source.noise=loud"), 2, 'expected one of "", "none", "kinect"'),
        (("run", "film:x", "--in-process", "--out", "out"), 1, "found 'film:x'"),
        (("run", "replica:nowhere", "--in-process", "--out", "out"), 1, "expected a folder of a recording"),
        (("eval", "nowhere"), 1, "not a run folder"),
        (("doctor", "sim:room", "--gpu"), 2, "expected a recording to look at or --gpu, found sim:room and --gpu"),
        (("settings", "--set", "seed=x"), 2, "expected an integer"),
    ],
)
def test_refusals_are_one_line_and_start_nothing(
    words: tuple[str, ...],
    status: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)

    assert main(words) == status
    error = capsys.readouterr().err
    assert text in error
    assert error.startswith("vtslam: ")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_settings_lists_effective_values(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "--preset", "paper", "--family", "replica", "--set", "seed=7", "--json", "-"]) == 0
    captured = capsys.readouterr()

    values = {row["key"]: row["value"] for row in json.loads(captured.out)["settings"]}
    assert values["seed"] == 7
    assert values["section.length"] == 40  # of the family
    assert any(line.split()[:2] == ["section.length", "40"] for line in captured.err.splitlines())


def test_doctor_is_content_here_and_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json", "-"]) == 0
    findings = {finding["name"]: finding for finding in json.loads(capsys.readouterr().out)["findings"]}

    assert findings["portable"]["found"].startswith("renders the known numbers")
    assert all(finding["ok"] for finding in findings.values())


@pytest.mark.parametrize("status", [0, 1, 2])
def test_doctor_says_of_the_gpu_what_it_found(
    status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor_gpu, "run_gpu_doctor", lambda out: status)
    assert main(["doctor", "--gpu", "--json", "-"]) == status
    assert json.loads(capsys.readouterr().out) == {"ok": status == 0, "status": status}


def test_tracking_on_the_command_line_counts_more_than_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "off.toml").write_text("tracker.enabled = false\n")
    words = [*RUN[:-2], "--in-process", "--config", str(tmp_path / "off.toml")]
    assert main([*words, "--tracking", "on", "--out", str(tmp_path / "run")]) == 0
    assert main([*words, "--out", str(tmp_path / "none")]) == 2

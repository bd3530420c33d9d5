import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.processes import source_environment

from vtslam.common import failpoints

_PASS_THREE_TIMES = """
from vtslam.common import failpoints
for passage in range(3):
    failpoints.reach("shm.commit.before_flip")
    print(passage, flush=True)
"""


def _run(setting: str) -> subprocess.CompletedProcess[str]:
    environment = source_environment() | {failpoints.VARIABLE: setting}
    return subprocess.run(
        [sys.executable, "-c", _PASS_THREE_TIMES], env=environment, capture_output=True, text=True, check=False
    )


def test_a_process_dies_at_the_passage_named() -> None:
    done = _run("shm.commit.before_flip:3")
    assert (done.returncode, done.stdout) == (-9, "0\n1\n")


def test_other_points_and_later_passages_do_nothing() -> None:
    assert _run("shm.commit.after_flip:1").returncode == 0
    assert _run("shm.commit.before_flip:4").returncode == 0


@pytest.mark.parametrize("text", ["no.such.point:1", "shm.commit.before_flip", "shm.commit.before_flip:0", ":1"])
def test_a_setting_that_names_nothing_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="VTSLAM_FAILPOINT: expected NAME:K"):
        failpoints.arm(text)


def test_every_name_is_placed_and_every_placed_name_is_known() -> None:
    root = Path(failpoints.__file__).parents[1]
    files = [path for name in ("common", "storage", "services") for path in (root / name).rglob("*.py")]
    text = "\n".join(path.read_text() for path in files)
    assert set(re.findall(r'failpoints\.reach\("([^"]+)"\)', text)) == set(failpoints.NAMES)

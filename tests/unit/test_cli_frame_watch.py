"""What the person in front of a run is told."""

import pytest
from helpers.facts import frame_facts

from vtslam.services.cli.console import Progress
from vtslam.services.cli.frame_watch import FrameWatch
from vtslam.services.frame_facts import FrameFacts


def facts(frame_id: int, state: str) -> FrameFacts:
    return frame_facts(frame_id, state=state, covered_share=0.004)


def test_a_loss_of_tracking_is_told_once_and_so_is_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    watch = FrameWatch(Progress(6, what="mapping", unit="frame"))
    for frame_id, state in enumerate(["first", "ok", "lost", "lost", "weak", "ok"]):
        watch(facts(frame_id, state))

    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("frame ")]
    assert lines == [
        "frame 2: tracking lost (0.4 % of the image usable); poses are guesses until it is found again",
        "frame 4: tracking again, lost since frame 2",
    ]

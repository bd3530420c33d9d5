"""What the person in front of a run is told."""

import pytest

from vtslam.services.cli.console import Progress
from vtslam.services.cli.frame_watch import FrameWatch
from vtslam.services.frame_facts import FrameFacts


def facts(frame_id: int, state: str) -> FrameFacts:
    return FrameFacts(
        frame_id=frame_id,
        section_id=0,
        is_head=False,
        held_out=False,
        state=state,
        tracked_section_id=0,
        rescued=False,
        covered_share=0.004,
        color_loss=0.0,
        depth_loss_m=0.0,
        position_sigma_m=0.0,
        rotation_sigma_rad=0.0,
        exposure_gain=(1.0, 1.0, 1.0),
        exposure_offset=(0.0, 0.0, 0.0),
        map_loss=0.0,
        gaussians_added=0,
        gaussians=0,
        track_renders=0,
        map_renders=0,
        read_s=0.0,
        track_s=0.0,
        map_s=0.0,
        total_s=0.0,
    )


def test_a_loss_of_tracking_is_told_once_and_so_is_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    watch = FrameWatch(Progress(6, what="mapping", unit="frame"))
    for frame_id, state in enumerate(["first", "ok", "lost", "lost", "weak", "ok"]):
        watch(facts(frame_id, state))

    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("frame ")]
    assert lines == [
        "frame 2: tracking lost (0.4 % of the image usable); poses are guesses until it is found again",
        "frame 4: tracking again, lost since frame 2",
    ]

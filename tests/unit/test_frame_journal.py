import errno
import os
from pathlib import Path

import numpy as np
import pytest

from vtslam.common.shm.errors import SharedMemoryFull
from vtslam.services.frame_facts import CommittedFrame, FrameFacts
from vtslam.services.frame_journal import JournalReader, JournalWriter


def committed(frame_id: int) -> CommittedFrame:
    facts = FrameFacts(
        frame_id=frame_id,
        section_id=0,
        is_head=False,
        held_out=False,
        state="ok",
        tracked_section_id=0,
        rescued=False,
        covered_share=1.0,
        color_loss=0.1,
        depth_loss_m=0.1,
        position_sigma_m=0.0,
        rotation_sigma_rad=0.0,
        exposure_gain=(1.0, 1.0, 1.0),
        exposure_offset=(0.0, 0.0, 0.0),
        map_loss=0.1,
        gaussians_added=1,
        gaussians=1,
        track_renders=1,
        map_renders=1,
        read_s=0.0,
        track_s=0.0,
        map_s=0.0,
        total_s=0.0,
    )
    return CommittedFrame(facts=facts, capture_time_ns=frame_id, T_world_camera=np.eye(4))


def test_a_line_that_does_not_fit_leaves_nothing_and_can_be_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer, reader = JournalWriter(tmp_path / "journal"), JournalReader(tmp_path / "journal")
    writer.append(committed(0))
    real, calls = os.write, []

    def full_after_some_bytes(fd: int, data: bytes) -> int:
        calls.append(len(data))
        if len(calls) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(fd, data[:10])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full_after_some_bytes)
        with pytest.raises(SharedMemoryFull, match=r"journal: \d+ bytes of shared memory wanted"):
            writer.append(committed(1))
    writer.append(committed(2))
    writer.close()

    assert len(calls) == 2
    assert [frame.facts.frame_id for frame in reader.new_frames()] == [0, 2]

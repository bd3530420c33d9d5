"""The examination of recordings names the fault that was put in, and nothing else."""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.broken_recordings import FAULTS, broken, late_depth, shifted_color
from helpers.shared_data import shared_data

from vtslam.common.frame import Frame
from vtslam.services.cli.__main__ import main
from vtslam.services.sensor.sources.base import Source, SourceAround
from vtslam.services.sensor.sources.registry import open_source
from vtslam.services.sensor_check.edges import EdgeEvidence
from vtslam.services.sensor_check.examination import BURST, examine, planned_looks
from vtslam.services.sensor_check.findings import CheckFinding

NAMES = (
    "depth scale",
    "focal lengths",
    "principal point",
    "registration",
    "time offset",
    "frozen frames",
    "blank frames",
    "motion",
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Kept(SourceAround):
    """A source that reads each frame once."""

    frames: dict[int, Frame] = field(default_factory=dict)

    @classmethod
    def of(cls, source: Source) -> "Kept":
        return cls(inner=source, uri=source.uri)

    def frame(self, index: int) -> Frame:
        if index not in self.frames:
            self.frames[index] = self.inner.frame(index)
        return self.frames[index]


@pytest.fixture(scope="module")
def room() -> Source:
    return Kept.of(open_source("sim:room?frames=72&size=200x150"))


@pytest.fixture(scope="module")
def kitchen() -> Source:
    """As much of it as shows every fault."""
    return Kept.of(open_source(f"replica:{shared_data('redkitchen')}", size=(320, 240), frames=(0, 90)))


def findings(source: Source) -> dict[str, CheckFinding]:
    looks = planned_looks(len(source))
    frames = (source.frame(index) for index in looks.frames)
    seen = examine(frames, looks, family=source.family, truth=source.ground_truth())
    return {finding.name: finding for finding in seen}


def faults(source: Source) -> list[str]:
    return [finding.name for finding in findings(source).values() if not finding.ok]


def test_the_simulated_room_is_sound(room: Source) -> None:
    assert faults(room) == []


@pytest.mark.parametrize("fault", FAULTS)
def test_names_the_fault_in_the_simulated_room(room: Source, fault: str) -> None:
    assert faults(broken(room, fault)) == [next(name for name in NAMES if fault.startswith(name))]


def test_redkitchen_is_sound() -> None:
    assert faults(open_source(f"replica:{shared_data('redkitchen')}", size=(320, 240))) == []


@pytest.mark.parametrize("fault", NAMES)
def test_names_the_fault_in_redkitchen(kitchen: Source, fault: str) -> None:
    assert faults(broken(kitchen, fault)) == [fault]


def test_says_how_far_color_was_shifted() -> None:
    source = open_source(f"replica:{shared_data('redkitchen')}", frames=(0, 90))
    finding = findings(shifted_color(source, 12))["registration"]
    assert not finding.ok
    assert abs(finding.values["shift_right_px"] - 12.0) < 2.0
    assert abs(finding.values["shift_down_px"]) < 2.5


def test_says_how_far_color_was_shifted_to_the_left(kitchen: Source) -> None:
    finding = findings(shifted_color(kitchen, -6))["registration"]
    assert not finding.ok
    assert abs(finding.values["shift_right_px"] + 6.0) < 1.0


def test_finds_one_blank_frame_anywhere(room: Source) -> None:
    """In images of noise, where only this check has anything to say."""
    rng, looks = np.random.default_rng(5), planned_looks(400)
    small = room.frame(0).resized(40, 30)

    def frame(index: int) -> Frame:
        rgb = np.full_like(small.rgb, 200) if index == 217 else rng.integers(0, 256, small.rgb.shape, np.uint8)
        return replace(small, frame_id=index, rgb=rgb)

    seen = {finding.name: finding for finding in examine(map(frame, looks.frames), looks, family="tum", truth=None)}
    assert seen["blank frames"].found == "nothing to see in the colour of frame 217"


@pytest.mark.parametrize("lag", [2, 3])
def test_says_how_late_depth_is(room: Source, lag: int) -> None:
    finding = findings(late_depth(room, lag))["time offset"]
    assert abs(finding.values["depth_late_frames"] - lag) < 0.5
    assert "older than the colour" in finding.found


def test_says_by_how_much_the_depth_scale_is_wrong(room: Source) -> None:
    found = findings(broken(room, "depth scale"))["depth scale"].values
    assert found["depth_over_true"] == pytest.approx(0.2, rel=0.1)


def test_kitti_is_sound() -> None:
    """A part of it: its depth from stereo takes half a second a frame."""
    source = open_source(f"kitti:{shared_data('kitti06_stereo')}?depth=stereo", frames=(0, 18))
    assert faults(source) == []


@pytest.mark.parametrize(("count", "looked_at"), [(1, 1), (BURST, BURST), (20, 20), (400, 400), (100_000, 400)])
def test_looks_at_the_first_frames_and_others_all_over(count: int, looked_at: int) -> None:
    looks = planned_looks(count)
    assert (looks.frames[0], looks.frames[-1]) == (0, count - 1)
    assert 0.95 * looked_at <= len(looks.frames) <= looked_at
    assert looks.frames == sorted(set(looks.frames))
    for end in looks.ends:
        assert set(range(max(0, end - BURST + 1), end + 1)) <= set(looks.frames)


def test_few_frames_without_depth_or_texture(room: Source) -> None:
    frame = room.frame(0)
    empty = replace(frame, rgb=np.zeros_like(frame.rgb), depth=np.zeros_like(frame.depth))
    seen = {finding.name: finding for finding in examine([empty], planned_looks(1), family="tum", truth=None)}
    assert [name for name, finding in seen.items() if not finding.ok] == ["blank frames"]
    assert all(
        "cannot be told" in seen[name].found for name in ("depth scale", "registration", "time offset", "motion")
    )


def test_intrinsics_of_another_image_size(room: Source) -> None:
    frame = room.frame(0)
    other = replace(frame, camera=replace(frame.camera, cx=400.0, cy=300.0))
    seen = {finding.name: finding for finding in examine([other], planned_looks(1), family="tum", truth=None)}
    assert "intrinsics of another image size" in seen["principal point"].found


def test_edges_of_a_square_show_the_shift_between_the_images() -> None:
    evidence = EdgeEvidence(0)
    for place in (40, 70, 100):
        depth_m = np.full((160, 200), 3.0, np.float32)
        gray = np.full((160, 200), 60, np.uint8)
        cv2.rectangle(depth_m, (place, 50), (place + 45, 90), 1.0, -1)
        cv2.rectangle(gray, (place + 5, 47), (place + 50, 87), 200, -1)
        evidence.add([gray], [depth_m], 0)
    seen = evidence.alignment()
    assert seen is not None
    assert seen.shift_px == pytest.approx((5.0, -3.0), abs=0.6)
    assert seen.clear
    assert seen.lag_frames is None


def test_command_examines_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "report.json"
    assert main(["doctor", "sim:room?frames=9&size=96x72", "--json", str(report)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(NAMES)
    assert all(line.startswith("ok  ") for line in lines)
    content = json.loads(report.read_text())
    assert content["ok"] is True
    assert [finding["name"] for finding in content["findings"]] == list(NAMES)


def test_command_fails_on_a_faulty_recording(capsys: pytest.CaptureFixture[str]) -> None:
    """A size of other proportions than the camera's is not a fault; a depth scale for another sensor is."""
    uri = f"replica:{shared_data('redkitchen')}?depth_scale=5000&range=0:27&size=320x200"
    assert main(["doctor", uri]) == 1
    failed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAIL")]
    assert len(failed) == 1
    assert failed[0].startswith("FAIL  depth scale")


def test_command_refuses_what_is_no_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "replica:nowhere"]) == 1
    assert "expected a folder of a recording" in capsys.readouterr().err

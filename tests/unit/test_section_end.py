import numpy as np
import numpy.typing as npt
import pytest

from vtslam.common.preset_loading import load_settings
from vtslam.common.section_end import section_is_full, travelled_m
from vtslam.common.settings import SectionSettings


def poses_at(*places_m: tuple[float, float, float]) -> list[npt.NDArray[np.float64]]:
    poses = [np.eye(4) for _ in places_m]
    for pose, place_m in zip(poses, places_m, strict=True):
        pose[:3, 3] = place_m
    return poses


def test_the_way_is_as_long_as_its_steps() -> None:
    assert travelled_m(poses_at((1.0, 2.0, 3.0))) == 0.0
    assert travelled_m(poses_at((0, 0, 0), (3, 0, 4), (3, 0, 0), (0, 0, 0))) == pytest.approx(5.0 + 4.0 + 3.0)


def test_frames_end_a_section_that_stands() -> None:
    standing = poses_at(*[(0.0, 0.0, 0.0)] * 5)
    settings = SectionSettings(length=5, length_m=1.0)
    assert section_is_full(standing, settings)
    assert not section_is_full(standing[:4], settings)


def test_metres_end_a_section_that_moves() -> None:
    moving = poses_at(*[(0.0, 0.0, 0.5 * index) for index in range(5)])
    settings = SectionSettings(length=30, length_m=1.5)
    assert [section_is_full(moving[:frames], settings) for frames in range(1, 5)] == [False, False, False, True]
    assert not section_is_full(moving, SectionSettings(length=30, length_m=0.0))


@pytest.mark.parametrize("preset", ["fast", "paper", "realtime"])
def test_a_car_in_town_fills_sections_with_frames_and_on_a_motorway_with_metres(preset: str) -> None:
    settings = load_settings(preset=preset, family="kitti", file=None, assignments=[]).section
    for step_m, fewer in ((0.85, False), (2.5, True)):
        moving = poses_at(*[(0.0, 0.0, step_m * index) for index in range(settings.length)])
        assert section_is_full(moving[:-1], settings) == fewer

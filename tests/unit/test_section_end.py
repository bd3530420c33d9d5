"""Where sections end."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import room_section

from vtslam.common.geometry.camera import Camera
from vtslam.common.preset_loading import load_settings
from vtslam.common.section_end import SectionEnd, least_budget_mb, tracked_against, travelled_m
from vtslam.common.settings import Settings

ANY = 10**9  # Gaussians
CAMERA = Camera(width=310, height=94, fx=180.0, fy=180.0, cx=155.0, cy=47.0)


def poses_at(*places_m: tuple[float, float, float]) -> list[npt.NDArray[np.float64]]:
    poses = [np.eye(4) for _ in places_m]
    for pose, place_m in zip(poses, places_m, strict=True):
        pose[:3, 3] = place_m
    return poses


def settings_of(*assignments: str, family: str = "kitti") -> Settings:
    return load_settings(preset="fast", family=family, file=None, assignments=assignments)


def test_the_way_is_as_long_as_its_steps() -> None:
    assert travelled_m(poses_at((1.0, 2.0, 3.0))) == 0.0
    assert travelled_m(poses_at((0, 0, 0), (3, 0, 4), (3, 0, 0), (0, 0, 0))) == pytest.approx(5.0 + 4.0 + 3.0)


def test_frames_end_a_section_that_stands() -> None:
    standing = poses_at(*[(0.0, 0.0, 0.0)] * 5)
    end = SectionEnd(frames=5, metres=1.0, gaussians=ANY)
    assert end.is_reached_by_poses(standing)
    assert not end.is_reached_by_poses(standing[:4])


def test_metres_end_a_section_that_moves() -> None:
    moving = poses_at(*[(0.0, 0.0, 0.5 * index) for index in range(5)])
    end = SectionEnd(frames=30, metres=1.5, gaussians=ANY)
    assert [end.is_reached_by_poses(moving[:frames]) for frames in range(1, 5)] == [False, False, False, True]
    assert not replace(end, metres=0.0).is_reached_by_poses(moving)


@pytest.mark.parametrize("preset", ["fast", "paper", "realtime"])
def test_a_car_in_town_fills_sections_with_frames_and_on_a_motorway_with_metres(preset: str) -> None:
    settings = load_settings(preset=preset, family="kitti", file=None, assignments=[])
    end = SectionEnd.of(settings, CAMERA)
    for step_m, fewer in ((0.85, False), (2.5, True)):
        moving = poses_at(*[(0.0, 0.0, step_m * index) for index in range(settings.section.length)])
        assert end.is_reached_by_poses(moving[:-1]) == fewer


@pytest.mark.parametrize("lead", [0, 1, 2])
def test_gaussians_end_a_section_by_the_map_that_its_next_frame_would_be_tracked_against(lead: int) -> None:
    section = room_section(0, 4)
    through = [int((section.gaussians.frame_index < frames).sum()) for frames in range(5)]
    assert through == sorted(set(through))  # each frame adds some
    likely = through[tracked_against(4, lead)] + (1 + lead) * through[1]
    for most, reached in ((likely, False), (likely - 1, True)):
        assert SectionEnd(frames=30, metres=0.0, gaussians=most, lead=lead).is_reached(section) is reached


def test_what_a_budget_holds() -> None:
    small, large = (SectionEnd.of(settings_of(f"fleet.map_budget_mb={budget}"), CAMERA) for budget in (48, 96))
    assert 150_000 < small.gaussians < 300_000
    assert large.gaussians > 2 * small.gaussians
    pixels = CAMERA.width * CAMERA.height
    without = SectionEnd.of(settings_of("fleet.map_budget_mb=48", "mapper.keep_moments=false"), CAMERA)
    assert without.gaussians > small.gaussians + pixels
    assert SectionEnd.of(settings_of("fleet.map_budget_mb=48"), CAMERA, lead=1).gaussians < small.gaussians


def test_the_least_budget_has_room_for_a_head_and_a_frame_and_a_smaller_one_has_not() -> None:
    least_mb = least_budget_mb(settings_of(), CAMERA)
    pixels = CAMERA.width * CAMERA.height
    for budget_mb, enough in ((least_mb, True), (least_mb - 1, False)):
        end = SectionEnd.of(settings_of(f"fleet.map_budget_mb={budget_mb}"), CAMERA)
        assert (end.gaussians > 2 * pixels) is enough

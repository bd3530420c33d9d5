"""Exposure and white balance: estimated where map and frame agree, kept out of the map's colours."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.small_map import SMALL_MAPPER, room_frame, room_pose, room_section, small_mapper

from vtslam.common.exposure import Exposure, estimated_exposure
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.metrics_images import psnr_db
from vtslam.common.section import Section
from vtslam.common.splat.engine import Rendering
from vtslam.common.splat.native_engine import NativeEngine

WARM = Exposure(gain=np.array([0.9, 0.8, 0.7], np.float32), offset=np.array([0.05, 0.02, 0.0], np.float32))
IDENTITY = Exposure.identity()
CORRECTING = replace(SMALL_MAPPER, exposure=True)


def under(exposure: Exposure, frame: Frame) -> Frame:
    """The frame as a camera with this exposure would have taken it."""
    shown = np.clip(exposure.applied(frame.rgb_float()), 0.0, 1.0)
    return replace(frame, rgb=np.asarray(shown * 255.0 + 0.5, np.uint8))


def perfect_rendering(frame: Frame) -> Rendering:
    """The rendering of a map that shows the frame without any error."""
    alpha = np.ones(frame.depth.shape, np.float32)
    return Rendering(rgb=frame.rgb_float(), depth_m=frame.depth_m(), alpha=alpha, saved=None)


def rendered(section: Section, index: int) -> Rendering:
    T_camera_section = se3.inverse(section.T_section_camera(room_pose(index)))
    return NativeEngine(threads=1).render(section.splats, section.camera, T_camera_section)


def test_applying_and_removing_are_inverse_and_the_identity_changes_nothing() -> None:
    frame = room_frame(0)
    colors = frame.rgb_float()
    np.testing.assert_allclose(WARM.applied(WARM.removed(frame.rgb)), colors, atol=1e-6)
    np.testing.assert_array_equal(WARM.removed(frame.rgb), (colors - WARM.offset) / WARM.gain)
    assert IDENTITY.applied(colors) is colors
    assert IDENTITY.removed(frame.rgb).tobytes() == colors.tobytes()


def test_an_exposure_is_found_again_though_a_third_of_the_pixels_disagree() -> None:
    frame = room_frame(0)
    seen = under(WARM, frame)
    rgb = seen.rgb.copy()
    rgb[:20] = np.random.default_rng(3).integers(0, 255, rgb[:20].shape)
    found = estimated_exposure(perfect_rendering(frame), replace(seen, rgb=rgb), IDENTITY)
    np.testing.assert_allclose(found.gain, WARM.gain, atol=0.02)
    np.testing.assert_allclose(found.offset, WARM.offset, atol=0.01)


def test_without_pixels_that_agree_the_fallback_is_kept() -> None:
    frame = room_frame(0)
    rendering = perfect_rendering(frame)
    unseen = replace(rendering, alpha=np.zeros_like(rendering.alpha))
    elsewhere = replace(rendering, depth_m=rendering.depth_m * 2)
    blown_out = replace(frame, rgb=np.full_like(frame.rgb, 255))
    assert estimated_exposure(unseen, frame, WARM) is WARM
    assert estimated_exposure(elsewhere, frame, WARM) is WARM
    assert estimated_exposure(rendering, blown_out, WARM) is WARM


def test_a_plain_wall_tells_an_offset_but_no_gain() -> None:
    frame = replace(room_frame(0), rgb=np.full_like(room_frame(0).rgb, 128))
    wall = perfect_rendering(replace(frame, rgb=np.full_like(frame.rgb, 100)))
    found = estimated_exposure(wall, frame, IDENTITY)
    np.testing.assert_array_equal(found.gain, 1.0)
    np.testing.assert_allclose(found.offset, 28 / 255, atol=1e-5)


def test_estimates_stay_within_what_a_camera_does() -> None:
    frame = room_frame(0)
    rendering = perfect_rendering(frame)
    inverted = estimated_exposure(rendering, replace(frame, rgb=255 - frame.rgb), IDENTITY)
    assert (inverted.gain >= 0.25).all()
    assert (np.abs(inverted.offset) <= 0.5).all()


def _two_frames(settings: bool) -> tuple[Section, Exposure]:
    """A section of frame 0, and of frame 1 with another white balance."""
    mapper = small_mapper(replace(SMALL_MAPPER, exposure=settings, iterations_regular=30))
    active, _ = mapper.map_head(room_frame(0), room_pose(0), section_id=0, neighbours=[])
    active, record = mapper.map_regular(under(WARM, room_frame(1)), room_pose(1), active, neighbours=[])
    return active.section, record.exposure


def test_the_map_keeps_its_gauge_while_the_camera_changes_its_white_balance() -> None:
    corrected, exposure = _two_frames(True)
    mixed, identity = _two_frames(False)
    assert identity.is_identity
    assert mixed.frames[1].exposure.is_identity
    np.testing.assert_allclose(exposure.gain, WARM.gain, atol=0.06)
    assert corrected.frames[1].exposure is exposure
    first, second = room_frame(0).rgb_float(), under(WARM, room_frame(1)).rgb_float()
    gained = psnr_db(rendered(corrected, 0).rgb, first) - psnr_db(rendered(mixed, 0).rgb, first)  # type: ignore[operator]
    assert gained > 1.0
    shown = exposure.applied(rendered(corrected, 1).rgb)
    assert psnr_db(shown, second) > psnr_db(rendered(mixed, 1).rgb, second) + 1.0  # type: ignore[operator]


def test_a_frame_kept_out_of_mapping_takes_over_the_last_exposure() -> None:
    mapper = small_mapper(CORRECTING)
    active, _ = mapper.map_head(room_frame(0), room_pose(0), section_id=0, neighbours=[])
    active, before = mapper.map_regular(under(WARM, room_frame(1)), room_pose(1), active, neighbours=[])
    _, record = mapper.map_regular(room_frame(2), room_pose(2), active, neighbours=[], held_out=True)
    assert record.exposure is before.exposure
    assert not record.exposure.is_identity


@pytest.mark.parametrize("correct", [True, False])
def test_a_head_takes_the_gauge_of_the_section_before_it(correct: bool) -> None:
    mapper = small_mapper(replace(CORRECTING, exposure=correct))
    head = under(WARM, room_frame(2))
    _, record = mapper.map_head(head, room_pose(2), section_id=1, neighbours=[], previous=room_section(0, 2))
    if correct:  # a twentieth of it is let go of
        np.testing.assert_allclose(record.exposure.gain, 1 + 0.95 * (WARM.gain - 1), atol=0.06)
    else:
        assert record.exposure.is_identity

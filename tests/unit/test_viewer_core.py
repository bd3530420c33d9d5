"""What is shown of frames and sections, within the limits."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.facts import frame_facts
from helpers.small_map import room_frame, room_pose, room_section

from vtslam.common.geometry import se3
from vtslam.common.metrics_images import psnr_db
from vtslam.common.section import Section
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.viewer import names
from vtslam.services.viewer.core import Limits, Scene, SectionState, SeenFrame
from vtslam.services.viewer.parts import (
    DepthPicture,
    Figure,
    Frustum,
    Gaussians,
    Gone,
    Line,
    Part,
    Picture,
    Points,
    Tint,
    Word,
)
from vtslam.services.viewer.sampling import kept_rows, thinned_line

_LIMITS = Limits(section_gaussians=200, gaussians=100_000)


def _facts(frame_id: int = 3, state: str = "ok") -> FrameFacts:
    return frame_facts(
        frame_id, state=state, color_loss=0.02, map_loss=0.5, gaussians=2, track_s=0.25, map_s=0.5, total_s=0.75
    )


def _seen(index: int, section: Section, *, state: str = "ok") -> SeenFrame:
    pose = room_pose(index)
    engine = NativeEngine(threads=1)
    rendering = engine.render(section.splats, section.camera, se3.inverse(section.T_section_camera(pose)))
    facts = _facts(index, state)
    return SeenFrame(frame=room_frame(index), T_world_camera=pose, rendering=rendering, facts=facts)


def _named(parts: list[Part]) -> dict[str, Part]:
    found = {part.path: part for part in parts}
    assert len(found) == len(parts) or names.ACTIVE_STATE in found, "no name twice, but for points and their colour"
    return found


def _values(parts: list[Part]) -> dict[str, float]:
    return {p.path.removeprefix(f"{names.FIGURES}/"): p.value for p in parts if isinstance(p, Figure)}


@pytest.mark.parametrize(("count", "limit"), [(0, 5), (5, 5), (6, 5), (1000, 10), (7, 0)])
def test_rows_are_kept_up_to_the_limit_in_order_and_always_the_same(count: int, limit: int) -> None:
    rows = kept_rows(count, limit, key=4)
    assert len(rows) == min(count, limit)
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(rows, kept_rows(count, limit, key=4))


def test_rows_that_are_added_replace_few_of_those_kept() -> None:
    before, after = set(kept_rows(1000, 100, key=1).tolist()), set(kept_rows(1100, 100, key=1).tolist())
    assert len(before & after) >= 80


def test_a_thinned_line_keeps_its_ends() -> None:
    line = np.arange(30.0).reshape(10, 3)
    np.testing.assert_array_equal(thinned_line(line, 4)[[0, -1]], line[[0, -1]])
    assert len(thinned_line(line, 4)) == 4
    assert thinned_line(line, 10) is line


def test_a_frame_comes_with_camera_images_and_figures() -> None:
    section, truth = room_section(0, 4), np.stack([room_pose(index) for index in range(24)])
    scene = Scene(_LIMITS, truth=truth)
    seen = _seen(2, section)
    parts = _named(scene.frame(seen))
    camera = parts[names.CAMERA]
    assert isinstance(camera, Frustum)
    np.testing.assert_array_equal(camera.T_world_camera, room_pose(2))
    images = {path: parts[path] for path in (names.INPUT, names.RENDERED, names.RESIDUAL)}
    pictures = {path: part.rgb for path, part in images.items() if isinstance(part, Picture)}
    np.testing.assert_array_equal(pictures[names.INPUT], room_frame(2).rgb)
    error = np.abs(pictures[names.RENDERED].astype(float) - pictures[names.INPUT])
    np.testing.assert_allclose(pictures[names.RESIDUAL], np.minimum(5.0 * error, 255.0), atol=4)
    depth = parts[names.DEPTH]
    assert isinstance(depth, DepthPicture)
    np.testing.assert_array_equal(depth.depth, room_frame(2).depth)
    values = _values(list(parts.values()))
    assert (values["latency/track_ms"], values["latency/map_ms"], values["loss/map"]) == (250.0, 500.0, 0.5)
    assert values["quality/psnr_full_db"] == psnr_db(np.clip(seen.rendering.rgb, 0, 1), room_frame(2).rgb_float())
    assert values["error/position_mm"] == pytest.approx(0.0, abs=1e-9)
    assert not any(part.lasting for part in parts.values())


def test_large_images_are_shown_smaller() -> None:
    section, seen = room_section(0, 4), _seen(0, room_section(0, 4))
    large = seen.frame.resized(1300, 900)
    engine = NativeEngine(threads=1)
    rendering = engine.render(section.splats, large.camera, se3.inverse(section.T_section_camera(room_pose(0))))
    parts = _named(Scene(_LIMITS, truth=None).frame(replace(seen, frame=large, rendering=rendering)))
    picture, depth = parts[names.INPUT], parts[names.DEPTH]
    assert isinstance(picture, Picture)
    assert isinstance(depth, DepthPicture)
    assert picture.rgb.shape == (443, 640, 3)
    assert depth.depth.shape == (300, 434)


def test_the_true_path_is_laid_on_the_estimated_one() -> None:
    section = room_section(0, 12)
    T_other_world = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, 0.2, -0.4]))
    truth = np.stack([T_other_world @ room_pose(index) for index in range(24)])
    truth[5] = np.nan
    scene = Scene(_LIMITS, truth=truth)
    for index in (0, 3, 11):
        parts = _named(scene.frame(_seen(index, section)))
        line = parts[names.TRUE_PATH]
        assert isinstance(line, Line)
        assert len(line.points_m) == (index + 1 if index < 5 else index)
        np.testing.assert_allclose(line.points_m[-1], room_pose(index)[:3, 3], atol=1e-5)
    scene.growing(section)  # now it is laid on all of its frames
    assert _values(scene.frame(_seen(11, section)))["error/position_mm"] == pytest.approx(0.0, abs=1e-6)
    assert names.TRUE_PATH not in _named(Scene(_LIMITS, truth=None).frame(_seen(0, section)))


def test_tracking_that_was_lost_is_an_event() -> None:
    parts = _named(Scene(_LIMITS, truth=None).frame(_seen(1, room_section(0, 4), state="lost")))
    word = parts[names.EVENTS]
    assert isinstance(word, Word)
    assert word.text == "frame 1: tracking lost"


def test_a_finished_section_is_thinned_and_stays() -> None:
    section = room_section(0, 4, section_id=6)
    scene = Scene(_LIMITS, truth=None)
    parts = _named(scene.finished(section))
    shown = parts[f"{names.MAP}/000006"]
    assert isinstance(shown, Gaussians)
    rows = kept_rows(section.gaussians.count, 200, key=6)
    T = section.T_world_section
    np.testing.assert_allclose(shown.centers_m, section.means_m[rows] @ T[:3, :3].T + T[:3, 3], atol=1e-6)
    larger = np.sqrt(section.gaussians.count / 200)
    np.testing.assert_allclose(shown.sigmas_m, np.exp(section.gaussians.log_radii[rows]) * larger, rtol=1e-6)
    assert shown.colors.shape == (200, 4)
    path = parts[f"{names.PATHS}/000006"]
    assert isinstance(path, Line)
    np.testing.assert_allclose(path.points_m, [section.T_world_frame(row)[:3, 3] for row in range(4)], atol=1e-6)
    assert all(part.lasting for part in parts.values())
    assert scene.gaussians_sent == 200


def test_all_sections_together_stay_within_the_limit_and_become_points() -> None:
    section = room_section(0, 4)
    scene = Scene(Limits(section_gaussians=400, gaussians=3000), truth=None)
    kinds = []
    for section_id in range(400):
        shown = _named(scene.finished(replace(section, section_id=section_id)))[f"{names.MAP}/{section_id:06d}"]
        kinds.append(type(shown))
    assert scene.gaussians_sent <= 3000
    assert kinds[0] is Gaussians
    assert kinds[-1] is Points
    assert kinds.index(Points) == kinds.count(Gaussians), "first Gaussians, then points"


def test_a_growing_section_goes_when_nothing_grows() -> None:
    scene, section = Scene(_LIMITS, truth=None), room_section(0, 4)
    shown = _named(scene.growing(section))
    gaussians = shown[names.ACTIVE_MAP]
    assert isinstance(gaussians, Gaussians)
    assert len(gaussians.centers_m) == 100
    assert {part.path for part in scene.nothing_grows() if isinstance(part, Gone)} == set(shown)


def test_only_states_that_changed_are_told() -> None:
    scene = Scene(_LIMITS, truth=None)

    def tints(parts: list[Part]) -> dict[str, tuple[int, int, int]]:
        return {part.path: part.color for part in parts if isinstance(part, Tint)}

    first = scene.states(active=2, resident={0, 1}, known=range(2))
    assert tints(first) == {f"{names.STATES}/00000{n}": SectionState.RESIDENT.color for n in (0, 1)}
    second = scene.states(active=None, resident={1, 2}, known=range(3))
    assert tints(second) == {
        f"{names.STATES}/000000": SectionState.ON_DISK.color,
        f"{names.STATES}/000002": SectionState.RESIDENT.color,
    }
    assert tints(scene.states(active=None, resident={1, 2}, known=range(3))) == {}
    assert _values(second) == {"sections/active": 0, "sections/resident": 2, "sections/on_disk": 1}


def test_of_counters_only_losses_are_shown() -> None:
    counters = {"tracker": {"frames.dropped": 4, "frames.tracked": 9}, "supervisor": {"mapper.deaths": 1}}
    found = _values(Scene(_LIMITS, truth=None).services(counters, {"map": 12.5, "tracker": 80.0}))
    assert found == {
        "drops/tracker/frames_dropped": 4.0,
        "drops/supervisor/mapper_deaths": 1.0,
        "memory/map_mb": 12.5,
        "memory/tracker_mb": 80.0,
    }

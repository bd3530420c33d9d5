"""The whole system in one process, with an archive in memory."""

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pytest
from helpers.small_map import pose_error, room_frame, room_pose, section_bytes, without_depth

from vtslam.common.external_pose import ExternalPose
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.metrics_trajectory import trajectory_errors
from vtslam.common.preset_loading import load_settings
from vtslam.common.section import Section
from vtslam.common.settings import Settings
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.common.tracking_facts import TrackingState
from vtslam.services.section_map import ReadsSections
from vtslam.services.system import FrameReport, Seal, System
from vtslam.storage.section_convert import record_of, section_of

N, FRAMES, PATH = 6, 15, 48  # frames of a section, of the run, of the closed path they are on
SMALL = (
    f"section.length={N}",
    "section.candidate_interval=3",
    "mapper.iterations_head=8",
    "mapper.iterations_regular=3",
    "mapper.iterations_seal=6",
    "mapper.initial_radius=0.5",
    "mapper.initial_opacity=0.95",
)


@dataclass(slots=True)
class MemoryArchive(ReadsSections):
    """Sections as records, turned back on reading, as files would."""

    written: dict[int, Section] = field(default_factory=dict)
    reads: list[int] = field(default_factory=list)

    def write(self, section: Section) -> None:
        assert section.section_id not in self.written
        self.written[section.section_id] = section

    def read(self, section_id: int) -> Section:
        self.reads.append(section_id)
        return section_of(record_of(self.written[section_id]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    system: System
    reports: list[FrameReport]
    archive: MemoryArchive
    seal: Seal | None

    @property
    def poses(self) -> npt.NDArray[np.float64]:
        return np.stack([report.commit.T_world_camera for report in self.reports])


def settings_of(*assignments: str, preset: str = "fast") -> Settings:
    return load_settings(preset=preset, assignments=[*SMALL, *assignments])


def room_frames() -> list[Frame]:
    return [room_frame(i, PATH) for i in range(FRAMES)]


@dataclass(slots=True)
class SlowClock:
    """Another second at each look."""

    now_s: float = 0.0

    def __call__(self) -> float:
        self.now_s += 1.0
        return self.now_s


def run(settings: Settings, frames: list[Frame], *, threads: int = 1) -> Run:
    archive = MemoryArchive()
    system = System(settings, NativeEngine(threads=threads), archive, threads=threads)
    reports = [system.process(frame) for frame in frames]
    return Run(system=system, reports=reports, archive=archive, seal=system.finish())


@lru_cache(maxsize=1)
def plain_run() -> Run:
    return run(settings_of(), room_frames())


def true_poses() -> npt.NDArray[np.float64]:
    return np.stack([room_pose(i, PATH) for i in range(FRAMES)])


def test_the_trajectory_is_close_to_the_truth() -> None:
    result = plain_run()
    assert all(report.tracking.state is TrackingState.OK for report in result.reports if report.tracking)
    errors = trajectory_errors(result.poses, true_poses())
    assert errors.ate_rmse_m < 0.006
    assert pose_error(result.poses[-1], true_poses()[-1])[0] < 0.02


def test_two_runs_and_any_number_of_threads_give_the_same_bytes() -> None:
    first, second = plain_run(), run(settings_of(), room_frames(), threads=3)
    assert first.poses.tobytes() == second.poses.tobytes()
    assert first.archive.written.keys() == second.archive.written.keys() == {0, 1, 2}
    for section_id, section in first.archive.written.items():
        assert section_bytes(section) == section_bytes(second.archive.written[section_id])
    assert [r.commit.loss for r in first.reports] == [r.commit.loss for r in second.reports]


def test_sections_are_sealed_when_full_and_at_the_end() -> None:
    result = plain_run()
    sealed = [report.sealed for report in result.reports]
    assert [i for i, seal in enumerate(sealed) if seal is not None] == [N - 1, 2 * N - 1]
    assert [len(section.frames) for section in result.archive.written.values()] == [N, N, FRAMES - 2 * N]
    for section, seal in zip(result.archive.written.values(), [*filter(None, sealed), result.seal], strict=True):
        assert seal is not None
        assert seal.renders >= 6
        assert (seal.section_id, seal.gaussians) == (section.section_id, section.gaussians.count)
    assert result.system.active is None
    assert result.system.finish() is None


def test_a_run_that_ends_with_a_section_has_nothing_left_to_seal() -> None:
    result = run(settings_of("mapper.iterations_seal=2"), room_frames()[:N])
    assert list(result.archive.written) == [0]
    assert result.seal is None


def test_sections_hold_the_committed_poses_and_frames() -> None:
    result = plain_run()
    for section_id, section in result.archive.written.items():
        for row, frame in enumerate(section.frames):
            index = section_id * N + row
            assert frame.frame_id == index
            np.testing.assert_allclose(section.T_world_frame(row), result.poses[index], atol=1e-12)
            assert result.reports[index].commit.section_id == section_id
            assert result.reports[index].commit.frame_index == row


def test_reloaded_sections_are_equal_to_those_in_memory() -> None:
    result = plain_run()
    for section_id, section in result.archive.written.items():
        again = result.archive.read(section_id)
        assert section_bytes(again) == section_bytes(section)
        assert again.surface.tobytes() == section.surface.tobytes()


def test_sections_that_left_memory_come_back_from_the_archive(monkeypatch: pytest.MonkeyPatch) -> None:
    # With room for one sealed section, heads that overlap with older ones load them: the run does not change.
    monkeypatch.setattr("vtslam.services.section_map._RESIDENT_SECTIONS", 1)
    paged = run(settings_of("section.length=3"), room_frames()[:13])
    assert len(paged.archive.reads) > 0
    monkeypatch.undo()
    kept = run(settings_of("section.length=3"), room_frames()[:13])
    assert len(kept.archive.reads) < len(paged.archive.reads)
    assert paged.poses.tobytes() == kept.poses.tobytes()
    assert [section_bytes(s) for s in paged.archive.written.values()] == [
        section_bytes(s) for s in kept.archive.written.values()
    ]


def test_heads_are_tracked_against_earlier_sections() -> None:
    result = plain_run()
    for index in range(1, FRAMES):
        tracking = result.reports[index].tracking
        assert tracking is not None
        if index % N == 0:
            assert 0 <= tracking.overlap_section_id < index // N
        else:
            assert tracking.overlap_section_id == -1
            assert tracking.quality.section_id == index // N
    assert result.reports[0].tracking is None


def test_later_heads_have_neighbours_and_the_first_has_none() -> None:
    captured: list[tuple[int, ...]] = []
    archive = MemoryArchive()
    system = System(
        settings_of("section.length=3", "mapper.neighbour_weight=1"), NativeEngine(threads=1), archive, threads=1
    )
    for index, frame in enumerate(room_frames()[:10]):
        system.process(frame)
        if index % 3 == 0:
            assert system.active is not None
            captured.append(system.active.neighbour_ids)
    assert captured[0] == ()
    assert captured[1] == (0,)  # the previous and the overlapping one are the same
    assert captured[2] == (1, 0)
    assert captured[3][0] == 2
    assert len(set(captured[3])) == len(captured[3]) == 2


def test_held_out_frames_are_tracked_but_not_mapped() -> None:
    result = run(settings_of("holdout=2"), room_frames())
    for index, report in enumerate(result.reports):
        row = index % N
        assert report.commit.held_out == (row in (2, 4))
        if report.commit.held_out:
            assert report.commit.gaussians_added == 0
    for section in result.archive.written.values():
        assert not np.isin(section.gaussians.frame_index, [2, 4]).any()
    assert trajectory_errors(result.poses, true_poses()).ate_rmse_m < 0.008


def test_a_closed_camera_does_not_end_the_run() -> None:
    frames = [without_depth(f) if i in (0, 3, N, N + 1, FRAMES - 1) else f for i, f in enumerate(room_frames())]
    result = run(settings_of(), frames)
    assert len(result.reports) == FRAMES
    assert np.isfinite(result.poses).all()
    states = [report.tracking.state if report.tracking else None for report in result.reports]
    assert states[3] is states[N] is states[FRAMES - 1] is TrackingState.LOST
    assert states[4] is states[N + 3] is TrackingState.OK
    assert list(result.archive.written) == [0, 1, 2]


def test_a_recording_without_any_depth_is_lost_but_completes() -> None:
    result = run(settings_of(), [without_depth(f) for f in room_frames()[: N + 2]])
    assert all(r.tracking.state is TrackingState.LOST for r in result.reports if r.tracking)
    assert [s.gaussians.count for s in result.archive.written.values()] == [0, 0]
    np.testing.assert_array_equal(result.poses, np.tile(np.eye(4), (N + 2, 1, 1)))


def test_a_prior_places_the_first_frame_and_steers_the_others() -> None:
    lift = se3.exp(np.array([3.0, -2.0, 1.0, 0.3, 0.2, 0.5]))
    truth = lift @ true_poses()
    covariance = 1e-10 * np.eye(6)
    frames = [
        replace(frame, pose_prior=ExternalPose(T_world_camera=true, covariance=covariance))
        for frame, true in zip(room_frames()[:4], truth, strict=False)
    ]
    result = run(settings_of(), frames)
    np.testing.assert_allclose(result.poses[0], truth[0], atol=1e-12)
    for found, true in zip(result.poses, truth, strict=False):
        assert pose_error(found, true)[0] < 1e-3


def test_later_priors_count_if_the_first_pose_is_known() -> None:
    lift = se3.exp(np.array([3.0, -2.0, 1.0, 0.3, 0.2, 0.5]))
    frames, truth, covariance = room_frames()[:3], lift @ true_poses(), 1e-10 * np.eye(6)
    system = System(settings_of(), NativeEngine(threads=1), MemoryArchive(), threads=1)
    system.process(frames[0], known_T_world_camera=truth[0])
    for frame, true in zip(frames[1:], truth[1:], strict=False):
        prior = ExternalPose(T_world_camera=true, covariance=covariance)
        found = system.process(replace(frame, pose_prior=prior)).commit.T_world_camera
        assert pose_error(found, true)[0] < 1e-6


def test_every_schedule_runs() -> None:
    for preset in ("realtime", "released", "paper"):
        adam = [f"tracker.adam.{key}=3" for key in ("iterations", "first_section_iterations", "pretrack_iterations")]
        result = run(settings_of(*adam, preset=preset), room_frames()[: N + 2])
        assert list(result.archive.written) == [0, 1]
        assert all(np.isfinite(s.gaussians.log_radii).all() for s in result.archive.written.values())


def test_reports_count_the_work_and_read_the_clock() -> None:
    ticks = iter(range(1000))
    system = System(
        settings_of(), NativeEngine(threads=1), MemoryArchive(), threads=1, clock=lambda: float(next(ticks))
    )
    reports = [system.process(frame) for frame in room_frames()[:3]]
    assert all(report.track_s == 1.0 and report.map_s == 1.0 for report in reports)
    assert [report.commit.gaussians for report in reports] == list(
        np.cumsum([report.commit.gaussians_added for report in reports])
    )
    assert all(report.commit.renders > 0 for report in reports)


def test_a_time_budget_ends_the_steps_of_a_frame_but_not_before_the_first() -> None:
    settings = settings_of("mapper.enough_loss=0")
    for budget_s, steps in ((0.0, [8, 3, 3]), (1.5, [1, 1, 1]), (2.5, [2, 2, 2])):
        limited = replace(settings, mapper=replace(settings.mapper, budget_s=budget_s))
        system = System(limited, NativeEngine(threads=1), MemoryArchive(), threads=1, clock=SlowClock())
        assert [system.process(frame).commit.iterations for frame in room_frames()[:3]] == steps

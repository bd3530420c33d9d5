"""A map far from its origin is as sharp as one at the origin: poses are float64, rendering is relative to sections."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pytest

from vtslam.common.geometry import se3
from vtslam.common.preset_loading import load_settings
from vtslam.common.section import Section
from vtslam.common.splat.native_engine import NativeEngine
from vtslam.services.sensor.sources.sim_city import SimCity
from vtslam.services.system import Archive, FrameReport, System

FRAMES = 9
SETTINGS = (
    "section.length=4",
    "mapper.iterations_head=2",
    "mapper.iterations_regular=1",
    "mapper.iterations_seal=2",
    "mapper.edge_supplement=false",
)


@dataclass(slots=True)
class _Archive(Archive):
    sections: dict[int, Section] = field(default_factory=dict)

    def write(self, section: Section) -> None:
        self.sections[section.section_id] = section

    def read(self, section_id: int) -> Section:
        return self.sections[section_id]


def run_from(T_world_first: npt.NDArray[np.float64]) -> tuple[list[FrameReport], dict[int, Section]]:
    """A drive whose first camera stands at the given pose, in sections of 4 frames."""
    settings = load_settings(family="kitti", assignments=SETTINGS)
    archive, source = _Archive(), SimCity(size=(155, 47))
    system = System(settings, NativeEngine(threads=1), archive, threads=1)
    reports = [
        system.process(source.frame(i), known_T_world_camera=None if i else T_world_first) for i in range(FRAMES)
    ]
    system.finish()
    return reports, archive.sections


@pytest.fixture(scope="module")
def here() -> tuple[list[FrameReport], dict[int, Section]]:
    return run_from(np.eye(4))


# Float32 coordinates would be off by 1 mm at 10 km and by 6 cm at 1000 km. Steps of tracking end at thresholds, so that
# the last bits of float64 move a pose within its noise, some millimetres, at any distance.
@pytest.mark.parametrize("place_m", [(10_000.0, 0.0, 0.0), (-7_071.3, 30.7, 7_071.9), (1e6, 0.0, 0.0)])
def test_local_results_are_the_same_far_away(
    here: tuple[list[FrameReport], dict[int, Section]], place_m: tuple[float, float, float]
) -> None:
    T_far = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 1.1, 0.0]))
    T_far[:3, 3] = place_m
    reports, sections = run_from(T_far)
    for near, far in zip(here[0], reports, strict=True):
        difference = se3.inverse(T_far @ near.commit.T_world_camera) @ far.commit.T_world_camera
        still = far.commit.frame_id < 2  # nothing has spread yet
        assert np.linalg.norm(difference[:3, 3]) < (1e-6 if still else 0.01)
        assert se3.angle_rad(difference) < (1e-7 if still else 1e-3)
        assert far.commit.gaussians == pytest.approx(near.commit.gaussians, rel=0.0 if still else 2e-3)
    assert sections.keys() == here[1].keys()
    for number, section in sections.items():
        other = here[1][number]
        for one, two in zip(section.frames, other.frames, strict=True):
            np.testing.assert_allclose(one.T_section_frame, two.T_section_frame, atol=0.01)


def test_the_drive_is_tracked(here: tuple[list[FrameReport], dict[int, Section]]) -> None:
    truth = SimCity(size=(155, 47)).ground_truth()
    last = here[0][-1].commit.T_world_camera
    error = se3.inverse(se3.inverse(truth[0]) @ truth[FRAMES - 1]) @ last
    assert np.linalg.norm(error[:3, 3]) < 0.15

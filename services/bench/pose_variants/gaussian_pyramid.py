"""Coarse to fine on a pyramid of Gaussians: each parent has the moments of its children, and is rendered small."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.optim.alignment import Observed, Reference, align, observed_frame, reference_view
from vtslam.common.section import Section
from vtslam.common.settings import GaussNewtonSettings
from vtslam.common.splat.engine import Engine, Splats
from vtslam.services.bench.pose_variants.task import FoundPose, Matrix4, PoseTask
from vtslam.services.tracker.optimisers import is_small_step, pyramid_levels

_MAX_RELATIVE_DEPTH_STEP = 0.05  # children further apart than this are not merged
_MOST_OPACITY = 0.999
_COARSE_SILHOUETTE = 0.5  # of coarse levels at most: few parents overlap there, and views are divided by it


class GaussianPyramids:
    """Merged Gaussians of the last section asked for, by level."""

    def __init__(self) -> None:
        self._section: Section | None = None
        self._levels: dict[int, Splats] = {}

    def splats(self, section: Section, level: int) -> Splats:
        """The section's Gaussians for an image 2^level times smaller; level 0 is the section itself."""
        if section is not self._section:
            self._section, self._levels = section, {}
        if level not in self._levels:
            self._levels[level] = section.splats if level == 0 else merged_splats(section, level)
        return self._levels[level]

    def prepare(self, section: Section, levels: int) -> None:
        """Merge for all levels that so many can have, as a map that keeps them would have done."""
        for level in range(1, pyramid_levels(levels, section.camera)):
            self.splats(section, level)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GaussianPyramidAlignment:
    """The tracker's alignment, but every coarse level has a rendering of its own (protocol ``SolvesPose``)."""

    engine: Engine
    settings: GaussNewtonSettings
    pyramids: GaussianPyramids
    threads: int

    def solve(self, task: PoseTask, T_guess: Matrix4) -> FoundPose:
        """See ``SolvesPose``."""
        s, camera = self.settings, task.frame.camera
        levels = pyramid_levels(s.levels, camera)
        observed = observed_frame(task.rgb, task.masked_depth_m(), camera, levels)
        T, spent, full_size = T_guess, 0, 0.0
        # As many renders of full size as the tracker has left after its first round.
        for level in [*range(levels - 1, 0, -1), *[0] * max(1, s.renders - 1)]:
            moved = self._aligned(task, observed, level, T)
            T = se3.orthonormalized(moved @ T)
            spent, full_size = spent + 1, full_size + 4.0**-level
            if level == 0 and is_small_step(se3.log(moved), s):
                break
        return FoundPose(T_camera_section=T, renders=spent, full_size_renders=full_size)

    def _aligned(self, task: PoseTask, observed: Observed, level: int, T: Matrix4) -> Matrix4:
        camera = observed.levels[level].camera
        view = reference_view(
            self.engine.render(self.pyramids.splats(task.section, level), camera, T),
            camera,
            T,
            surface=task.section.surface,
            levels=1,
            silhouette_threshold=silhouette_threshold(self.settings, level),
        )
        reference = Reference(levels=view.levels * (level + 1), points=view.points)  # only the last one is looked at
        found = align(
            reference,
            observed,
            self.settings,
            T_observed_reference=np.eye(4),
            coarsest=level,
            finest=level,
            threads=self.threads,
        )
        return found.T_observed_reference


def silhouette_threshold(settings: GaussNewtonSettings, level: int) -> float:
    """What a pixel of a level needs to count as covered."""
    return settings.silhouette_threshold if level == 0 else min(settings.silhouette_threshold, _COARSE_SILHOUETTE)


def merged_splats(section: Section, level: int) -> Splats:
    """The Gaussians tied to each block of 2^level x 2^level pixels of a frame as one, those on another surface apart.

    Colour and position are means by optical depth times area; the variance is theirs and that of their positions along
    the surface's two directions, and of what the larger pixels average; optical depth times area is kept.
    """
    g, camera = section.gaussians, section.camera
    parent_width = (camera.width >> level) + 1
    parent = ((g.pixel // camera.width) >> level).astype(np.int64) * parent_width + ((g.pixel % camera.width) >> level)
    block = parent + g.frame_index.astype(np.int64) * parent_width * ((camera.height >> level) + 1)
    _, block = np.unique(block, return_inverse=True)
    nearest = np.full(block.max() + 1, np.inf)
    np.minimum.at(nearest, block, g.depth.astype(np.float64))
    behind = g.depth > (1.0 + _MAX_RELATIVE_DEPTH_STEP) * nearest[block]
    _, group = np.unique(2 * block + behind, return_inverse=True)
    number = int(group.max()) + 1

    def sums(values: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        return np.bincount(group, weights=values, minlength=number).astype(np.float64)

    variance = np.exp(2.0 * g.log_radii.astype(np.float64))
    mass = np.logaddexp(0.0, g.opacity_logits.astype(np.float64)) * variance  # -log(1 - opacity) times area
    share = mass / sums(mass)[group]
    means = np.stack([sums(share * section.means_m[:, i]) for i in range(3)], axis=1)
    colors = np.stack([sums(share * g.colors[:, i]) for i in range(3)], axis=1)
    squared = np.square(section.means_m - means[group]).sum(axis=1)
    pixel_m = g.depth * (section.depth_unit_m / camera.mean_focal_px)
    merged_variance = sums(share * (variance + 0.5 * squared + (4.0**level - 1.0) / 12.0 * np.square(pixel_m)))
    opacity = np.minimum(-np.expm1(-sums(mass) / merged_variance), _MOST_OPACITY)
    return Splats(
        means_m=means.astype(np.float32),
        colors=colors.astype(np.float32),
        log_radii=(0.5 * np.log(merged_variance)).astype(np.float32),
        opacity_logits=np.log(opacity / (1.0 - opacity)).astype(np.float32),
    )

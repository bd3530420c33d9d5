"""Optimisation of one section's attributes on its own views and, with its neighbours, on its head (Eq. 2)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from vtslam.common.gaussians import ViewTiedGaussians, first_log_radii
from vtslam.common.geometry import se3
from vtslam.common.optim.adam import Adam
from vtslam.common.optim.mapping_loss import mapping_loss
from vtslam.common.rows import compacted, thinned
from vtslam.common.section import Section, joined_splats
from vtslam.common.settings import MapperSettings
from vtslam.common.splat.engine import Engine, Gradients, Splats
from vtslam.services.mapper.state import Moments, TrainingView

_RECENT_STEPS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Optimised:
    """A section after some steps, the optimiser state, the last loss, and the steps and renders spent."""

    section: Section
    moments: Moments
    loss: float
    steps: int
    renders: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FirstValues:
    """What a section's N Gaussians started as: colours float32 [N,3], log radii float32 [N], one opacity logit."""

    colors: npt.NDArray[np.float32]
    log_radii: npt.NDArray[np.float32]
    opacity_logit: np.float32

    @classmethod
    def of(
        cls,
        gaussians: ViewTiedGaussians,
        views: Sequence[TrainingView],
        *,
        log_radii: npt.NDArray[np.float32],
        opacity: float,
    ) -> "FirstValues":
        """Colours as the views show them; ``views`` hold every frame that Gaussians are tied to."""
        colors = np.full((gaussians.count, 3), np.nan, np.float32)
        for view in views:
            rows = np.flatnonzero(gaussians.frame_index == view.frame_index)
            observed = view.exposure.removed(view.frame.rgb).reshape(-1, 3)
            colors[rows] = observed[gaussians.pixel[rows]]
        if np.isnan(colors).any():
            raise ValueError("expected the views of all frames that Gaussians are tied to")
        return cls(colors=colors, log_radii=log_radii, opacity_logit=np.float32(np.log(opacity / (1.0 - opacity))))

    def thinned(self, kept: npt.NDArray[np.bool_]) -> "FirstValues":
        """Without those of the last Gaussians that are not ``kept`` (bool [M])."""
        return replace(self, colors=thinned(self.colors, kept), log_radii=thinned(self.log_radii, kept))


def _shrink(values: npt.NDArray[np.float32], towards: npt.NDArray[np.float32] | np.float32, by: float) -> None:
    """Move values by ``by`` towards others, and no further."""
    values += np.clip(towards - values, np.float32(-by), np.float32(by))


def _moments_of(shape: tuple[int, ...], rate: float, settings: MapperSettings, previous: Adam | None) -> Adam:
    """Adam's state for one attribute: a copy of the previous state with zero rows appended, or all zero."""
    adam = Adam(shape, lr=rate, betas=(settings.adam_momentum, settings.adam_memory), eps=settings.adam_epsilon)
    if previous is not None:
        adam.m, adam.v, adam.step_count = previous.m, previous.v, previous.step_count
        adam.grow(shape[0] - previous.m.shape[0])  # in memory of its own
    return adam


def _new_moments(section: Section, settings: MapperSettings, previous: Moments | None) -> Moments:
    """Optimiser state for a section's Gaussians; kept rows go on where they were if the settings keep moments."""
    g, s = section.gaussians, settings
    kept = previous if settings.keep_moments else None
    return Moments(
        colors=_moments_of(g.colors.shape, s.learning_rate_color, s, kept.colors if kept else None),
        log_radii=_moments_of(g.log_radii.shape, s.learning_rate_log_radius, s, kept.log_radii if kept else None),
        opacity_logits=_moments_of(
            g.opacity_logits.shape, s.learning_rate_opacity, s, kept.opacity_logits if kept else None
        ),
    )


class SectionOptimiser:
    """Steps of Adam on colours, log radii and opacity logits; positions and neighbours stay fixed."""

    def __init__(
        self,
        section: Section,
        neighbours: list[Section],
        engine: Engine,
        settings: MapperSettings,
        *,
        moments: Moments | None,
        views: Sequence[TrainingView] = (),
    ) -> None:
        self._section, self._neighbours, self._engine, self._settings = section, neighbours, engine, settings
        self._moments = _new_moments(section, settings, moments)
        g = section.gaussians
        self._colors, self._log_radii = g.colors.copy(), g.log_radii.copy()
        self._opacity_logits = g.opacity_logits.copy()
        self._losses: list[float] = []
        self._renders = 0
        first = first_log_radii(
            g,
            section.camera,
            depth_unit_m=section.depth_unit_m,
            factor=settings.initial_radius,
            border_factor=settings.border_radius,
        )
        span = np.float32(np.log(max(settings.radius_limit, 1.0)))
        self._log_radius_bounds = (first - span, first + span)
        self._most_weight = np.zeros(g.count, np.float32)
        self._prior: FirstValues | None = None
        if settings.rate_weight > 0:
            self._prior = FirstValues.of(g, views, log_radii=first, opacity=settings.initial_opacity)

    def step(
        self,
        view: TrainingView,
        *,
        with_neighbours: bool,
        rate: float = 1.0,
        drop_hidden: bool = False,
        watch: bool = False,
    ) -> npt.NDArray[np.float64]:
        """One step on ``view``: Eq. 2 on the section alone, and if asked on the section with its neighbours.

        Args:
            view: The frame rendered against.
            with_neighbours: Whether to add the joint loss.
            rate: Factor on the learning rates.
            drop_hidden: Afterwards leave out the view's own Gaussians that others cover there (``least_weight``); they
                must be the section's last.
            watch: Note how much each Gaussian shows, for :meth:`drop_unseen`.

        Returns:
            The gradient [6] of the joint loss with respect to a left twist on the section's own camera pose relative
            to its neighbours (zero without neighbours): what bundle adjustment of a head descends along.
        """
        T_camera_section = se3.inverse(self._section.frames[view.frame_index].T_section_frame)
        drop_hidden = drop_hidden and self._settings.least_weight > 0
        gradients, value = self._loss_gradients(
            self._splats(), view, T_camera_section, want_means=False, want_weights=drop_hidden or watch
        )
        colors, log_radii, opacity_logits = gradients.colors, gradients.log_radii, gradients.opacity_logits
        pose_gradient = np.zeros(6)
        weight = self._settings.neighbour_weight
        if with_neighbours and self._neighbours and weight > 0:
            joined = joined_splats([self._current(), *self._neighbours], into=self._section)
            joint, joint_loss = self._loss_gradients(joined, view, T_camera_section, want_means=True)
            own = self._colors.shape[0]
            colors = colors + weight * joint.colors[:own]
            log_radii = log_radii + weight * joint.log_radii[:own]
            opacity_logits = opacity_logits + weight * joint.opacity_logits[:own]
            value += weight * joint_loss
            pose_gradient = _camera_twist_gradient(joined, joint, own, T_camera_section)
        self._losses.append(value)
        self._move(colors, log_radii, opacity_logits, rate)
        if gradients.weights is not None:
            np.maximum(self._most_weight, gradients.weights, out=self._most_weight)
        if drop_hidden:
            assert gradients.weights is not None
            own_rows = np.count_nonzero(self._section.gaussians.frame_index == view.frame_index)
            self._thin(gradients.weights[gradients.weights.size - own_rows :] >= self._settings.least_weight)
        return pose_gradient

    def drop_unseen(self) -> None:
        """Leave out the Gaussians that showed too little in every view watched (``least_weight_sealed``)."""
        self._thin(self._most_weight >= self._settings.least_weight_sealed)

    def _move(
        self,
        colors: npt.NDArray[np.float32],
        log_radii: npt.NDArray[np.float32],
        opacity_logits: npt.NDArray[np.float32],
        rate: float,
    ) -> None:
        """A step of Adam against the gradients given, radii kept within their bounds."""
        self._moments.colors.step(self._colors, colors, rate=rate)
        self._moments.log_radii.step(self._log_radii, log_radii, rate=rate)
        self._moments.opacity_logits.step(self._opacity_logits, opacity_logits, rate=rate)
        if self._prior is not None:
            self._pull(self._prior, self._settings.rate_weight * rate)
        if self._settings.radius_limit > 0:
            np.clip(self._log_radii, *self._log_radius_bounds, out=self._log_radii)

    def _pull(self, prior: FirstValues, share: float) -> None:
        """Attributes nearer to their first values by ``share`` of a step, those within it onto them (an L1 term)."""
        s = self._settings
        _shrink(self._colors, prior.colors, share * s.learning_rate_color)
        _shrink(self._log_radii, prior.log_radii, share * s.learning_rate_log_radius)
        _shrink(self._opacity_logits, prior.opacity_logit, share * s.learning_rate_opacity)

    def _thin(self, kept: npt.NDArray[np.bool_]) -> None:
        """Leave out those of the last Gaussians that are not ``kept`` (bool [M])."""
        if kept.all():
            return
        self._section = self._section.thinned(kept)
        self._colors, self._log_radii = compacted(self._colors, kept), compacted(self._log_radii, kept)
        self._opacity_logits = compacted(self._opacity_logits, kept)
        low, high = self._log_radius_bounds
        self._log_radius_bounds = (compacted(low, kept), compacted(high, kept))
        self._most_weight = compacted(self._most_weight, kept)
        self._prior = None if self._prior is None else self._prior.thinned(kept)
        for moments in (self._moments.colors, self._moments.log_radii, self._moments.opacity_logits):
            moments.thin(kept)

    def good_enough(self) -> bool:
        """Whether the last few steps found a loss below ``enough_loss``: more would fit these views, not the scene."""
        recent = self._losses[-_RECENT_STEPS:]
        return len(recent) == _RECENT_STEPS and sum(recent) < _RECENT_STEPS * self._settings.enough_loss

    def move_anchor(self, T_world_section: npt.NDArray[np.float64]) -> None:
        """Bundle adjustment of a head: the section moves as a whole, its own views see no change."""
        self._section = replace(self._section, T_world_section=T_world_section)

    def finished(self) -> Optimised:
        """The section with the attributes reached."""
        return Optimised(
            section=self._current(),
            moments=self._moments,
            loss=self._losses[-1] if self._losses else 0.0,
            steps=len(self._losses),
            renders=self._renders,
        )

    def _splats(self) -> Splats:
        return Splats(
            means_m=self._section.means_m,
            colors=self._colors,
            log_radii=self._log_radii,
            opacity_logits=self._opacity_logits,
        )

    def _current(self) -> Section:
        gaussians = self._section.gaussians.with_attributes(
            colors=self._colors, log_radii=self._log_radii, opacity_logits=self._opacity_logits
        )
        return replace(self._section, gaussians=gaussians)

    def _loss_gradients(
        self,
        splats: Splats,
        view: TrainingView,
        T_camera_section: npt.NDArray[np.float64],
        *,
        want_means: bool,
        want_weights: bool = False,
    ) -> tuple[Gradients, float]:
        rendering = self._engine.render(splats, view.frame.camera, T_camera_section)
        self._renders += 1
        loss = mapping_loss(
            rendering.rgb,
            rendering.depth_m,
            view.exposure.removed(view.frame.rgb),
            view.frame.depth_m(),
            weight_color=self._settings.color_weight,
            weight_depth=self._settings.depth_weight,
            ssim_share=self._settings.ssim_share,
        )
        gradients = self._engine.backward(
            rendering,
            d_rgb=loss.d_rgb,
            d_depth=loss.d_depth,
            want_means=want_means,
            want_pose=False,
            want_weights=want_weights,
        )
        return gradients, loss.loss


def _camera_twist_gradient(
    splats: Splats, gradients: Gradients, first: int, T_camera_section: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Gradient [6] of a left camera twist that moves only the Gaussians from row ``first`` on (the neighbours)."""
    assert gradients.means_m is not None
    rotation, translation = T_camera_section[:3, :3], T_camera_section[:3, 3]
    points = splats.means_m[first:].astype(np.float64) @ rotation.T + translation
    forces = gradients.means_m[first:].astype(np.float64) @ rotation.T
    return np.concatenate([forces.sum(axis=0), np.cross(points, forces).sum(axis=0)])

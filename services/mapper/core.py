"""The mapper: grows the active section with each frame and optimises it (paper, sections 3.2, 3.4 and 3.5).

Pure: no bus, clock or files. Random choices are keyed by (seed, frame), so a restart repeats them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure, estimated_exposure
from vtslam.common.frame import Frame
from vtslam.common.gaussians import ViewTiedGaussians, edge_mask, tied_to_frame
from vtslam.common.geometry import se3
from vtslam.common.section import Section, SectionFrame
from vtslam.common.settings import MapperSettings, SectionSettings
from vtslam.common.splat.engine import Engine, Rendering
from vtslam.services.mapper.bundle import HeadBundle
from vtslam.services.mapper.optimise import Optimised, SectionOptimiser
from vtslam.services.mapper.state import ActiveSection, CommitRecord, TrainingView

# Small errors of the exposure add up from section to section; let go of this share, they stay bounded.
_GAUGE_LEAK = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Mapper:
    """Settings and engine of the mapper; holds no state of the stream."""

    settings: MapperSettings
    section_settings: SectionSettings
    engine: Engine
    seed: int

    def map_head(
        self,
        frame: Frame,
        T_world_camera: npt.NDArray[np.float64],
        *,
        section_id: int,
        neighbours: list[Section],
        previous: Section | None = None,
        in_time: Callable[[], bool] = lambda: True,
    ) -> tuple[ActiveSection, CommitRecord]:
        """Open a section at its head: a Gaussian at every pixel with depth, optimised with its neighbours (Eq. 2).

        Args:
            frame: The head.
            T_world_camera: float64 [4,4], its tracked pose; bundle adjustment may move it.
            section_id: The new section.
            neighbours: The previous and the overlapping section, without repetition; empty for section 0.
            previous: The previous section, which the head's exposure is measured by; None for section 0.
            in_time: Whether there is time for another step; asked from the second one on.
        """
        exposure = self._head_exposure(frame, T_world_camera, previous)
        section = Section(
            section_id=section_id,
            T_world_section=T_world_camera,
            camera=frame.camera,
            depth_scale_m=frame.depth_scale_m,
            depth_factor=self.settings.depth_factor,
            frames=(self._section_frame(frame, np.eye(4), 0, exposure, held_out=False),),
            gaussians=self._tied(frame, frame.depth > 0, 0, exposure),
            means_m=np.zeros((0, 3), np.float32),
            surface=np.zeros((0, 6), np.float32),
        ).retied()
        view = TrainingView(frame_index=0, frame=frame, exposure=exposure)
        optimiser = SectionOptimiser(section, neighbours, self.engine, self.settings, moments=None, views=(view,))
        bundle = HeadBundle(T_world_camera, self.settings)
        if section.gaussians.count:
            for step in range(self.settings.iterations_head):
                if optimiser.good_enough() or (step and not in_time()):
                    break
                pose_gradient = optimiser.step(view, with_neighbours=True, drop_hidden=step == 0)
                optimiser.move_anchor(bundle.moved(pose_gradient))
        result = optimiser.finished()
        active = ActiveSection(
            section=result.section,
            views=(view,),
            neighbour_ids=tuple(n.section_id for n in neighbours),
            moments=result.moments,
        )
        added = active.section.gaussians.count
        return active, self._record(frame, active, result, added, held_out=False)

    def map_regular(
        self,
        frame: Frame,
        T_world_camera: npt.NDArray[np.float64],
        active: ActiveSection,
        *,
        neighbours: list[Section],
        held_out: bool = False,
        in_time: Callable[[], bool] = lambda: True,
    ) -> tuple[ActiveSection, CommitRecord]:
        """Complement the section where it does not cover the frame, and optimise it on random views of its own.

        Args:
            frame: A frame that is no head.
            T_world_camera: float64 [4,4], its tracked pose.
            active: The section so far.
            neighbours: The sections named by ``active.neighbour_ids``.
            held_out: Record the pose only: add nothing, learn nothing from it.
            in_time: Whether there is time for another step; asked from the second one on.
        """
        row = len(active.section.frames)
        T_section_frame = active.section.T_section_camera(T_world_camera)
        new, views, exposure = ViewTiedGaussians.empty(), active.views, active.section.frames[-1].exposure
        if not held_out:
            shown = self._shown(active.section, frame, T_section_frame)
            if self.settings.exposure:
                exposure = estimated_exposure(shown, frame, fallback=exposure)
            empty = active.section.gaussians.count == 0
            wanted = frame.depth > 0 if empty else self._uncovered(shown, frame, exposure)
            new = self._tied(frame, wanted, row, exposure)
            views = (*views, TrainingView(frame_index=row, frame=frame, exposure=exposure))
        stored = self._section_frame(frame, T_section_frame, row, exposure, held_out=held_out)
        section = active.section.grown(stored, new)
        chosen = self._random_views(frame.frame_id, len(views), self.settings.iterations_regular)
        if new.count and self.settings.least_weight > 0:
            chosen[:1] = len(views) - 1  # its own view first: it shows which of the new ones are hidden
        result = self._optimised(
            section,
            neighbours,
            active,
            views,
            chosen,
            rates=np.ones(chosen.size),
            drop_hidden=new.count > 0,
            in_time=in_time,
        )
        grown = ActiveSection(
            section=result.section, views=views, neighbour_ids=active.neighbour_ids, moments=result.moments
        )
        added = grown.section.gaussians.count - active.section.gaussians.count
        return grown, self._record(frame, grown, result, added, held_out=held_out)

    def seal(self, active: ActiveSection, *, neighbours: list[Section]) -> tuple[Section, int]:
        """Finish a section: a last round over all its views; afterwards its payload never changes.

        Returns:
            The section and the renders spent.
        """
        count = self.settings.iterations_seal
        key = self._section_key(active.section)
        chosen = self._even_views(key, len(active.views), count)
        rates = np.geomspace(self.settings.seal_rate_first, self.settings.seal_rate_last, count)
        watched = len(active.views) if self.settings.least_weight_sealed > 0 else 0
        result = self._optimised(active.section, neighbours, active, active.views, chosen, rates=rates, watched=watched)
        section = result.section
        last = active.views[-1]
        return section.finished(last.frame_index, last.frame.depth), result.renders

    def _optimised(
        self,
        section: Section,
        neighbours: list[Section],
        active: ActiveSection,
        views: tuple[TrainingView, ...],
        chosen: npt.NDArray[np.int64],
        *,
        rates: npt.NDArray[np.float64],
        drop_hidden: bool = False,
        watched: int = 0,
        in_time: Callable[[], bool] = lambda: True,
    ) -> Optimised:
        """The section after a step on each of the chosen views.

        Args:
            section: Of what ``active`` has become.
            neighbours: For the joint loss.
            active: Its optimiser state goes on.
            views: The section's.
            chosen: Indices into ``views``, a step each.
            rates: Of each step.
            drop_hidden: Whether the first step leaves out hidden Gaussians of its view.
            watched: After so many steps those that showed too little in them are left out; 0 never.
            in_time: Whether there is time for another step; asked from the second one on.
        """
        optimiser = SectionOptimiser(
            section, neighbours, self.engine, self.settings, moments=active.moments, views=views
        )
        if section.gaussians.count:
            for step, (index, rate) in enumerate(zip(chosen, rates, strict=True)):
                if optimiser.good_enough() or (step and not in_time()):
                    break
                # The head alone is shared with the neighbours (docs/method.md, 3.3).
                optimiser.step(
                    views[index],
                    with_neighbours=index == 0,
                    rate=float(rate),
                    drop_hidden=drop_hidden and step == 0,
                    watch=step < watched,
                )
                if step + 1 == watched:
                    optimiser.drop_unseen()
        return optimiser.finished()

    def _section_frame(
        self,
        frame: Frame,
        T_section_frame: npt.NDArray[np.float64],
        row: int,
        exposure: Exposure,
        *,
        held_out: bool,
    ) -> SectionFrame:
        """A row of the frame table; candidate views and the middle frame keep their depth."""
        s = self.section_settings
        keeps_depth = not held_out and (row % s.candidate_interval == 0 or row == s.length // 2)
        return SectionFrame(
            frame_id=frame.frame_id,
            capture_time_ns=frame.capture_time_ns,
            T_section_frame=T_section_frame,
            exposure=exposure,
            view_depth=frame.depth if keeps_depth else None,
        )

    def _tied(self, frame: Frame, mask: npt.NDArray[np.bool_], row: int, exposure: Exposure) -> ViewTiedGaussians:
        s = self.settings
        return tied_to_frame(
            frame,
            mask,
            frame_index=row,
            depth_factor=s.depth_factor,
            opacity=s.initial_opacity,
            radius_factor=s.initial_radius,
            border_radius=s.border_radius,
            edges=edge_mask(frame.rgb, low=s.edge_low, high=s.edge_high) if s.edge_supplement else None,
            exposure=exposure,
        )

    def _shown(self, section: Section, frame: Frame, T_section_frame: npt.NDArray[np.float64]) -> Rendering:
        """The section as the frame's camera sees it."""
        return self.engine.render(section.splats, frame.camera, se3.inverse(T_section_frame))

    def _head_exposure(
        self, frame: Frame, T_world_camera: npt.NDArray[np.float64], previous: Section | None
    ) -> Exposure:
        """A head's exposure, in the gauge of the section before it; the world's first frame sets the gauge."""
        if previous is None or not self.settings.exposure:
            return Exposure.identity()
        shown = self._shown(previous, frame, previous.T_section_camera(T_world_camera))
        found = estimated_exposure(shown, frame, fallback=previous.frames[-1].exposure)
        return found.nearer_to_identity(_GAUGE_LEAK)

    def _uncovered(self, rendering: Rendering, frame: Frame, exposure: Exposure) -> npt.NDArray[np.bool_]:
        """Pixels where the section shows nothing, or something far behind what was measured (docs/method.md, 3.1)."""
        uncovered = rendering.alpha < self.settings.uncovered_silhouette
        depth_m, valid = frame.depth_m(), frame.depth > 0
        if self.settings.uncovered_depth_factor > 0 and valid.any():
            error = np.abs(rendering.depth_m - depth_m)
            limit = self.settings.uncovered_depth_factor * float(np.median(error[valid]))
            uncovered |= (rendering.depth_m > depth_m) & (error > limit) & valid
        if self.settings.uncovered_color_error > 0:
            difference = np.abs(exposure.applied(rendering.rgb) - frame.rgb_float()).mean(axis=2)
            uncovered |= difference > self.settings.uncovered_color_error
        return np.asarray(uncovered)

    def _random_views(self, frame_id: int, views: int, count: int) -> npt.NDArray[np.int64]:
        """Uniform choices among the section's views up to now, keyed by (seed, frame)."""
        generator = np.random.Generator(np.random.Philox(key=np.array([self.seed, frame_id], np.uint64)))
        return generator.integers(0, views, size=count)

    def _even_views(self, key: int, views: int, count: int) -> npt.NDArray[np.int64]:
        """Every view equally often, in an order keyed by (seed, section)."""
        generator = np.random.Generator(np.random.Philox(key=np.array([self.seed, key], np.uint64)))
        rounds = [generator.permutation(views) for _ in range(-(-count // views))]
        return np.concatenate([*rounds, np.zeros(0, np.int64)])[:count].astype(np.int64)

    @staticmethod
    def _section_key(section: Section) -> int:
        """A key that no frame uses."""
        return 2**40 + section.section_id

    def _record(
        self, frame: Frame, active: ActiveSection, result: Optimised, added: int, *, held_out: bool
    ) -> CommitRecord:
        section = active.section
        return CommitRecord(
            frame_id=frame.frame_id,
            section_id=section.section_id,
            frame_index=len(section.frames) - 1,
            T_world_camera=section.T_world_frame(len(section.frames) - 1),
            exposure=section.frames[-1].exposure,
            gaussians_added=added,
            gaussians=section.gaussians.count,
            iterations=result.steps,
            renders=result.renders,
            loss=result.loss,
            held_out=held_out,
        )

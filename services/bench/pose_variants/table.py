"""The table of ways to estimate a pose that the bench compares."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from vtslam.common.section import Section
from vtslam.common.settings import TrackerSettings
from vtslam.common.splat.engine import Engine
from vtslam.services.bench.pose_variants.gaussian_pyramid import GaussianPyramidAlignment, GaussianPyramids
from vtslam.services.bench.pose_variants.gicp import GeneralisedIcp
from vtslam.services.bench.pose_variants.inverse import InverseCompositional
from vtslam.services.bench.pose_variants.product import OfTracker, OpenCvOfPrevious, OpenCvOfView
from vtslam.services.bench.pose_variants.task import SolvesPose
from vtslam.services.bench.pose_variants.through_splat import ThroughSplat

_STEPS_FULL_SIZE, _STEPS_PER_LEVEL = 12, 4
_FEW_ADAM, _ALL_ADAM = 40, 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Variant:
    """One row of the table.

    Attributes:
        name: Its key in results.
        solver: What is measured.
        uses_guess: Whether the first guess matters at all.
        in_numpy: Whether its arithmetic is an experiment's, whose time says nothing of what a kernel would take.
        prepare: Makes what a map would keep ready for it; that time does not count.
    """

    name: str
    solver: SolvesPose
    uses_guess: bool = True
    in_numpy: bool = False
    prepare: Callable[[Section], object] = lambda section: None


def pose_variants(engine: Engine, settings: TrackerSettings, *, threads: int) -> list[Variant]:
    """All variants, the tracker's own first; noise model, levels and renders are those of the settings."""
    s, pyramids = settings.gauss_newton, GaussianPyramids()

    def tracker(**changes: float) -> OfTracker:
        changed = replace(settings, optimizer="gauss_newton", gauss_newton=replace(s, **changes))  # type: ignore[arg-type]
        return OfTracker(engine=engine, settings=changed, threads=threads)

    def adam(iterations: int) -> OfTracker:
        steps = replace(settings.adam, iterations=iterations, first_section_iterations=iterations)
        return OfTracker(engine=engine, settings=replace(settings, optimizer="adam", adam=steps), threads=threads)

    def through_splat(levels: int, steps: int, *, to_surface: bool = False) -> ThroughSplat:
        return ThroughSplat(
            engine=engine, settings=s, pyramids=pyramids, levels=levels, steps=steps, to_surface=to_surface
        )

    def merge(section: Section) -> None:
        pyramids.prepare(section, s.levels)

    gicp = GeneralisedIcp(engine, s, threads=threads)
    gaussian_pyramid = GaussianPyramidAlignment(engine=engine, settings=s, pyramids=pyramids, threads=threads)
    return [
        Variant(name="forward", solver=tracker()),
        Variant(name="color_only", solver=tracker(depth_weight=0.0)),
        Variant(name="depth_only", solver=tracker(color_weight=0.0)),
        Variant(name="no_pyramid", solver=tracker(levels=1)),
        Variant(name="gaussian_pyramid", solver=gaussian_pyramid, prepare=merge),
        Variant(name="inverse", solver=InverseCompositional(engine, s), in_numpy=True),
        Variant(name="gicp", solver=gicp, in_numpy=True, prepare=gicp.surface),
        Variant(name="splat", solver=through_splat(1, _STEPS_FULL_SIZE), in_numpy=True),
        Variant(name="splat_pyramid", solver=through_splat(s.levels, _STEPS_PER_LEVEL), in_numpy=True),
        Variant(name="splat_surface", solver=through_splat(s.levels, _STEPS_PER_LEVEL, to_surface=True), in_numpy=True),
        Variant(name="adam_40", solver=adam(_FEW_ADAM)),
        Variant(name="adam_200", solver=adam(_ALL_ADAM)),
        Variant(name="opencv_view", solver=OpenCvOfView(engine=engine)),
        Variant(name="opencv_previous", solver=OpenCvOfPrevious(), uses_guess=False),
    ]

"""What a fleet has in shared memory, as parts to show. Only copies are taken and nothing is pinned."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.section import Section
from vtslam.common.settings import SplatSettings, ViewerSettings
from vtslam.common.shm.errors import DamagedBlock, GenerationGone, SectionNotResident
from vtslam.common.shm.map_store import MapStore
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.engines import make_engine, with_threads
from vtslam.services.section_map import ReadsSections
from vtslam.services.viewer import names
from vtslam.services.viewer.core import Limits, Poses, Scene, SeenFrame
from vtslam.services.viewer.parts import Part, Word
from vtslam.storage.errors import StorageError

_GROWTH_INTERVAL = 4  # updates: the growing map is the largest part of one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Committed:
    """The last commit, copied.

    Attributes:
        section: Its section as of then, with positions.
        frame: The frame, and what is known of it.
        is_sealed: Whether the section is finished.
    """

    section: Section
    frame: Frame
    facts: CommitFacts
    is_sealed: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Update:
    """Parts as of a frame."""

    frame_id: int
    parts: list[Part]


class FleetView:
    """Looks at the map store when asked to, and says what is new since it looked last.

    Args:
        store: The map store.
        archive: Where sections are that left it.
        settings: Limits on what is sent.
        splat: The rasteriser of the fleet, of which the one for CPUs is used with one thread.
        truth: float64 [F,4,4], true poses; None if there are none.
    """

    def __init__(
        self,
        store: MapStore,
        archive: ReadsSections,
        *,
        settings: ViewerSettings,
        splat: SplatSettings,
        truth: Poses | None,
    ) -> None:
        self._store, self._archive = store, archive
        self._engine = make_engine(with_threads(replace(splat, engine="native"), 1))
        limits = Limits(section_gaussians=settings.section_gaussians, gaussians=settings.gaussians)
        self._scene = Scene(limits, truth=truth)
        self._next_section = 0  # the first that was not sent as finished
        self._shown = (-1, False)  # the last frame, and whether its section was finished
        self._until_growth = 0  # updates
        self._grown_id: int | None = None  # the section that was sent last as growing
        self.last_frame_id = -1

    def news(self, counters: Mapping[str, Mapping[str, int]], memory_mb: Mapping[str, float]) -> Update | None:
        """What is new; None if nothing is, or nothing can be read at the moment.

        Args:
            counters: Of each service, by name.
            memory_mb: By what takes it.
        """
        committed = self._committed()
        if committed is None:
            return None
        shown = committed.frame.frame_id, committed.is_sealed
        finished = self._finished(committed)
        if shown == self._shown and not finished:
            return None
        parts = finished
        if shown != self._shown:
            parts += self._scene.frame(self._seen(committed)) + self._growth(committed)
            parts += self._scene.services(counters, {**memory_mb, "map": 1e-6 * self._store.used_bytes()})
        self._shown, self.last_frame_id = shown, committed.frame.frame_id
        active = None if committed.is_sealed else committed.section.section_id
        resident = set(self._store.sealed_ids())
        parts += self._scene.states(active=active, resident=resident, known=range(self._next_section))
        return Update(frame_id=committed.frame.frame_id, parts=parts)

    # --- what there is ----------------------------------------------------------------------------------------------

    def _committed(self) -> _Committed | None:
        with contextlib.suppress(SectionNotResident, GenerationGone):  # it changed at this moment
            section_id = self._store.active_id()
            if section_id is not None:
                reader = self._store.active_reader(section_id)
                if reader.generation:
                    state = reader.copied()
                    facts = CommitFacts.unpacked(state.facts)
                    return _Committed(
                        section=_placed(state.section), frame=state.frames[-1], facts=facts, is_sealed=False
                    )
            last = self._store.last_sealed_commit()
            if last is not None:
                section = _placed(self._store.copied_sealed(last.section_id))
                facts = CommitFacts.unpacked(last.facts)
                return _Committed(section=section, frame=last.frame, facts=facts, is_sealed=True)
        return None

    def _seen(self, committed: _Committed) -> SeenFrame:
        section, pose = committed.section, committed.facts.frame.T_world_camera
        rendering = self._engine.render(section.splats, section.camera, se3.inverse(section.T_section_camera(pose)))
        seen_rgb = committed.facts.exposure.applied(rendering.rgb)
        return SeenFrame(
            frame=committed.frame,
            T_world_camera=pose,
            rendering=replace(rendering, rgb=seen_rgb),
            facts=committed.facts.frame.facts,
        )

    def _growth(self, committed: _Committed) -> list[Part]:
        """The growing section now and then, and whenever it is another one."""
        if committed.is_sealed:
            self._grown_id, self._until_growth = None, 0
            return self._scene.nothing_grows()
        section_id = committed.section.section_id
        self._until_growth -= 1
        if section_id == self._grown_id and self._until_growth > 0:
            return []
        self._grown_id, self._until_growth = section_id, _GROWTH_INTERVAL
        return self._scene.growing(committed.section)

    def _finished(self, committed: _Committed) -> list[Part]:
        """The next finished section, one at a time."""
        section_id = self._next_section
        if section_id >= committed.section.section_id + committed.is_sealed:
            return []
        try:
            section = self._read(section_id)
        except (StorageError, DamagedBlock) as error:
            self._next_section += 1
            return [Word(path=names.EVENTS, text=f"section {section_id}: {error}")]
        self._next_section += 1
        return self._scene.finished(section)

    def _read(self, section_id: int) -> Section:
        try:
            return _placed(self._store.copied_sealed(section_id))
        except SectionNotResident:
            return self._archive.read(section_id)


def _placed(section: Section) -> Section:
    """The section with positions; without the surface, which nobody looks at here."""
    poses = np.stack([frame.T_section_frame for frame in section.frames])
    means_m = section.gaussians.means_m(section.camera, poses, depth_unit_m=section.depth_unit_m)
    return replace(section, means_m=means_m)

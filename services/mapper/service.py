"""The mapper as a service: a tracked pose in, a commit in the map store out, sections sealed when they are full."""

import math
from dataclasses import dataclass
from pathlib import Path

from vtslam.common.bus import Bus
from vtslam.common.frame import Frame
from vtslam.common.messages import FrameCommitted, SectionSealed, ServiceState, TrackedPose
from vtslam.common.section import Section
from vtslam.common.section_end import SectionEnd
from vtslam.common.settings import Settings
from vtslam.common.shm.active_writer import ActiveWriter
from vtslam.common.shm.errors import FrameGone, MapStoreFull, SharedMemoryFull
from vtslam.common.shm.frame_ring import FrameRingReader
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.records import ActiveSpec, Commit
from vtslam.common.shm.ring_layout import FrameDescriptor
from vtslam.common.shm.sealed_block import sealed_bytes
from vtslam.common.splat.engine import Engine
from vtslam.common.topics import MAPPER_COMMITTED, SECTION_ARCHIVED, SECTION_SEALED
from vtslam.services.commit_facts import CommitFacts, pixels_crc32
from vtslam.services.frame_facts import CommittedFrame, Seconds, frame_facts, untracked_state
from vtslam.services.frame_journal import JournalWriter
from vtslam.services.free_memory import give_back_free_memory
from vtslam.services.mapper.pose_intake import EveryPose, NewestPose, PoseIntake
from vtslam.services.mapper.state import ActiveSection, CommitRecord
from vtslam.services.mapper.turns import MapperTurns
from vtslam.services.pacing import Pace
from vtslam.services.section_map import ReadsSections, SectionMap
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink
from vtslam.services.shared_sections import active_section_of, commit_of

_NO_ROOM_S = 0.1  # until memory is asked for again
_GIVE_UP_S = 60.0  # without memory, although all that is finished could leave it


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetPaths:
    """Where the parts of the fleet's shared memory are that a mapper uses besides the map store: ring and journal."""

    ring: Path
    journal: Path


@dataclass(frozen=True, slots=True, eq=False)
class _Mapped:
    """A frame that was mapped and is to be committed."""

    commit: Commit
    active: ActiveSection
    facts: CommitFacts


class MapperService:
    """Commits each tracked frame to the map store, and seals sections.

    All it needs to go on after a crash is in the store: a frame is either committed with everything that follows from
    it, or will be mapped again from its pose, which the tracker then still has or finds again. What was committed last
    is announced again after a restart.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        settings: The effective settings.
        engine: The rasteriser.
        store: The map store.
        archive: Where sealed sections come from.
        paths: Ring and journal.
        pace: Which poses are mapped, and how many commits trackers look back.
    """

    def __init__(
        self,
        bus: Bus,
        link: ServiceLink,
        settings: Settings,
        engine: Engine,
        store: MapStore,
        archive: ReadsSections,
        paths: FleetPaths,
        pace: Pace,
    ) -> None:
        self._clock, self._link, self._settings, self._store = bus.clock, link, settings, store
        self._archive, self._paths, self._pace = archive, paths, pace
        self._map = SectionMap(archive, candidate_interval=settings.section.candidate_interval)
        self._turns = MapperTurns(settings, engine, self._map)
        self._journal = JournalWriter(paths.journal)
        self._intake: PoseIntake = NewestPose(bus) if pace.is_realtime else EveryPose(bus)
        self._committed = bus.publisher(MAPPER_COMMITTED)
        self._sealed = bus.publisher(SECTION_SEALED)
        self._archived, self._num_durable = bus.subscriber(SECTION_ARCHIVED), 0
        self._ring: FrameRingReader | None = None
        self._active: ActiveSection | None = None
        self._facts: CommitFacts | None = None
        self._last_row = 0  # of the last commit, in its section
        self._writer: ActiveWriter | None = None
        self._mapped: _Mapped | None = None
        self._untold: CommitFacts | None = None  # committed, but there was no room in the journal
        self._ended: tuple[Section, int, CommitFacts] | None = None  # section, renders and facts; not sealed yet
        self._no_room_since_ns: int | None = None
        self._take_over()

    def step(self) -> float | None:
        """See `Steps`."""
        self._link.poll()
        self._hear_of_archived()  # also while there is room: what is not read for long is lost
        section_id, row = self._place()
        sequence = 0 if self._facts is None else self._facts.sequence
        self._intake.listen(self._num_frames, sequence, section_id=section_id, row=row)
        if self._link.stopping:
            self._end()
            return None
        if self._untold is not None:
            return self._announce(self._untold)
        if self._mapped is not None:
            return self._commit(self._mapped)
        if self._active is not None and self._section_ends(self._active):
            return self._seal(self._active)
        pose = self._intake.take(self._num_frames)
        if pose is not None:
            self._link.tell(ServiceState.WORKING, self._last_frame_id)
            self._mapped = self._map_pose(pose)
            return 0.0
        if self._is_drained():
            self._end()
            return None
        self._link.tell(ServiceState.READY, self._last_frame_id)
        return HEARTBEAT_S

    @property
    def _num_frames(self) -> int:
        """Frames committed."""
        return 0 if self._facts is None else self._facts.num_frames

    def _place(self) -> tuple[int, int]:
        """Section of the next frame, and its row there."""
        if self._active is not None:
            return self._active.section.section_id, len(self._active.section.frames)
        return 0 if self._facts is None else self._facts.frame.facts.section_id + 1, 0

    @property
    def _last_frame_id(self) -> int:
        return -1 if self._facts is None else self._facts.frame.facts.frame_id

    def _end(self) -> None:
        self._journal.close()
        self._link.tell(ServiceState.FINISHED, self._last_frame_id)

    def _is_drained(self) -> bool:
        return self._intake.is_drained(self._num_frames, self._link.drain_through)

    def _section_ends(self, active: ActiveSection) -> bool:
        end = SectionEnd.of(self._settings, active.section.camera, lead=self._pace.lead)
        return end.is_reached(active.section) or self._is_drained()

    # --- taking over ------------------------------------------------------------------------------------------------

    def _take_over(self) -> None:
        """Go on from the last commit in the store."""
        self._writer = self._store.adopt_active()
        state = None if self._writer is None else self._writer.state()
        if state is not None:
            self._active = active_section_of(state, self._settings.mapper)
            self._last_row = len(self._active.section.frames) - 1
            self._map.committed(self._active.section)
            self._facts = CommitFacts.unpacked(state.facts)
        elif (last := self._store.last_commit()) is not None:
            section = self._archive.read(last.section_id)
            self._map.sealed(section)
            self._last_row = len(section.frames) - 1
            self._facts = CommitFacts.unpacked(last.facts)
        if self._facts is not None and not (self._active is not None and self._section_ends(self._active)):
            self._announce(self._facts)

    # --- one frame --------------------------------------------------------------------------------------------------

    def _map_pose(self, pose: TrackedPose) -> _Mapped | None:
        """Map a frame; None if the ring has it no more, which only happens where poses may be skipped."""
        try:
            frame = self._open_ring().copied(FrameDescriptor(slot=pose.slot, sequence=pose.slot_sequence))
        except FrameGone:
            if not self._intake.may_skip:
                raise
            self._link.count("frames.gone")
            return None
        return self._map_frame(frame, pose)

    def _map_frame(self, frame: Frame, pose: TrackedPose) -> _Mapped:
        start_ns = self._clock.monotonic_ns()
        section_id, row = self._place()
        budget_s = self._settings.mapper.budget_s
        active, record = self._turns.map(
            frame,
            pose.T_world_camera,
            self._active,
            section_id=section_id,
            row=row,
            in_time=lambda: budget_s == 0 or pose.track_s + 1e-9 * (self._clock.monotonic_ns() - start_ns) < budget_s,
        )
        map_s = 1e-9 * (self._clock.monotonic_ns() - start_ns)
        facts = self._facts_of(frame, pose, record, map_s)
        commit = commit_of(
            active,
            frame,
            held_out=record.held_out,
            keep_moments=self._settings.mapper.keep_moments,
            facts=facts.packed(),
        )
        return _Mapped(commit, active, facts)

    def _facts_of(self, frame: Frame, pose: TrackedPose, record: CommitRecord, map_s: float) -> CommitFacts:
        total_s = pose.read_s + pose.track_s + map_s
        facts = frame_facts(
            record,
            pose.quality,
            pose.covariance,
            state=pose.state.value if pose.quality is not None else untracked_state(is_first=self._num_frames == 0),
            seconds=Seconds(read_s=pose.read_s, track_s=pose.track_s, map_s=map_s, total_s=total_s),
        )
        return CommitFacts(
            num_frames=self._num_frames + 1,
            num_tracked=pose.num_tracked,
            sequence=pose.slot_sequence,
            iterations=record.iterations,
            frame=CommittedFrame(
                facts=facts, capture_time_ns=frame.capture_time_ns, T_world_camera=record.T_world_camera
            ),
            T_world_previous=None if self._facts is None else self._facts.frame.T_world_camera,
            history=pose.history,
            pixels_crc32=pixels_crc32(frame),
        )

    def _commit(self, mapped: _Mapped) -> float:
        try:
            if self._writer is None:
                self._writer = self._store.create_active(self._spec(mapped.active.section))
            self._writer.commit(mapped.commit)
        except (MapStoreFull, SharedMemoryFull) as error:
            return self._wait_for_room(error)
        self._no_room_since_ns = self._mapped = None
        self._active, self._facts = mapped.active, mapped.facts
        self._last_row = len(mapped.active.section.frames) - 1
        self._map.committed(mapped.active.section)
        self._link.count("frames.committed")
        return 0.0 if self._section_ends(mapped.active) else self._announce(mapped.facts)

    def _spec(self, section: Section) -> ActiveSpec:
        length, mapper = self._settings.section.length, self._settings.mapper
        per_pixel = 5 if mapper.edge_supplement else 1
        return ActiveSpec(
            section_id=section.section_id,
            camera=section.camera,
            depth_scale_m=section.depth_scale_m,
            depth_factor=section.depth_factor,
            max_frames=length,
            max_gaussians=per_pixel * section.camera.width * section.camera.height * length,
            with_moments=mapper.keep_moments,
            kept_generations=1 + self._pace.lead,
        )

    def _wait_for_room(self, error: MapStoreFull | SharedMemoryFull) -> float:
        """Sections leave the store once they are on disk; if that does not help in time, the error is raised."""
        now_ns, sealed = self._clock.monotonic_ns(), self._store.sealed_ids()
        if self._no_room_since_ns is None or any(section_id >= self._num_durable for section_id in sealed):
            self._no_room_since_ns = now_ns  # what the disk takes is not this service's to judge
        if not sealed or now_ns - self._no_room_since_ns > _GIVE_UP_S * 1e9:
            raise error
        self._link.tell(ServiceState.DEGRADED, self._last_frame_id, detail=f"waits: {error}")
        return _NO_ROOM_S

    def _hear_of_archived(self) -> None:
        while (archived := self._archived.receive()) is not None:
            self._num_durable = max(self._num_durable, archived.message.section_id + 1)

    # --- the end of a section ---------------------------------------------------------------------------------------

    def _seal(self, active: ActiveSection) -> float:
        assert self._writer is not None
        if self._ended is None:
            self._ended = self._end_of(active)
        section, renders, facts = self._ended
        try:
            self._store.seal(self._writer, section, facts.packed())
        except (MapStoreFull, SharedMemoryFull) as error:
            return self._wait_for_room(error)
        self._no_room_since_ns = self._ended = self._writer = self._active = None
        self._facts = facts
        self._map.sealed(section)
        self._link.count("sections.sealed")
        self._sealed.publish(
            SectionSealed(
                section_id=section.section_id,
                block=f"sealed-{section.section_id:06d}",
                generation=0,
                first_frame_id=section.head.frame_id,
                frames=len(section.frames),
                gaussians=section.gaussians.count,
                bytes_held=sealed_bytes(section),
                renders=renders,
                epoch=self._link.epoch,
            )
        )
        patience_s = self._announce(facts)
        give_back_free_memory()
        return patience_s

    def _end_of(self, active: ActiveSection) -> tuple[Section, int, CommitFacts]:
        assert self._facts is not None
        start_ns = self._clock.monotonic_ns()
        section, renders = self._turns.seal(active)
        seconds = 1e-9 * (self._clock.monotonic_ns() - start_ns)
        facts = self._facts.with_seal(gaussians=section.gaussians.count, renders=renders, seconds=seconds)
        return section, renders, facts

    # --- telling others ---------------------------------------------------------------------------------------------

    def _announce(self, facts: CommitFacts) -> float:
        """Tell of the last commit; harmless if that was done before."""
        self._untold = facts
        try:
            self._journal.append(facts, section_ended=self._active is None)
        except SharedMemoryFull as error:
            return self._wait_for_room(error)
        self._untold = self._no_room_since_ns = None
        if self._paths.ring.exists():  # when a run is resumed, it is made later, and made so that this holds
            self._open_ring().acknowledge(facts.sequence)
        frame, about = facts.frame, facts.frame.facts
        self._committed.publish(
            FrameCommitted(
                frame_id=about.frame_id,
                capture_time_ns=frame.capture_time_ns,
                section_id=about.section_id,
                frame_index=self._last_row,
                T_world_camera=frame.T_world_camera,
                exposure=facts.exposure,
                gaussians_added=about.gaussians_added,
                gaussians=about.gaussians,
                iterations=facts.iterations,
                renders=about.map_renders,
                loss=about.map_loss if math.isfinite(about.map_loss) else 0.0,
                held_out=about.held_out,
                block=f"{'sealed' if self._active is None else 'active'}-{about.section_id:06d}",
                generation=0 if self._writer is None else self._writer.generation,
                epoch=self._link.epoch,
            )
        )
        if self._writer is not None:
            self._writer.make_ready()  # the tracker is at work now
        return 0.0

    def _open_ring(self) -> FrameRingReader:
        self._ring = self._ring or FrameRingReader(self._paths.ring)
        return self._ring

"""The archiver as a service: finished sections to disk, verified; out of memory and back as readers need them."""

from vtslam.common.bus import Bus
from vtslam.common.messages import LoadOutcome, SectionArchived, SectionReply, SectionRequest, ServiceState
from vtslam.common.settings import Settings
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.residency import to_prefetch
from vtslam.common.topics import (
    FLEET_EVENT,
    MAPPER_COMMITTED,
    SECTION_ARCHIVED,
    SECTION_LOAD,
    SECTION_SEALED,
    STATUS,
)
from vtslam.services.archiver.archived import ArchivedSections
from vtslam.services.archiver.core import CameraAt, sections_ahead
from vtslam.services.archiver.fleet_record import FleetRecord
from vtslam.services.archiver.packing import Packing
from vtslam.services.archiver.resident_sections import ResidentSections
from vtslam.services.frame_journal import JournalReader
from vtslam.services.free_memory import give_back_free_memory
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink
from vtslam.storage.run_folder import RunFolder

_MAPPER = "mapper"


class ArchiverService:
    """The one writer of a run folder while its fleet lives, and of finished sections that come back into memory.

    What there is to write follows from the map store and the journal, what is written from the catalogue: so it goes
    on after a death at any instruction, and messages only wake it.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        settings: The effective settings.
        store: The map store.
        run: The run folder, open for writing; closed at the end.
        journal: Committed frames, of sections that are not durable at least.
    """

    def __init__(
        self, bus: Bus, link: ServiceLink, settings: Settings, store: MapStore, run: RunFolder, journal: JournalReader
    ) -> None:
        self._link, self._settings, self._run = link, settings, run
        self._record = FleetRecord(run, store, journal)
        self._store, self._sections = store, ArchivedSections(run.catalog)
        self._residents = ResidentSections(store, run, self._sections)
        self._packing = Packing(run, settings.storage)
        self._sealed = bus.subscriber(SECTION_SEALED)  # wakes; what is sealed is in the journal
        self._commits = bus.subscriber(MAPPER_COMMITTED, newest_only=True)
        self._mapper = bus.subscriber(STATUS, service=_MAPPER, newest_only=True)
        self._events = bus.subscriber(FLEET_EVENT)
        self._archived = bus.publisher(SECTION_ARCHIVED)
        self._questions = bus.queryable(SECTION_LOAD)
        self._camera: CameraAt | None = None  # at the last commit that was heard of
        self._ahead: list[int] = []  # sections that the next head may overlap
        self._mapper_waits = False
        if self._record.num_durable:
            self._announce(self._record.num_durable - 1)

    def step(self) -> float | None:
        """See `Steps`.

        Raises:
            StorageError: The run folder cannot be written.
        """
        self._link.poll()
        self._listen()
        self._answer()
        self._record.take_frames()
        self._residents.keep_room(self._record.num_durable, squeeze=self._mapper_waits, spared=self._ahead)
        if self._record.num_waiting:
            self._tell_of_waiting()
            if self._write_next():
                return 0.0
        elif self._link.stopping or self._link.drain_through is not None:
            self._run.close()
            self._link.tell(ServiceState.FINISHED, self._last_frame_id)
            return None
        elif not self._mapper_waits and (self._prefetch() or self._pack()):
            self._link.tell(ServiceState.WORKING, self._last_frame_id)
            return 0.0
        self._link.tell(ServiceState.READY, self._last_frame_id)
        return HEARTBEAT_S

    @property
    def _last_frame_id(self) -> int:
        return self._record.last_durable_frame_id

    # --- what is said -----------------------------------------------------------------------------------------------

    def _listen(self) -> None:
        while self._sealed.receive() is not None:
            pass
        while (status := self._mapper.receive()) is not None:
            self._mapper_waits = status.message.state is ServiceState.DEGRADED
        while (event := self._events.receive()) is not None:
            self._run.catalog.add_event(event.message.kind, event.message.text, time_ns=event.message.time_ns)
        commit = self._commits.receive()
        if commit is not None:
            about = commit.message
            newer = CameraAt(
                frame_id=about.frame_id, frame_index=about.frame_index, T_world_camera=about.T_world_camera
            )
            self._look_ahead(newer)

    def _look_ahead(self, newer: CameraAt) -> None:
        older, self._camera = self._camera, newer
        if older is not None and newer.frame_id > older.frame_id:
            self._ahead = sections_ahead(
                self._sections.places,
                older,
                newer,
                section_length=self._settings.section.length,
                at_most=self._settings.archiver.prefetch,
            )

    def _tell_of_waiting(self) -> None:
        waiting = self._record.num_waiting
        self._link.gauges["sections_waiting"] = float(waiting)
        if self._mapper_waits:
            text = f"mapping waits for memory: {waiting} finished sections are not on disk yet"
            self._link.tell(ServiceState.DEGRADED, self._last_frame_id, detail=text)
        else:
            self._link.tell(ServiceState.WORKING, self._last_frame_id)

    def _announce(self, section_id: int) -> None:
        row = self._run.catalog.section(section_id)
        assert row is not None
        self._archived.publish(
            SectionArchived(
                section_id=section_id,
                file_name=self._run.section_path(section_id).name,
                file_bytes=row.num_bytes,
                sha256=row.sha256.hex(),
                epoch=self._link.epoch,
            )
        )

    # --- to disk ----------------------------------------------------------------------------------------------------

    def _write_next(self) -> bool:
        record = self._record.write_next()
        if record is None:
            return False  # an earlier one is not sealed as far as this knows
        self._sections.add(record)
        self._link.count("sections.archived")
        self._link.gauges["sections_waiting"] = float(self._record.num_waiting)
        self._announce(record.section_id)
        give_back_free_memory()
        return True

    def _pack(self) -> bool:
        packed = self._packing.step(self._record.num_durable)
        if packed:
            self._link.count("sections.packed")
        return packed

    # --- back into memory -------------------------------------------------------------------------------------------

    def _answer(self) -> None:
        while (request := self._questions.receive()) is not None:
            request.reply(self._reply_to(request.message))

    def _reply_to(self, request: SectionRequest) -> SectionReply:
        section_id = request.section_id
        outcome, why = self._bring(section_id)
        is_there = outcome is LoadOutcome.RESIDENT
        return SectionReply(
            section_id=section_id,
            outcome=outcome,
            block=f"sealed-{section_id:06d}" if is_there else None,
            generation=0,
            detail="".join(c for c in why if c.isprintable())[:256],
        )

    def _prefetch(self) -> bool:
        """Bring a section back that the next head may overlap, if that costs none of the others of these."""
        for section_id in to_prefetch(self._ahead, self._store.sealed_ids(), ()):
            if self._residents.has_room_for(section_id, self._record.num_durable, spared=self._ahead):
                outcome, _ = self._bring(section_id)
                if outcome is LoadOutcome.RESIDENT:
                    self._link.count("sections.prefetched")
                    return True
        return False

    def _bring(self, section_id: int) -> tuple[LoadOutcome, str]:
        was_there = section_id in self._store.sealed_ids()
        outcome, why = self._residents.bring(section_id, self._record.num_durable, spared=self._ahead)
        if outcome is LoadOutcome.RESIDENT and not was_there:
            self._link.count("sections.reloaded")
            give_back_free_memory()
        return outcome, why

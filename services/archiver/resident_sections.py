"""Finished sections in the map store: let go when memory is wanted, brought back from disk when they are."""

import contextlib
from collections.abc import Iterable

from vtslam.common.messages import LoadOutcome
from vtslam.common.shm.errors import MapStoreFull, SectionPinned, SharedMemoryFull
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.residency import ResidentFacts
from vtslam.services.archiver.archived import ArchivedSections
from vtslam.services.archiver.core import Residency, Residents, StoreFacts
from vtslam.storage.catalog_rows import STORED
from vtslam.storage.errors import StorageError
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_care import require_intact
from vtslam.storage.section_convert import untied_section_of


class ResidentSections:
    """The one who decides which finished sections of a fleet are in memory.

    Args:
        store: The map store.
        run: The run folder.
        archived: What is on disk.
    """

    def __init__(self, store: MapStore, run: RunFolder, archived: ArchivedSections) -> None:
        self._store, self._run, self._archived = store, run, archived
        self._residency = Residency()
        store.remove_unfinished()

    def keep_room(self, num_durable: int, *, squeeze: bool, spared: Iterable[int]) -> None:
        """Let sections leave as the budget asks for, or all that may if ``squeeze``.

        Args:
            num_durable: The first so many sections are on disk, verified.
            squeeze: The mapper waits for memory.
            spared: Sections that leave last.
        """
        facts = self._facts()
        self._residency.observe(facts)
        self._let_go(self._residency.leaving(facts, self._residents(num_durable), squeeze=squeeze, spared=spared))

    def has_room_for(self, section_id: int, num_durable: int, *, spared: Iterable[int]) -> bool:
        """Whether a section can come back without one of ``spared`` leaving."""
        num_bytes = self._archived.num_bytes(section_id)
        leaving = self._residency.room_for(self._facts(), self._residents(num_durable), num_bytes, spared=spared)
        return leaving is not None and not set(leaving) & set(spared)

    def bring(self, section_id: int, num_durable: int, *, spared: Iterable[int]) -> tuple[LoadOutcome, str]:
        """Bring a section back into memory: what came of it, and why it is not there."""
        if section_id in self._store.sealed_ids():
            return LoadOutcome.RESIDENT, ""
        if section_id >= num_durable:
            return LoadOutcome.UNKNOWN, f"section {section_id} is not on disk"
        num_bytes = self._archived.num_bytes(section_id)
        leaving = self._residency.room_for(self._facts(), self._residents(num_durable), num_bytes, spared=spared)
        if leaving is None:
            return LoadOutcome.NO_ROOM, f"no room for {num_bytes} bytes beside what mapping needs"
        try:
            row = self._run.catalog.section(section_id)
            if row is None or row.state != STORED:
                return LoadOutcome.DAMAGED, f"section {section_id} was set aside"
            require_intact(self._run, row)
            section = untied_section_of(self._run.read_section(section_id))
        except StorageError as error:
            return LoadOutcome.DAMAGED, str(error)
        self._let_go(leaving)
        try:
            self._store.put_sealed(section)
        except (MapStoreFull, SharedMemoryFull) as error:  # the mapper was faster
            return LoadOutcome.NO_ROOM, str(error)
        return LoadOutcome.RESIDENT, ""

    def _let_go(self, section_ids: Iterable[int]) -> None:
        for section_id in section_ids:
            with contextlib.suppress(SectionPinned):  # since this looked
                self._store.unlink_sealed(section_id, verified_on_disk=True)

    def _facts(self) -> StoreFacts:
        used_bytes, free_bytes = self._store.used_bytes(), self._store.free_bytes()
        sealed_bytes = tuple(self._store.sealed_bytes().values())
        return StoreFacts(used_bytes=used_bytes, free_bytes=free_bytes, sealed_bytes=sealed_bytes)

    def _residents(self, num_durable: int) -> Residents:
        def look() -> list[ResidentFacts]:
            return [
                ResidentFacts(
                    section_id=resident.section_id,
                    num_bytes=resident.num_bytes,
                    last_used=resident.last_used_ns,
                    is_pinned=bool(resident.pinned_by),
                    is_verified=resident.section_id < num_durable,
                )
                for resident in self._store.residents()
            ]

        return look

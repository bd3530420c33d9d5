"""Which sealed sections of a fleet leave shared memory, and when: so that the section being mapped always has room."""

import contextlib
from collections.abc import Mapping

from vtslam.common.shm.errors import SectionPinned
from vtslam.common.shm.map_store import MapStore
from vtslam.common.shm.residency import ResidentFacts, make_room

_MARGIN = 1.25  # how much larger than any before it the next section may be without its mapper waiting


class Residency:
    """Keeps as much free in the map store as mapping and sealing a section took so far, and a margin.

    The section sealed last always stays: the last commit is told by it, and the next section is mapped beside it.

    Args:
        store: The map store.

    Attributes:
        peak_bytes: The most that the store took at any look.
        sealed_bytes: What all sections seen so far would take together.
    """

    def __init__(self, store: MapStore) -> None:
        self._store = store
        self._most_mapping = self._most_sealed = 0  # bytes: all but sealed sections; one sealed section
        self._last_seen = -1
        self.peak_bytes = self.sealed_bytes = 0

    def step(self, durable_sections: int, *, squeeze: bool) -> None:
        """Let sections leave as the budget asks for, or all that may if ``squeeze``.

        Args:
            durable_sections: The first so many are on disk, verified.
            squeeze: The mapper waits for memory.
        """
        used, free, sealed = self._store.used_bytes(), self._store.free_bytes(), self._store.sealed_bytes()
        mapping = used - sum(sealed.values())
        self._observe(used, sealed)
        self._most_mapping = max(self._most_mapping, mapping)
        self._most_sealed = max(self._most_sealed, *sealed.values(), 0)
        wanted = max(int(_MARGIN * (self._most_mapping + self._most_sealed)) - mapping, 0)
        if not squeeze and wanted <= free:
            return
        residents = self._residents(durable_sections)
        may_leave = sum(r.num_bytes for r in residents if r.is_verified and not r.is_pinned)
        attainable = free + may_leave
        plan = make_room(
            residents,
            wanted_bytes=attainable if squeeze else min(wanted, attainable),
            used_bytes=used,
            budget_bytes=used + free,
        )
        for section_id in plan.leaving:
            with contextlib.suppress(SectionPinned):  # since this looked
                self._store.unlink_sealed(section_id, verified_on_disk=True)

    def _observe(self, used: int, sealed: Mapping[int, int]) -> None:
        self.peak_bytes = max(self.peak_bytes, used)
        self.sealed_bytes += sum(size for section_id, size in sealed.items() if section_id > self._last_seen)
        self._last_seen = max(self._last_seen, *sealed, -1)

    def _residents(self, durable_sections: int) -> list[ResidentFacts]:
        return [
            ResidentFacts(
                section_id=resident.section_id,
                num_bytes=resident.num_bytes,
                last_used=resident.last_used_ns,
                is_pinned=bool(resident.pinned_by),
                is_verified=resident.section_id < durable_sections,
            )
            for resident in self._store.residents()[:-1]
        ]

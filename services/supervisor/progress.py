"""What a fleet has come to, as its supervisor sees it: frames from the journal, memory from the map store."""

from collections.abc import Callable

from vtslam.common.messages import SectionArchived, SectionSealed
from vtslam.common.shm.map_store import MapStore
from vtslam.services.frame_facts import FrameFacts
from vtslam.services.frame_journal import JournalReader
from vtslam.storage.catalog import Catalog


class FleetProgress:
    """Counts committed frames and finished sections; deletes journal lines that are durable and were counted.

    Args:
        catalog: What is durable as the fleet begins.
        journal: Committed frames.
        store: The map store.
        on_frame: Called once for each committed frame, in order.

    Attributes:
        num_frames: Frames committed.
        map_peak_bytes: The most that the map store took at any look.
        map_bytes: What all finished sections of this fleet would take in memory together.
    """

    def __init__(
        self, catalog: Catalog, journal: JournalReader, store: MapStore, on_frame: Callable[[FrameFacts], None]
    ) -> None:
        self._journal, self._store, self._on_frame = journal, store, on_frame
        self.num_frames, self._last_frame_id = catalog.num_frames, catalog.last_frame_id
        self.map_peak_bytes = self.map_bytes = 0
        self._last_sealed = self._num_durable = len(catalog.sections())
        journal.forget_before(self._num_durable)

    def sealed(self, section: SectionSealed) -> None:
        """Take in that a section was finished; it may be told again by a mapper that died."""
        if section.section_id >= self._last_sealed:
            self._last_sealed = section.section_id + 1
            self.map_bytes += section.bytes_held

    def archived(self, section: SectionArchived) -> None:
        """Take in that a section, and so all before it, is durable."""
        self._num_durable = max(self._num_durable, section.section_id + 1)

    def step(self) -> None:
        """Take in what is new."""
        for line in self._journal.new_lines():
            facts = line.frame.facts
            if facts.frame_id > self._last_frame_id:  # otherwise told again, as after a restart
                self._last_frame_id = facts.frame_id
                self.num_frames += 1
                self._on_frame(facts)
        self._journal.forget_before(self._num_durable)  # which were read above: all their lines came before
        self.map_peak_bytes = max(self.map_peak_bytes, self._store.used_bytes())

"""Writes the run folder of a fleet from its shared memory: sections with their frames."""

import contextlib

from vtslam.common.shm.errors import SharedMemoryError
from vtslam.common.shm.map_store import MapStore
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.frame_journal import JournalReader
from vtslam.services.run_record import RunRecord, RunSummary
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import record_of
from vtslam.storage.section_record import SectionRecord


class FleetRecord:
    """Everything here follows from what is in shared memory, so it does not matter when it is written, or by whom.

    Args:
        run: The run folder, open for writing; files that its catalogue does not name, of a writer that died, go.
        store: The map store.
        journal: Committed frames, those of sections that are not durable at least.

    Attributes:
        num_durable: Sections on disk and in the catalogue.
    """

    def __init__(self, run: RunFolder, store: MapStore, journal: JournalReader) -> None:
        self._run, self._store, self._journal = run, store, journal
        self.num_durable = len(run.catalog.sections())
        run.drop_sections(self.num_durable)
        self._record = RunRecord(run)
        journal.skip_before(self.num_durable)
        self._ended: dict[int, CommitFacts] = {}  # by section: sealed, and all its frames are known

    @property
    def num_waiting(self) -> int:
        """Finished sections that are not written."""
        return len(self._ended)

    @property
    def last_durable_frame_id(self) -> int:
        """The last frame of a section on disk; -1 if there is none."""
        return self._record.last_durable_frame_id

    def take_frames(self) -> None:
        """Take in what was committed since."""
        for line in self._journal.new_lines():
            if line.ended is not None and line.frame.facts.section_id >= self.num_durable:
                self._ended[line.frame.facts.section_id] = line.ended
            self._record.add(line.frame)

    def write_next(self) -> SectionRecord | None:
        """Make the next finished section durable, which the map store keeps until then; None if there is none.

        Raises:
            StorageError: It cannot be written.
        """
        section_id = self.num_durable
        if section_id not in self._ended:
            return None
        held = self._store.pinned_sealed(section_id)
        try:
            record = record_of(held.section)
            self._run.write_section(record)
            self._record.commit(record, self._ended[section_id])
        finally:
            held.release()
        del self._ended[section_id]
        self.num_durable += 1
        return record

    def finish(self, *, finished: bool, interrupted: bool, seconds: float, peak_rss_mb: float) -> RunSummary:
        """Write everything that is not written yet; see `RunRecord.finish`."""
        self.take_frames()
        self._write_finished()
        return self._record.finish(finished=finished, interrupted=interrupted, seconds=seconds, peak_rss_mb=peak_rss_mb)

    def finish_broken(self, *, seconds: float, peak_rss_mb: float) -> None:
        """Write what is known of a fleet that cannot go on; the frames of its open section are in no section file."""
        # Damage may be why it cannot go on. What lies before it in the journal is known all the same.
        with contextlib.suppress(SharedMemoryError, ValueError, KeyError, TypeError):
            self.take_frames()
            last = self._store.last_commit()  # whoever committed it may have died before it wrote to the journal
            if last is not None:
                facts = CommitFacts.unpacked(last.facts)
                self._record.add(facts.frame)
                if last.is_sealed and last.section_id >= self.num_durable:
                    self._ended[last.section_id] = facts
        self._write_finished()
        self._record.finish_broken(seconds=seconds, peak_rss_mb=peak_rss_mb)

    def _write_finished(self) -> None:
        while self.write_next() is not None:
            pass

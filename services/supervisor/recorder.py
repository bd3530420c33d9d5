"""Writes the run folder of a fleet from its shared memory: sections with their frames."""

import contextlib
from collections.abc import Callable

from vtslam.common.shm.errors import SharedMemoryError
from vtslam.common.shm.map_store import MapStore
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.frame_facts import CommittedFrame, FrameFacts
from vtslam.services.frame_journal import JournalReader
from vtslam.services.run_record import RunRecord, RunSummary
from vtslam.services.supervisor.residency import Residency
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import record_of


class Recorder:
    """Everything here follows from what is in shared memory, so it does not matter when it is written.

    Args:
        run: The run folder, open for writing.
        store: The map store.
        journal: Committed frames.
        on_frame: Called once for each committed frame.

    Attributes:
        residency: Lets sections leave memory.
    """

    def __init__(
        self, run: RunFolder, store: MapStore, journal: JournalReader, on_frame: Callable[[FrameFacts], None]
    ) -> None:
        self._run, self._store, self._journal, self._on_frame = run, store, journal, on_frame
        self._record, self.residency = RunRecord(run), Residency(store)
        self._next_section = len(run.catalog.sections())
        journal.forget_before(self._next_section)
        self._ended: dict[int, CommitFacts] = {}  # by section: sealed, and all its frames are known

    @property
    def num_frames(self) -> int:
        """Frames committed, as far as they were seen here."""
        return self._record.num_frames

    def step(self, *, make_room: bool = False) -> None:
        """Take in what is new; sections on disk leave memory as its budget asks for, all but one if ``make_room``.

        Raises:
            StorageError: The run folder cannot be written.
        """
        self._take_frames()
        self._archive()
        self.residency.step(self._next_section, squeeze=make_room)

    def finish(self, *, finished: bool, interrupted: bool, seconds: float, peak_rss_mb: float) -> RunSummary:
        """Write everything that is not written yet; see `RunRecord.finish`."""
        self.step()
        return self._record.finish(finished=finished, interrupted=interrupted, seconds=seconds, peak_rss_mb=peak_rss_mb)

    def finish_broken(self, *, seconds: float, peak_rss_mb: float) -> None:
        """Write what is known of a fleet that cannot go on; the frames of its open section are in no section file."""
        self.step()
        with contextlib.suppress(SharedMemoryError):  # which may be why the fleet cannot go on
            last = self._store.last_commit()  # whoever committed it may have died before it wrote to the journal
            if last is not None:
                facts = CommitFacts.unpacked(last.facts)
                self._take(facts.frame)
                if last.is_sealed and last.section_id >= self._next_section:
                    self._ended[last.section_id] = facts
                    self._archive()
        self._record.finish_broken(seconds=seconds, peak_rss_mb=peak_rss_mb)

    def _take_frames(self) -> None:
        for line in self._journal.new_lines():
            if line.ended is not None:
                self._ended[line.frame.facts.section_id] = line.ended
            self._take(line.frame)

    def _take(self, frame: CommittedFrame) -> None:
        is_new = frame.facts.frame_id > self._record.last_frame_id
        self._record.add(frame)
        if is_new:
            self._on_frame(frame.facts)

    def _archive(self) -> None:
        while self._next_section in self._ended:
            self._write(self._next_section)
            self._next_section += 1
            self._journal.forget_before(self._next_section)

    def _write(self, section_id: int) -> None:
        """Make a section durable; the map store keeps it until then."""
        held = self._store.pinned_sealed(section_id)
        try:
            record = record_of(held.section)
            self._run.write_section(record)
            self._record.commit(record, self._ended.pop(section_id))
        finally:
            held.release()

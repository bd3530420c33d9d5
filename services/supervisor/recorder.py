"""Writes the run folder of a fleet from its shared memory: sections, trajectory, facts per frame."""

import contextlib
from collections.abc import Callable

from vtslam.common.shm.errors import SectionNotResident, SectionPinned, SharedMemoryError
from vtslam.common.shm.map_store import MapStore
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.frame_facts import CommittedFrame, FrameFacts
from vtslam.services.frame_journal import JournalReader
from vtslam.services.run_record import RunRecord, RunSummary
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_convert import record_of

_RESIDENT_SECTIONS = 6  # sealed sections left in shared memory; others are on disk only


class Recorder:
    """Everything here follows from what is in shared memory, so it does not matter when it is written.

    Args:
        run: The run folder, open for writing.
        store: The map store.
        journal: Committed frames.
        on_frame: Called once for each committed frame.
    """

    def __init__(
        self, run: RunFolder, store: MapStore, journal: JournalReader, on_frame: Callable[[FrameFacts], None]
    ) -> None:
        self._run, self._store, self._journal, self._on_frame = run, store, journal, on_frame
        self._record = RunRecord(run)
        self._on_disk: set[int] = set()
        self._frames_on_disk = self._frames_written = 0

    @property
    def num_frames(self) -> int:
        """Frames committed, as far as they were seen here."""
        return self._record.num_frames

    def step(self, *, make_room: bool = False) -> None:
        """Take in what is new, and let sections that are on disk leave memory, all but one if ``make_room``.

        Raises:
            StorageError: The run folder cannot be written.
        """
        self._take_frames()
        self._archive(resident=1 if make_room else _RESIDENT_SECTIONS)
        if self._frames_written < self._frames_on_disk <= self.num_frames:
            self._record.write()
            self._frames_written = self.num_frames

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
                self._take(CommitFacts.unpacked(last.facts).frame)
        self._record.finish(finished=False, interrupted=False, seconds=seconds, peak_rss_mb=peak_rss_mb)

    def _take_frames(self) -> None:
        for frame in self._journal.new_frames():
            self._take(frame)

    def _take(self, frame: CommittedFrame) -> None:
        last = self._record.last()
        is_new = last is None or frame.facts.frame_id > last.facts.frame_id
        self._record.add(frame)
        if is_new:
            self._on_frame(frame.facts)

    def _archive(self, *, resident: int) -> None:
        sealed = self._store.sealed_ids()
        for section_id in sealed:
            if section_id not in self._on_disk:
                self._write(section_id)
        for section_id in sealed[: max(len(sealed) - resident, 0)]:
            with contextlib.suppress(SectionPinned):
                self._store.unlink_sealed(section_id, verified_on_disk=True)

    def _write(self, section_id: int) -> None:
        with contextlib.suppress(SectionNotResident):
            held = self._store.pinned_sealed(section_id)
            try:
                self._run.write_section(record_of(held.section))
                self._frames_on_disk += len(held.section.frames)
            finally:
                held.release()
            self._on_disk.add(section_id)

"""Where a run that was cut off goes on: the end of its last durable section, with all that crosses a frame boundary."""

from dataclasses import dataclass
from itertools import takewhile

from vtslam.common.frame import Frame
from vtslam.common.section_end import SectionEnd
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.sensor.sources.base import Source
from vtslam.storage.catalog_rows import STORED, SectionRow
from vtslam.storage.errors import RunFolderError
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_care import require_intact
from vtslam.storage.section_codecs import ROUNDING_CODECS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResumePoint:
    """The end of a durable section.

    Attributes:
        section_id: The section.
        facts: What was committed by then.
        frame: Its last frame, read again.
    """

    section_id: int
    facts: CommitFacts
    frame: Frame


def prepare_to_resume(run: RunFolder, source: Source, *, end: SectionEnd) -> ResumePoint | None:
    """Bring a run folder to the end of its last durable full section.

    A shorter last section, which a run leaves that was asked to stop, is dropped unless the recording ends with it:
    it is mapped again, as long as it would have been. So is everything after a section that was set aside.

    Args:
        run: The run folder, open for writing.
        source: Its recording.
        end: Where sections end.

    Returns:
        Where to go on; None for the beginning.

    Raises:
        StorageError: A section's file is not what the catalogue says or was rounded, the recording is another one, or
            nothing is known to go on from. The folder is as it was.
        SourceError: The last frame cannot be read, and the folder is as it was.
    """
    kept = _kept_sections(run, source, end)
    point = _point_after(run, kept[-1], source) if kept else None
    run.drop_sections(len(kept))
    run.remove_derived()
    return point


def _kept_sections(run: RunFolder, source: Source, end: SectionEnd) -> list[SectionRow]:
    """The sections that the run goes on after, from the first on."""
    kept = list(takewhile(lambda row: row.state == STORED, run.catalog.sections()))
    for row in kept:
        require_intact(run, row)
    if kept and not _is_whole(run, kept[-1], source, end):
        kept.pop()  # those before it are: the run went on after them
    rounded = next((row for row in kept if row.codec in ROUNDING_CODECS), None)
    if rounded is not None and kept[-1].end_frame_id != len(source):
        raise RunFolderError(
            f"{run.section_path(rounded.section_id)}: expected what was mapped, to go on from, found it rounded by the "
            f"codec {rounded.codec}: the result would be another one; run it again"
        )
    return kept


def _point_after(run: RunFolder, last: SectionRow, source: Source) -> ResumePoint:
    """The end of a section, if the recording is the one that was mapped."""
    packed = run.catalog.resume_record(last.section_id)
    if packed is None:
        raise RunFolderError(f"{run.path}: section {last.section_id} holds nothing to go on from; run it again")
    facts = CommitFacts.unpacked(packed)
    frame = source.frame(facts.num_frames - 1)
    if frame.capture_time_ns != facts.frame.capture_time_ns or not facts.saw(frame):
        raise RunFolderError(
            f"{run.path}: frame {frame.frame_id} of {source.uri} is not the one that was mapped; the recording changed"
        )
    return ResumePoint(section_id=last.section_id, facts=facts, frame=frame)


def _is_whole(run: RunFolder, row: SectionRow, source: Source, end: SectionEnd) -> bool:
    """Whether the last section would have taken no further frame.

    Gaussians that went when it was finished are not counted any more. So it may be mapped again in vain, with the same
    result.
    """
    if row.num_frames == end.frames or row.end_frame_id == len(source):
        return True
    section = run.read_section(row.section_id)
    poses = tuple(section.T_section_frame)
    return end.is_reached_by_poses(poses) or end.is_reached_by_gaussians(section.frame_index, len(poses))

"""Looking after the sections of a run: are they what the catalogue says, setting aside what is not, other codecs."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from vtslam.common import failpoints
from vtslam.storage.atomic import remove_files, rename_file, sync_folder, temporary_path, write_failed
from vtslam.storage.catalog_rows import STORED, SectionRow
from vtslam.storage.dense_section import DenseGrid
from vtslam.storage.errors import ChecksumMismatch, MalformedSection, StorageError, UnreadableFile
from vtslam.storage.run_folder import RunFolder
from vtslam.storage.section_codecs import ROUNDING_CODECS, SectionCodec, codec_of_header
from vtslam.storage.section_facts import file_facts
from vtslam.storage.section_file import read_columns, read_section, verify_file, write_section
from vtslam.storage.section_record import SectionRecord

WriteSection = Callable[[Path, SectionRecord, SectionCodec, DenseGrid | None], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionHealth:
    """What is known of a section: what is wrong with it, in words, or None."""

    section_id: int
    problem: str | None


def examined(run: RunFolder) -> Iterator[SectionHealth]:
    """Read every section's file and hold it against the catalogue; files that it does not name come last.

    Raises:
        StorageError: The catalogue itself cannot be read.
    """
    run.catalog.check()
    rows = run.catalog.sections()
    for row in rows:
        yield SectionHealth(section_id=row.section_id, problem=_problem_of(run, row))
    named = {row.section_id for row in rows}
    for section_id in run.section_ids():
        if section_id not in named:
            problem = f"{run.section_path(section_id)}: not in the catalogue, left by a run that was cut off"
            yield SectionHealth(section_id=section_id, problem=problem)


def repair(run: RunFolder) -> list[str]:
    """Bring a run folder in order: finish what was cut off, set damaged files aside, make the trajectory anew.

    A section that was set aside is mapped again, with all that follow it, when the run is resumed. Nothing is deleted
    but what the next resumed run would write again.

    Args:
        run: The run folder, open for writing.

    Returns:
        What was done, in words.
    """
    done = [text for row in run.catalog.sections() if (text := _finished_replacing(run, row))]
    for health in list(examined(run)):
        row = run.catalog.section(health.section_id)
        if health.problem is not None and (row is None or row.state == STORED):
            done.append(_set_aside(run, health, is_named=row is not None))
    before = run.trajectory_path.read_bytes() if run.trajectory_path.is_file() else None
    run.write_trajectory()
    if run.trajectory_path.read_bytes() != before:
        done.append(f"{run.trajectory_path}: made anew from the catalogue")
    for text in done:
        run.catalog.add_event("repaired", text)
    return done


def require_intact(run: RunFolder, row: SectionRow) -> None:
    """Raise StorageError unless a section's file is, by its size and footer, the one of the catalogue."""
    path = run.section_path(row.section_id)
    found = file_facts(path)
    if (found.num_bytes, found.sha256) != (row.num_bytes, row.sha256):
        is_next = found.sha256 == row.next_sha256  # a repacking was cut off
        advice = f"(vtslam sections repair {run.path} {'brings it in order' if is_next else 'sets it aside'})"
        raise ChecksumMismatch.differing(
            path,
            "file",
            expected=f"{row.num_bytes} bytes with SHA-256 {row.sha256.hex()[:16]}...",
            found=f"{found.num_bytes} with {found.sha256.hex()[:16]}... {advice}",
        )


def pack_ahead(run: RunFolder, section_id: int, *, codec: SectionCodec, grid: DenseGrid | None = None) -> None:
    """Write a section with another codec beside its file, for :func:`repack` to take when the run has ended.

    Until then the section is read from its own file: what a codec has rounded would be another map.

    Raises:
        StorageError: The section cannot be read or written; it is as it was.
    """
    path = run.packed_path(section_id)
    if not path.parent.is_dir():
        try:
            path.parent.mkdir()
        except OSError as error:
            raise write_failed(path, error) from error
        sync_folder(run.path)
    write_section(path, run.read_section(section_id), codec, grid)


def repack_all(run: RunFolder, codec: SectionCodec, grid: DenseGrid | None = None) -> None:
    """Bring the files of all sections on disk into ``codec``, those packed ahead at little cost; see :func:`repack`.

    What is rounded already stays so: no other codec would bring it back, and its name would say that none was lost.
    """
    for row in run.catalog.sections():
        if row.state == STORED and row.codec not in (codec, *ROUNDING_CODECS):
            repack(run, row.section_id, codec=codec, grid=grid, is_packed=_is_packed(run, row.section_id, codec))
    run.remove_packed()


def repack(
    run: RunFolder,
    section_id: int,
    *,
    codec: SectionCodec,
    grid: DenseGrid | None = None,
    is_packed: bool = False,
    write: WriteSection = write_section,
) -> tuple[int, int]:
    """Write a section's file anew with another codec; at any time the run has one whole file of it.

    Args:
        run: The run folder, open for writing.
        section_id: The section.
        codec: The codec. What ``fast`` or ``dense`` once rounded stays rounded.
        grid: What ``dense`` rounds to; None for the usual grid.
        is_packed: Whether :func:`pack_ahead` has written that file, and it is whole.
        write: Writes a record to a new file, durable and verified.

    Returns:
        Bytes of the file before and after.

    Raises:
        StorageError: The section cannot be read or written; it is as it was.
    """
    row = run.catalog.section(section_id)
    if row is None or row.state != STORED:
        raise UnreadableFile(f"{run.section_path(section_id)}: expected a section on disk, found none")
    path = run.section_path(section_id)
    source = run.packed_path(section_id) if is_packed else temporary_path(path)
    try:
        if not is_packed:
            write(source, run.read_section(section_id), codec, grid)
        new = file_facts(source)
        run.catalog.announce_file(section_id, new.sha256)
        failpoints.reach("run.pack.after_announce")
        rename_file(source, path)
        failpoints.reach("run.pack.after_rename")
    finally:
        remove_files([source])
    run.catalog.set_file(section_id, sha256=new.sha256, num_bytes=new.num_bytes, codec=codec)
    return row.num_bytes, new.num_bytes


def _is_packed(run: RunFolder, section_id: int, codec: SectionCodec) -> bool:
    """Whether a section was packed ahead in this codec, and is whole."""
    path = run.packed_path(section_id)
    try:
        verify_file(path)
        return codec_of_header(read_columns(path, [])[0]) == codec
    except StorageError:
        return False


def _problem_of(run: RunFolder, row: SectionRow) -> str | None:
    path = run.section_path(row.section_id)
    if row.state != STORED:
        return f"{path}: was set aside; vtslam run --resume {run.path} maps it again"
    try:
        found = verify_file(path)
        if found not in (row.sha256, row.next_sha256):
            raise ChecksumMismatch.differing(path, "SHA-256", expected=row.sha256.hex(), found=found.hex())
        _check_frames(path, read_section(path), row)
    except StorageError as error:
        return str(error)
    return None


def _check_frames(path: Path, record: SectionRecord, row: SectionRow) -> None:
    """Raise MalformedSection unless a file holds what the catalogue says of it."""
    found = (record.section_id, int(record.frame_ids[0]), record.num_frames, record.num_gaussians)
    expected = (row.section_id, row.first_frame_id, row.num_frames, row.num_gaussians)
    if found != expected:
        raise MalformedSection.differing(
            path, "section, first frame, frames, Gaussians", expected=expected, found=found
        )


def _finished_replacing(run: RunFolder, row: SectionRow) -> str | None:
    """Bring a repacking that was cut off to its end."""
    if row.next_sha256 is None:
        return None
    path = run.section_path(row.section_id)
    try:
        found, codec = file_facts(path), codec_of_header(read_columns(path, [])[0])
    except StorageError:
        return None  # told of by the examination that follows
    is_new = found.sha256 == row.next_sha256
    if is_new:
        run.catalog.set_file(row.section_id, sha256=found.sha256, num_bytes=found.num_bytes, codec=codec)
    else:
        run.catalog.set_file(row.section_id, sha256=row.sha256, num_bytes=row.num_bytes, codec=row.codec)
    return f"{path}: repacking was cut off; the {'new' if is_new else 'former'} file counts"


def _set_aside(run: RunFolder, health: SectionHealth, *, is_named: bool) -> str:
    """Move a section's file out of the way, if it is there; what was done, in words."""
    path, folder = run.section_path(health.section_id), run.path / "damaged"
    if path.exists():
        folder.mkdir(exist_ok=True)
        sync_folder(run.path)
        taken = {entry.name for entry in folder.iterdir()}
        name = next(name for n in range(len(taken) + 1) if (name := f"{path.stem}-{n}.vts") not in taken)
        rename_file(path, folder / name)
        what = f"set aside as {folder / name}"
    else:
        what = "missing"
    if (packed := run.packed_path(health.section_id)).exists():
        remove_files([packed])
    if is_named:
        run.catalog.set_missing(health.section_id)
    return f"{health.problem}; {what}"

"""What a section's file is, without reading its columns."""

import os
from dataclasses import dataclass
from pathlib import Path

from vtslam.storage.errors import TruncatedFile, UnreadableFile
from vtslam.storage.section_layout import FOOTER, check_crc


@dataclass(frozen=True, slots=True, kw_only=True)
class FileFacts:
    """Size in bytes, and SHA-256 as the footer says it, of a section's file."""

    num_bytes: int
    sha256: bytes


def file_facts(path: Path) -> FileFacts:
    """The facts of a section's file; cheap, and so no proof that its columns are whole.

    Raises:
        UnreadableFile: It is not there, or cannot be read.
        TruncatedFile, ChecksumMismatch: Its footer is not whole.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size < FOOTER.size:
                raise TruncatedFile.differing(path, "size", expected=f"at least {FOOTER.size} bytes", found=size)
            file.seek(size - FOOTER.size)
            footer = file.read(FOOTER.size)
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot open: {error.strerror}") from error
    reference, sha256, crc, _ = FOOTER.unpack(footer)
    check_crc(path, "footer", crc, reference + sha256)
    return FileFacts(num_bytes=size, sha256=sha256)

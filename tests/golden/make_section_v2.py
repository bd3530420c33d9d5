"""Writes `section_v2_*.vts` anew: `PYTHONPATH=src:tests python tests/golden/make_section_v2.py`.

Only for a fault in the samples themselves. A difference in what is read comes from the program and is an error in it:
files of version 2 exist elsewhere, and a change of the format takes a new version number and files of its own.
"""

from pathlib import Path

from helpers.sections import small_section

from vtslam.storage.section_codecs import SECTION_CODECS
from vtslam.storage.section_file import write_section

GOLDEN = {codec: Path(__file__).with_name(f"section_v2_{codec}.vts") for codec in SECTION_CODECS}

if __name__ == "__main__":
    for codec, path in GOLDEN.items():
        write_section(path, small_section(), codec)
        print(f"{path}: {path.stat().st_size} bytes")

"""Writes `section_v1.vts` anew: `PYTHONPATH=src:tests python tests/golden/make_section_v1.py`.

Only for a fault in the sample itself. A difference that comes from the program is an error in the program: files of
version 1 exist elsewhere, and a change of the format takes a new version number and a file of its own.
"""

from pathlib import Path

from helpers.sections import small_section

from vtslam.storage.section_file import write_section

GOLDEN = Path(__file__).with_name("section_v1.vts")

if __name__ == "__main__":
    write_section(GOLDEN, small_section())
    print(f"{GOLDEN}: {GOLDEN.stat().st_size} bytes")

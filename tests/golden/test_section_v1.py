"""The committed section file of version 1 stays readable."""

from pathlib import Path

from helpers.sections import assert_same_section, small_section

from vtslam.storage.section_file import read_section, verify_file

GOLDEN = Path(__file__).with_name("section_v1.vts")
SHA256 = "7ab5b3d36907d432e61b2da01d8486004d95de76d59cad80ae865901840496de"


def test_golden_file_is_the_committed_one() -> None:
    assert verify_file(GOLDEN).hex() == SHA256


def test_golden_file_is_read_bit_by_bit() -> None:
    assert_same_section(read_section(GOLDEN), small_section())

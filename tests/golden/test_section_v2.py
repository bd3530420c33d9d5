"""The committed section files of version 2 stay readable, one of each codec."""

from pathlib import Path

import numpy as np
import pytest
from helpers.sections import assert_same_section, small_section

from vtslam.storage.section_file import read_section, verify_file, write_section

FOLDER = Path(__file__).parent
SHA256 = {
    "raw": "18d5763fbc1c8c4f64dc525e748471dca03b48d064c5396706f13b9bb117ba47",
    "lossless": "c99aaa480c8b81af896944cdc70657c7f8a186d0b9a09d977ec76b2c0faf79cf",
    "fast": "21923a197bb66eb0c02c9b6c9ded0d345e2d424447d40626f42f0560fb88bc93",
    "dense": "0e0eaaeb834bab41fad8954d764b6fd4069b8d8955fd08553868feeaf404cd49",
}
# Largest errors of rounding, and the first values as they were read on the day the files were written.
ROUNDED: dict[str, dict[str, tuple[float, list[float]]]] = {
    "fast": {
        "color": (0.002, [-0.125, -0.109375, -0.09375, -0.078125]),
        "log_radius": (0.008, [-3.992188, -4.007812, -4.007812, -4.023438]),
        "opacity_logit": (0.016, [-1.0, -0.875, -0.75, -0.625]),
    },
    "dense": {
        "color": (0.05, [-0.12, -0.1, -0.08, 0.57]),
        "log_radius": (0.15, [-3.94449, -4.131622, -4.152459, -4.067896]),
        "opacity_logit": (1.0, [-0.836215, 1.263692, 1.263692, 0.187409]),
    },
}


def _golden(codec: str) -> Path:
    return FOLDER / f"section_v2_{codec}.vts"


@pytest.mark.parametrize("codec", SHA256)
def test_golden_files_are_the_committed_ones(codec: str) -> None:
    assert verify_file(_golden(codec)).hex() == SHA256[codec]


@pytest.mark.parametrize("codec", ["raw", "lossless"])
def test_exact_files_are_read_bit_by_bit(codec: str) -> None:
    assert_same_section(read_section(_golden(codec)), small_section())


def test_raw_file_is_written_byte_by_byte(tmp_path: Path) -> None:
    # The other codecs may write other bytes of the same content with another release of LZ4.
    write_section(tmp_path / "again.vts", read_section(_golden("raw")), "raw")
    assert (tmp_path / "again.vts").read_bytes() == _golden("raw").read_bytes()


@pytest.mark.parametrize("codec", ROUNDED)
def test_rounded_files_are_read_as_on_the_day_they_were_written(codec: str) -> None:
    found, expected = read_section(_golden(codec)), small_section()
    assert found.header() == expected.header()
    order = np.arange(20)
    if codec == "dense":
        order = np.lexsort((expected.subpixel, expected.pixel, expected.subpixel > 0, expected.frame_index))
    for name, array in expected.columns().items():
        wanted, read = array[order] if len(array) == 20 else array, getattr(found, name)
        if name in ROUNDED[codec]:
            error, sample = ROUNDED[codec][name]
            assert np.abs(read - wanted).max() <= error
            # The last digits are those of the machine's logarithm.
            np.testing.assert_allclose(read.reshape(-1)[:4], sample, rtol=0, atol=1e-5)
        else:
            assert read.tobytes() == wanted.tobytes(), name

"""Damaged files of every codec, half of them with checksums made right again: refused, or proper sections.

``VTSLAM_CORRUPTIONS`` sets how many (2000), ``VTSLAM_CORRUPTIONS_SEED`` which.
"""

import os
import random
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from helpers.sections import surface_section
from helpers.vts_bytes import VtsParts, parts_of

from vtslam.storage.errors import StorageError
from vtslam.storage.section_codecs import SECTION_CODECS
from vtslam.storage.section_file import decode_section, encode_section
from vtslam.storage.section_record import SectionRecord

_NAME = Path("damaged.vts")
_MOST_MEMORY_KB = 64 * 1024
_NUMBERS = (-1, 0, 1, 2, 5, 63, 255, 4096, 65535, 65536, 2**20, 2**31 - 1, 2**32, 2**47, 2**63 - 1)
_CASES = int(os.environ.get("VTSLAM_CORRUPTIONS", "2000"))
_SEED = int(os.environ.get("VTSLAM_CORRUPTIONS_SEED", "1"))


@pytest.fixture(scope="module")
def samples() -> list[bytes]:
    return [encode_section(surface_section(), codec, name=_NAME) for codec in SECTION_CODECS]


def _flipped_or_cut(data: bytes, draw: random.Random) -> bytes:
    """The bytes with some flipped, taken away, put in or exchanged."""
    out = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 8))):
        place, other = draw.randrange(len(out) + 1), draw.randrange(len(out) + 1)
        match draw.choice(("flip", "set", "cut", "insert", "swap")):
            case "flip" if place < len(out):
                out[place] ^= 1 << draw.randrange(8)
            case "set" if place < len(out):
                out[place] = draw.choice((0, 1, 127, 128, 255))
            case "cut":
                del out[place : place + draw.choice((1, 4, 64, len(out)))]
            case "insert":
                out[place:place] = draw.randbytes(draw.choice((1, 4, 64)))
            case "swap":
                out[place : place + 8], out[other : other + 8] = out[other : other + 8], out[place : place + 8]
    return bytes(out)


def _other_chunk(parts: VtsParts, draw: random.Random) -> VtsParts:
    """Another content of a column."""
    row = draw.choice(parts.rows)
    start = row[3] - 32 - len(parts.header)
    return parts.with_chunk(row[0], _flipped_or_cut(parts.body[start : start + row[4]], draw))


def _other_index(parts: VtsParts, draw: random.Random) -> VtsParts:
    """Other numbers, types, shapes or codecs in the index."""
    rows = parts.rows
    row = draw.choice(rows)
    match draw.choice(("shape", "shape", "type", "codec", "place")):
        case "shape":
            axis = draw.randrange(len(row[2]) + 1)
            row[2][axis : axis + 1] = [draw.choice(_NUMBERS)]
        case "type":
            row[1] = draw.choice(("int8", "uint16", "uint32", "float32", "float64"))
        case "codec":
            row[5] = draw.choice(("raw", "planes_lz4", "differences_lz4", "quantised_lz4", "zip"))
        case "place":
            row[draw.choice((3, 4, 6))] = draw.choice(_NUMBERS)
    return parts.with_rows(rows)


def _other_header(parts: VtsParts, draw: random.Random) -> VtsParts:
    """Another value somewhere in the header."""

    def change(header: dict[str, Any]) -> None:
        part = (
            header[draw.choice([key for key in ("camera", "grid") if key in header])] if draw.random() < 0.6 else header
        )
        key = draw.choice(sorted(part))
        number = draw.choice((*_NUMBERS, 0.0, -1.5, 1e-300, 1e300))
        part[key] = draw.choice((number, float(number), None, "dense", "fast", "lossless"))

    return parts.with_header(change)


_CHANGES: tuple[Callable[[VtsParts, random.Random], VtsParts], ...] = (_other_chunk, _other_index, _other_header)


def _peak_kb() -> int:
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return int(found[1])


def test_damage_is_refused_or_a_proper_section(samples: list[bytes]) -> None:
    draw, accepted = random.Random(_SEED), 0
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    before_kb = _peak_kb()
    for case in range(_CASES):
        sample = draw.choice(samples)
        resealed = case % 2 == 1
        data = draw.choice(_CHANGES)(parts_of(sample), draw).sealed() if resealed else _flipped_or_cut(sample, draw)
        if data == sample:
            continue
        try:
            record = decode_section(data, name=_NAME)
        except StorageError:
            continue
        finally:
            assert _peak_kb() - before_kb < _MOST_MEMORY_KB, f"case {case} took too much memory"
        assert resealed, f"case {case}: damage was not noticed"
        assert isinstance(record, SectionRecord)  # which checks itself
        accepted += 1
    assert accepted > _CASES // 50  # the chunks that changed are read, not refused for another reason


def test_parts_are_those_of_the_samples(samples: list[bytes]) -> None:
    for sample in samples:
        parts = parts_of(sample)
        row = parts.rows[3]
        start = row[3] - 32 - len(parts.header)
        assert parts.with_chunk(row[0], parts.body[start : start + row[4]]).sealed() == sample
        assert replace(parts, version=1).sealed() != sample

"""Leaving out rows, and adding some."""

import numpy as np
import pytest

from vtslam.common.rows import GrowingRows, compacted, thinned


@pytest.mark.parametrize("shape", [(7,), (7, 3)])
@pytest.mark.parametrize("kept", [[True, False, True, False], [False] * 4, [True] * 7, []])
def test_both_leave_out_the_same_rows(shape: tuple[int, ...], kept: list[bool]) -> None:
    values = np.random.default_rng(1).standard_normal(shape).astype(np.float32)
    mask = np.array(kept, bool)
    wanted = np.concatenate([values[: 7 - mask.size], values[7 - mask.size :][mask]])
    fresh = thinned(values, mask)
    np.testing.assert_array_equal(fresh, wanted)
    assert not np.shares_memory(fresh, values)
    in_place = compacted(values, mask)
    np.testing.assert_array_equal(in_place, wanted)
    assert np.shares_memory(in_place, values) == bool(in_place.size)


def test_growing_rows_are_all_rows_and_leave_those_handed_out_alone() -> None:
    rng = np.random.default_rng(2)
    parts = [rng.standard_normal((count, 3)).astype(np.float32) for count in (4, 0, 1, 30, 2, 2)]
    first = parts[0].copy()
    growing = GrowingRows(first)
    handed_out = [growing.values]
    for part in parts[1:]:
        growing.extend(part)
        handed_out.append(growing.values)
    first[:] = 0.0
    for count, values in enumerate(handed_out, start=1):
        np.testing.assert_array_equal(values, np.concatenate(parts[:count]))
    assert np.shares_memory(handed_out[-1], handed_out[-2])  # there was room

"""Leaving out rows."""

import numpy as np
import pytest

from vtslam.common.rows import compacted, thinned


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

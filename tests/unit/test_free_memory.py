import os
import subprocess
import sys

import numpy as np
import pytest

from vtslam.services.free_memory import give_back_free_memory
from vtslam.services.process_facts import private_rss_mb


def test_holes_between_arrays_are_given_back() -> None:
    arrays = [np.ones(100_000, np.uint8) for _ in range(1000)]
    del arrays[::2]
    before_mb = private_rss_mb(os.getpid())
    give_back_free_memory()
    assert private_rss_mb(os.getpid()) < before_mb - 30.0
    assert all(array[0] == 1 for array in arrays)


_LARGE_ARRAYS = """
import os
import numpy as np
from vtslam.services.free_memory import keep_large_arrays_apart
from vtslam.services.process_facts import private_rss_mb
keep_large_arrays_apart(rare={rare})
arrays = [np.ones({size}, np.uint8) for _ in range({count})]
before_mb = private_rss_mb(os.getpid())
del arrays[::2]
print(before_mb - private_rss_mb(os.getpid()))
"""


@pytest.mark.parametrize(("rare", "size", "count"), [(False, 8 << 20, 8), (True, 256 << 10, 256)])
def test_large_arrays_go_back_by_themselves(rare: bool, size: int, count: int) -> None:
    """In a process of its own: where the heap has room already, arrays go there."""
    script = _LARGE_ARRAYS.format(rare=rare, size=size, count=count)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert float(done.stdout) > 30.0

import os

import numpy as np

from vtslam.services.free_memory import give_back_free_memory
from vtslam.services.process_facts import private_rss_mb


def test_holes_between_arrays_are_given_back() -> None:
    arrays = [np.ones(100_000, np.uint8) for _ in range(1000)]
    del arrays[::2]
    before_mb = private_rss_mb(os.getpid())
    give_back_free_memory()
    assert private_rss_mb(os.getpid()) < before_mb - 30.0
    assert all(array[0] == 1 for array in arrays)

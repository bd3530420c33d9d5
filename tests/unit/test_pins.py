"""The table of pins, in words of this process."""

import os

import numpy as np
import pytest

from vtslam.common.shm._atomics import Words
from vtslam.common.shm.errors import NoFreePin
from vtslam.common.shm.pins import PinTable
from vtslam.common.shm.process_identity import identity_of, own_identity

COUNT = 3


class OthersReap(PinTable):
    """A table of which another process frees the dead entries whenever this one is about to."""

    def reap(self) -> int:
        super().reap()
        return super().reap()  # what is left to this one


DEAD = identity_of(os.getpid(), 1)  # another process had this pid before


def words_of(*identities: int) -> Words:
    words = Words(np.zeros(2 * COUNT, np.uint64))
    for place, identity in enumerate(identities):
        words.store(2 * place, identity)
    return words


def test_a_free_entry_is_claimed_and_given_back() -> None:
    table = PinTable(words_of(own_identity()), first_word=0, count=COUNT)
    entry = table.claim()
    assert entry == 2
    assert table.holder_pids() == [os.getpid()] * 2
    table.release(entry)
    assert table.holder_pids() == [os.getpid()]


def test_a_table_of_living_holders_is_full() -> None:
    table = PinTable(words_of(*[own_identity()] * COUNT), first_word=0, count=COUNT)
    with pytest.raises(NoFreePin, match=f"all 3 pins are held, by processes {os.getpid()}"):
        table.claim()


@pytest.mark.parametrize("kind", [PinTable, OthersReap])
def test_entries_of_the_dead_are_free_whoever_frees_them(kind: type[PinTable]) -> None:
    table = kind(words_of(own_identity(), DEAD, own_identity()), first_word=0, count=COUNT)
    assert table.claim() == 2

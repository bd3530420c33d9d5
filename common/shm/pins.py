"""The table by which readers keep a writer from reusing what they look at (docs/protocol-shm.md, section 3)."""

from vtslam.common.shm._atomics import Words
from vtslam.common.shm.errors import NoFreePin
from vtslam.common.shm.process_identity import is_alive, own_identity, pid_of


class PinTable:
    """Entries of (identity of the holder, pinned value); identity 0 is free.

    Args:
        words: Words of the control page.
        first_word: Where the table starts.
        count: Number of entries.
    """

    def __init__(self, words: Words, *, first_word: int, count: int) -> None:
        self._words = words
        self._entries = range(first_word, first_word + 2 * count, 2)

    def __len__(self) -> int:
        return len(self._entries)

    def claim(self) -> int:
        """An entry for this process; raises NoFreePin if living processes hold all of them."""
        while True:
            for entry in self._entries:
                if self._words.compare_exchange(entry, 0, own_identity()):
                    return entry
            # Others reap and release meanwhile: the table is full only if it still is when nobody in it is dead.
            if not self.reap() and len(holders := self.holder_pids()) == len(self):
                raise NoFreePin(f"all {len(self)} pins are held, by processes {', '.join(map(str, holders))}")

    def pin(self, entry: int, value: int) -> None:
        """Pin ``value`` with a claimed entry."""
        self._words.store(entry + 1, value)

    def release(self, entry: int) -> None:
        """Give a claimed entry back."""
        self._words.store(entry, 0)

    def values(self) -> set[int]:
        """All pinned values, also those of dead holders that were not reaped yet."""
        return {self._words.load(entry + 1) for entry in self._entries if self._words.load(entry)}

    def reap(self) -> int:
        """Free the entries of dead processes; how many."""
        freed = 0
        for entry in self._entries:
            identity = self._words.load(entry)
            if identity and not is_alive(identity):
                freed += self._words.compare_exchange(entry, identity, 0)
        return freed

    def holder_pids(self) -> list[int]:
        """Pids of the holders, one per entry."""
        identities = (self._words.load(entry) for entry in self._entries)
        return [pid_of(identity) for identity in identities if identity]


class Pin:
    """A claimed entry until :meth:`release`.

    Attributes:
        entry: Its place in the table; -1 once released.
    """

    def __init__(self, table: PinTable, entry: int) -> None:
        self._table, self.entry = table, entry

    def release(self) -> None:
        """Give the entry back; a second time does nothing."""
        if self.entry >= 0:
            self._table.release(self.entry)
            self.entry = -1

"""Errors of shared memory; each text says what was expected and what was found."""


class SharedMemoryError(Exception):
    """A block cannot be made, opened, read or written as it should be."""


class SharedMemoryFull(SharedMemoryError):
    """The file system has not the space that was to be reserved.

    Attributes:
        wanted_bytes, free_bytes: See above.
    """

    def __init__(self, place: str, *, wanted_bytes: int, free_bytes: int) -> None:
        super().__init__(f"{place}: {wanted_bytes} bytes of shared memory wanted, {free_bytes} free")
        self.wanted_bytes, self.free_bytes = wanted_bytes, free_bytes


class MapStoreFull(SharedMemoryError):
    """The map store is at its budget.

    Attributes:
        wanted_bytes, used_bytes, budget_bytes: See above.
    """

    def __init__(self, place: str, *, wanted_bytes: int, used_bytes: int, budget_bytes: int) -> None:
        super().__init__(
            f"{place}: {wanted_bytes} bytes wanted, {used_bytes} of the map store's {budget_bytes} bytes are in use"
        )
        self.wanted_bytes, self.used_bytes, self.budget_bytes = wanted_bytes, used_bytes, budget_bytes


class DamagedBlock(SharedMemoryError):
    """A file is no block of the kind and layout version that was expected, or a checksum does not fit."""


class StaleWriter(SharedMemoryError):
    """Another process has taken over the block; this one must not write any more."""


class WriterAlive(SharedMemoryError):
    """A block cannot be taken over: its writer is still alive."""


class NoFreePin(SharedMemoryError):
    """All entries of a pin table are taken by living processes."""


class FrameGone(SharedMemoryError):
    """The frame has been overwritten in the ring, or is being overwritten."""


class RingFull(SharedMemoryError):
    """No slot of the ring came free in time."""


class GenerationGone(SharedMemoryError):
    """The generation is not one of those that the active section keeps, or is not there yet."""


class SectionNotResident(SharedMemoryError):
    """The section is not in the map store."""


class SectionPinned(SharedMemoryError):
    """A section that somebody has pinned cannot leave memory."""


class FleetExists(SharedMemoryError):
    """There is already a fleet of this name."""

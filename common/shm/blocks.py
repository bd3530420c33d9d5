"""Files of shared memory: made with reserved space, mapped, and named by a control page (docs/protocol-shm.md, 3)."""

import errno
import mmap
import os
import shutil
import zlib
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from vtslam.common.shm._atomics import Words
from vtslam.common.shm.errors import DamagedBlock, SharedMemoryError, SharedMemoryFull, StaleWriter, WriterAlive
from vtslam.common.shm.pins import PinTable
from vtslam.common.shm.process_identity import is_alive, own_identity, pid_of

PAGE_BYTES = mmap.PAGESIZE
CONTROL_BYTES = PAGE_BYTES
LAYOUT_VERSION = 2
MAX_PINS = 24

_MAGIC = int.from_bytes(b"VTSLSHM1", "little")
_DESCRIPTION_AT = 1024
_FIRST_PIN_WORD = 16
_FIRST_HISTORY_WORD, _HISTORY = 64, 8
MAX_KEPT = _HISTORY // 2  # the word of the next number must not be that of a kept one
_W_MAGIC, _W_VERSION, _W_KIND, _W_FILE_BYTES, _W_WRITER, _W_STATE, W_COUNTER_A, W_COUNTER_B, _W_PINS, _W_DESCRIPTION = (
    range(10)
)
W_COUNTER_C = 10
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENOMEM)


class Kind(IntEnum):
    """What a block is."""

    RING = 1
    ACTIVE = 2
    SEALED = 3
    TAIL = 4


class State(NamedTuple):
    """The one word by which changes become visible.

    Attributes:
        epoch: How often the block was taken over, modulo 2^16.
        number: Generation, or sequence number; below 2^40.
        buffer: The buffer or slot that holds it; below 2^8.
    """

    epoch: int
    number: int
    buffer: int

    @property
    def word(self) -> int:
        """The packed form."""
        return self.epoch << 48 | self.number << 8 | self.buffer

    @classmethod
    def of(cls, word: int) -> "State":
        """The state in a packed word."""
        return cls(epoch=word >> 48, number=(word >> 8) & (2**40 - 1), buffer=word & 0xFF)


def aligned(size: int, alignment: int = PAGE_BYTES) -> int:
    """The first multiple of ``alignment`` at or above ``size``."""
    return -(-size // alignment) * alignment


def make_file(path: Path, size_bytes: int) -> int:
    """A descriptor of a new file of that size (mode 0600, nothing reserved yet).

    Raises:
        SharedMemoryFull: The file system allows no file of that size.
        SharedMemoryError: It refuses otherwise, as when the file exists.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise refusal_of(path, error, size_bytes) from error
    try:
        os.ftruncate(fd, size_bytes)
    except OSError as error:
        os.close(fd)
        path.unlink()
        raise refusal_of(path, error, size_bytes) from error
    return fd


def open_file(path: Path, *, writable: bool) -> int:
    """A descriptor of an existing regular file; FileNotFoundError if there is none, SharedMemoryError otherwise."""
    try:
        return os.open(path, (os.O_RDWR if writable else os.O_RDONLY) | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise SharedMemoryError(f"{path}: cannot be opened: {error.strerror}") from error


def reserve(path: Path, fd: int, offset: int, length: int) -> None:
    """Reserve ``length`` bytes from ``offset`` on; raises SharedMemoryFull with nothing more reserved."""
    if length <= 0:
        return
    try:
        os.posix_fallocate(fd, offset, length)
    except OSError as error:
        raise refusal_of(path, error, length) from error


def mapped(fd: int, length: int, *, offset: int = 0, writable: bool) -> npt.NDArray[np.uint8]:
    """The bytes of a file, shared with it, uint8 [length]; the mapping goes when the last view of it does."""
    protection = mmap.PROT_READ | mmap.PROT_WRITE if writable else mmap.PROT_READ
    area = mmap.mmap(fd, length, flags=mmap.MAP_SHARED, prot=protection, offset=offset)
    return np.frombuffer(area, np.uint8)


def column(area: npt.NDArray[np.uint8], offset: int, dtype: npt.DTypeLike, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """An array within a mapped area, from byte ``offset`` on."""
    kind = np.dtype(dtype)
    length = int(np.prod(shape, dtype=np.int64)) * kind.itemsize
    assert offset + length <= area.size, "a column lies within its area"
    return area[offset : offset + length].view(kind).reshape(shape)


def used_bytes(path: Path | str) -> int:
    """Bytes reserved by a file; 0 if it is gone."""
    try:
        return os.lstat(path).st_blocks * 512
    except FileNotFoundError:
        return 0


def refusal_of(path: Path, error: OSError, wanted_bytes: int) -> SharedMemoryError:
    """What an error of the file system comes to; SharedMemoryFull if it has no space."""
    if error.errno in _NO_SPACE:
        free = shutil.disk_usage(path.parent).free
        return SharedMemoryFull(str(path), wanted_bytes=wanted_bytes, free_bytes=free)
    return SharedMemoryError(f"{path}: cannot be made: {error.strerror}")


class ControlPage:
    """The first page of a block: who it is, its writer, its state, its pins.

    Attributes:
        words: All words of the page.
        pins: The pin table.
        file_bytes: Size of the block's file.
    """

    def __init__(self, path: Path, area: npt.NDArray[np.uint8]) -> None:
        self._path, self._area = path, area
        self.words = Words(area.view(np.uint64))
        self.file_bytes = self.words.load(_W_FILE_BYTES)
        self.pins = PinTable(self.words, first_word=_FIRST_PIN_WORD, count=self.words.load(_W_PINS))

    @classmethod
    def write(
        cls, path: Path, fd: int, kind: Kind, *, file_bytes: int, pins: int, description: npt.NDArray[Any]
    ) -> "ControlPage":
        """Fill the reserved first page of a new file; epoch 1, number 0, written by this process.

        Raises:
            ValueError: More pins than a page holds.
        """
        if not 1 <= pins <= MAX_PINS:
            raise ValueError(f"expected 1 to {MAX_PINS} pins, got {pins}")
        area = mapped(fd, CONTROL_BYTES, writable=True)
        packed = description.tobytes()
        assert len(packed) <= CONTROL_BYTES - _DESCRIPTION_AT
        area[_DESCRIPTION_AT : _DESCRIPTION_AT + len(packed)] = np.frombuffer(packed, np.uint8)
        words = Words(area.view(np.uint64))
        for word, value in (
            (_W_MAGIC, _MAGIC),
            (_W_VERSION, LAYOUT_VERSION),
            (_W_KIND, kind),
            (_W_FILE_BYTES, file_bytes),
            (_W_WRITER, own_identity()),
            (_W_STATE, State(epoch=1, number=0, buffer=0).word),
            (_W_PINS, pins),
            (_W_DESCRIPTION, len(packed) | zlib.crc32(packed) << 32),
        ):
            words.store(word, value)
        return cls(path, area)

    @classmethod
    def open(cls, path: Path, fd: int, kind: Kind) -> "ControlPage":
        """The control page of a file; raises DamagedBlock if it is not of that kind and layout version."""
        size = os.fstat(fd).st_size
        if size < CONTROL_BYTES:
            raise DamagedBlock(f"{path}: expected at least {CONTROL_BYTES} bytes, found {size}")
        area = mapped(fd, CONTROL_BYTES, writable=True)
        words = Words(area.view(np.uint64))
        for word, expected, what in (
            (_W_MAGIC, _MAGIC, "magic"),
            (_W_VERSION, LAYOUT_VERSION, "layout version"),
            (_W_KIND, int(kind), "kind"),
            (_W_FILE_BYTES, size, "size"),
        ):
            if words.load(word) != expected:
                raise DamagedBlock(f"{path}: {what}: expected {expected}, found {words.load(word)}")
        if not 1 <= words.load(_W_PINS) <= MAX_PINS:
            raise DamagedBlock(f"{path}: expected 1 to {MAX_PINS} pins, found {words.load(_W_PINS)}")
        return cls(path, area)

    def description(self, dtype: np.dtype[Any]) -> Any:  # noqa: ANN401
        """The description, one record of ``dtype``; raises DamagedBlock if size or checksum do not fit."""
        packed = self._area[_DESCRIPTION_AT : _DESCRIPTION_AT + dtype.itemsize].tobytes()
        found = len(packed) | zlib.crc32(packed) << 32
        if self.words.load(_W_DESCRIPTION) != found:
            raise DamagedBlock(f"{self._path}: the description of the block is damaged")
        return np.frombuffer(packed, dtype)[0]

    @property
    def state(self) -> State:
        """The state now."""
        return State.of(self.words.load(_W_STATE))

    @property
    def writer(self) -> int:
        """Identity of the writer."""
        return self.words.load(_W_WRITER)

    def publish(self, former: State, new: State) -> None:
        """Replace the state; raises StaleWriter if it is not ``former`` any more."""
        if not self.words.compare_exchange(_W_STATE, former.word, new.word):
            raise StaleWriter(f"{self._path}: taken over by process {pid_of(self.writer)} in epoch {self.state.epoch}")

    def remember(self, state: State) -> None:
        """Note where a number is before it is published, for readers that want just that one."""
        self.words.store(_FIRST_HISTORY_WORD + state.number % _HISTORY, state.word)

    def remembered(self, number: int) -> State | None:
        """Where a number is or was; None if that is not known any more."""
        state = State.of(self.words.load(_FIRST_HISTORY_WORD + number % _HISTORY))
        return state if number and state.number == number else None

    def kept_buffers(self, number: int, kept: int) -> set[int]:
        """Buffers of ``number`` and of those before it, ``kept`` in all."""
        states = (self.remembered(n) for n in range(max(number - kept, 0) + 1, number + 1))
        return {state.buffer for state in states if state}

    def take_over(self) -> State:
        """Become the writer: the state afterwards, with the next epoch.

        Raises:
            WriterAlive: The writer is another living process, or one took over at the same moment.
        """
        former = self.writer
        if former != own_identity() and (
            is_alive(former) or not self.words.compare_exchange(_W_WRITER, former, own_identity())
        ):
            raise WriterAlive(f"{self._path}: still written by process {pid_of(self.writer)}")
        state = self.state
        new = state._replace(epoch=(state.epoch + 1) % 2**16)
        self.publish(state, new)
        return new

    def pin_state(self, entry: int) -> State:
        """Pin the state as it is now with a claimed entry of the pin table; returns it."""
        while True:  # ends: the writer changes the state between two looks only by a whole publish in between
            state = self.state
            self.pins.pin(entry, state.word)
            if self.state == state:
                return state

    def pin_number(self, entry: int, number: int, kept: int) -> State | None:
        """Pin one number with a claimed entry, if the writer still keeps it as one of ``kept``; None otherwise."""
        state = self.remembered(number)
        if state is None:
            return None
        self.pins.pin(entry, state.word)
        # Still kept now: whoever frees it later looks through the pins after this one was stored.
        return state if 0 <= self.state.number - number < kept else None

    def pinned_buffers(self) -> set[int]:
        """Buffers that living or dead processes have pinned."""
        return {State.of(word).buffer for word in self.pins.values()}

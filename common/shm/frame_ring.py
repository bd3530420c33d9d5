"""The frame ring: one sensor writes frames, others read or pin them (docs/protocol-shm.md, section 4)."""

import contextlib
import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vtslam.common import failpoints
from vtslam.common.frame import Frame
from vtslam.common.shm._atomics import fence
from vtslam.common.shm.blocks import (
    W_COUNTER_A,
    W_COUNTER_B,
    W_COUNTER_C,
    ControlPage,
    Kind,
    State,
    make_file,
    open_file,
    reserve,
)
from vtslam.common.shm.errors import FrameGone, RingFull, SharedMemoryError
from vtslam.common.shm.pins import Pin
from vtslam.common.shm.process_identity import is_alive, own_identity
from vtslam.common.shm.ring_layout import DESCRIPTION, FrameDescriptor, RingArea, RingSpec

_W_ACKNOWLEDGED, _W_LOST, _W_RECORDED = W_COUNTER_A, W_COUNTER_B, W_COUNTER_C
_HEX = re.compile("[0-9a-f]{1,16}")
_POLL_S = 0.0005


class _Ring:
    """What writer and readers share."""

    def __init__(self, path: Path, *, writable: bool) -> None:
        try:
            fd = open_file(path, writable=True)
        except FileNotFoundError as error:
            raise SharedMemoryError(f"{path}: expected a frame ring, found nothing") from error
        try:
            self._control = ControlPage.open(path, fd, Kind.RING)
            self._area = RingArea(path, fd, self._control, writable=writable)
        finally:
            os.close(fd)
        self.path = path

    @property
    def spec(self) -> RingSpec:
        """Size of the ring."""
        return self._area.spec

    @property
    def published(self) -> int:
        """Sequence number of the newest frame; 0 before the first."""
        return self._control.state.number

    @property
    def acknowledged(self) -> int:
        """All frames up to this sequence number are done with."""
        return self._control.words.load(_W_ACKNOWLEDGED)

    @property
    def lost(self) -> int:
        """Frames that were overwritten before they were acknowledged."""
        return self._control.words.load(_W_LOST)

    @property
    def recorded(self) -> int | None:
        """All frames up to this sequence number are recorded; None if lockstep does not wait for a recorder."""
        word = self._control.words.load(_W_RECORDED)
        return word - 1 if word else None

    def acknowledge(self, sequence: int) -> None:
        """Say that all frames up to ``sequence`` are done with; an older number changes nothing.

        Raises:
            ValueError: No such frame was published.
        """
        self._raise_word(_W_ACKNOWLEDGED, sequence, sequence)

    def record(self, sequence: int) -> None:
        """Say that all frames up to ``sequence`` are recorded, if anybody waits for that; raises as `acknowledge`."""
        if self.recorded is not None:
            self._raise_word(_W_RECORDED, sequence, sequence + 1)

    def _raise_word(self, word: int, sequence: int, value: int) -> None:
        if sequence > self.published:
            raise ValueError(f"{self.path}: frame {sequence} was never published, the newest is {self.published}")
        while (former := self._control.words.load(word)) < value:
            if self._control.words.compare_exchange(word, former, value):
                return

    def unacknowledged(self) -> list[FrameDescriptor]:
        """Frames that are in the ring and not done with, oldest first."""
        return self.after(self.acknowledged)

    def after(self, sequence: int) -> list[FrameDescriptor]:
        """Frames that are in the ring and newer than ``sequence``, oldest first."""
        low, high = sequence, self.published
        states = ((self._area.slot_state(slot), slot) for slot in range(self.spec.slots))
        return [
            FrameDescriptor(slot=slot, sequence=state >> 1)
            for state, slot in sorted(states)
            if not state & 1 and low < state >> 1 <= high
        ]


class FrameRingWriter(_Ring):
    """The one writer of a ring; made by :meth:`create` or :meth:`adopt`."""

    def __init__(self, path: Path, state: State | None = None) -> None:
        super().__init__(path, writable=True)
        self._state = state or self._control.state

    @classmethod
    def create(
        cls, path: Path, spec: RingSpec, *, acknowledged: int = 0, is_recorded: bool = False
    ) -> "FrameRingWriter":
        """Make a ring with all its memory reserved.

        Args:
            path: Where.
            spec: Its size.
            acknowledged: Frames before its first one, which are done with.
            is_recorded: In lockstep, frames stay until :meth:`record` was said of them.

        Raises:
            SharedMemoryFull: There is not enough.
            SharedMemoryError: ``path`` exists, or cannot be made.
        """
        if path.exists():
            raise SharedMemoryError(f"{path}: expected nothing, found a file")
        _remove_unfinished(path)
        new = path.with_name(f".new-{own_identity():x}-{path.name}")
        fd = make_file(new, spec.file_bytes)
        try:
            reserve(new, fd, 0, spec.file_bytes)
            sizes = np.array([(spec.width, spec.height, spec.slots, spec.pins)], DESCRIPTION)
            control = ControlPage.write(
                new, fd, Kind.RING, file_bytes=spec.file_bytes, pins=spec.pins, description=sizes
            )
            if acknowledged:
                control.publish(control.state, State(epoch=1, number=acknowledged, buffer=0))
                control.words.store(_W_ACKNOWLEDGED, acknowledged)
            control.words.store(_W_RECORDED, acknowledged + 1 if is_recorded else 0)
            new.rename(path)
        except BaseException:
            new.unlink(missing_ok=True)
            raise
        finally:
            os.close(fd)
        return cls(path)

    @classmethod
    def adopt(cls, path: Path) -> "FrameRingWriter":
        """Go on with the ring of a writer that died; frames that were half written are gone.

        Raises:
            WriterAlive: It did not die.
            SharedMemoryError: There is no ring, or it is damaged.
        """
        ring = cls(path)
        failpoints.reach("shm.adopt.before_epoch")
        ring._state = ring._control.take_over()
        failpoints.reach("shm.adopt.after_epoch")
        for slot in range(ring.spec.slots):
            state = ring._area.slot_state(slot)
            if state & 1 or state >> 1 > ring._state.number:
                ring._area.set_slot_state(slot, 0)
        return ring

    def try_publish(self, frame: Frame, *, credit: int) -> FrameDescriptor | None:
        """Publish unless ``credit`` frames are unacknowledged, or all slots hold frames that are not recorded.

        None then, and nothing has changed.

        Raises:
            ValueError: The frame has another size than the ring, or slots cannot hold pins and credit.
            StaleWriter: The ring was taken over.
        """
        if not 1 <= credit <= self.spec.slots - self.spec.pins:
            raise ValueError(f"{self.path}: expected a credit of 1 to {self.spec.slots - self.spec.pins}, got {credit}")
        acknowledged = self.acknowledged
        if self._state.number - acknowledged >= credit:
            return None
        recorded = self.recorded
        done = acknowledged if recorded is None else min(acknowledged, recorded)
        return self._published(frame, oldest_kept=done + 1)

    def publish_waiting(self, frame: Frame, *, credit: int, timeout_s: float) -> FrameDescriptor:
        """Publish without overwriting what was not acknowledged, as lockstep does; waits for it.

        Raises:
            RingFull: That took longer than ``timeout_s``.
            ValueError, StaleWriter: As :meth:`try_publish`.
        """
        deadline = time.monotonic() + timeout_s
        while (done := self.try_publish(frame, credit=credit)) is None:
            if time.monotonic() >= deadline:
                raise RingFull(
                    f"{self.path}: frames {self.acknowledged + 1} to {self.published} were not acknowledged "
                    f"within {timeout_s} s"
                )
            time.sleep(_POLL_S)
        return done

    def publish_newest(self, frame: Frame) -> FrameDescriptor:
        """Publish at once over the oldest frame that nobody has pinned, as realtime does.

        Raises:
            ValueError: The frame has another size than the ring.
            StaleWriter: The ring was taken over.
        """
        done = None
        while done is None:  # ends: fewer pins than slots, and each failure took a new pin
            done = self._published(frame, oldest_kept=None)
        return done

    def _published(self, frame: Frame, *, oldest_kept: int | None) -> FrameDescriptor | None:
        camera, spec = frame.camera, self.spec
        if (camera.width, camera.height) != (spec.width, spec.height):
            raise ValueError(f"{self.path}: expected {spec.width}x{spec.height}, got {camera.width}x{camera.height}")
        new = State(epoch=self._state.epoch, number=self._state.number + 1, buffer=0)
        slot = self._claimed_slot(new.number, oldest_kept)
        if slot is None:
            return None
        new = new._replace(buffer=slot)
        failpoints.reach("shm.ring.after_claim")
        self._area.rgb(slot)[:] = frame.rgb
        failpoints.reach("shm.ring.after_color")
        self._area.depth(slot)[:] = frame.depth
        failpoints.reach("shm.ring.after_pixels")
        self._area.write_facts(slot, frame)
        failpoints.reach("shm.ring.after_words")
        self._area.set_slot_state(slot, 2 * new.number)
        failpoints.reach("shm.ring.before_publish")
        self._control.publish(self._state, new)
        failpoints.reach("shm.ring.after_publish")
        self._state = new
        return FrameDescriptor(slot=slot, sequence=new.number)

    def _claimed_slot(self, sequence: int, oldest_kept: int | None) -> int | None:
        """A slot marked as being written, which nobody has pinned; holding a frame before ``oldest_kept``, if given."""
        order = sorted((self._area.slot_state(slot), slot) for slot in range(self.spec.slots))
        failpoints.reach("shm.ring.before_claim")
        for former, slot in order:
            if oldest_kept is not None and former >> 1 >= oldest_kept:
                return None
            if slot in self._control.pinned_buffers():
                continue
            self._area.set_slot_state(slot, 2 * sequence + 1)
            # Plain pixels must not become visible before the mark.
            fence()
            if slot in self._control.pinned_buffers():
                self._area.set_slot_state(slot, former)
                continue
            if former >> 1 > self.acknowledged:
                self._control.words.fetch_add(_W_LOST, 1)
            return slot
        return None


def _remove_unfinished(path: Path) -> None:
    """Give back what writers reserved that died before their ring was there."""
    for left in path.parent.glob(f".new-*-{path.name}"):
        maker = left.name.removeprefix(".new-").removesuffix(f"-{path.name}")
        if _HEX.fullmatch(maker) and not is_alive(int(maker, 16)):
            left.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PinnedFrame:
    """A frame whose images are the ring's own, read-only, until :meth:`release`; not to be used afterwards."""

    frame: Frame
    pin: Pin

    def release(self) -> None:
        """Let the writer have the slot again."""
        self.pin.release()


class FrameRingReader(_Ring):
    """A reader of the ring at ``path``; there may be many."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, writable=False)

    def newest(self) -> FrameDescriptor | None:
        """The newest frame; None before the first."""
        state = self._control.state
        return FrameDescriptor(slot=state.buffer, sequence=state.number) if state.number else None

    def pinned(self, descriptor: FrameDescriptor) -> PinnedFrame:
        """The frame in place; release it as soon as possible.

        Raises:
            FrameGone: It was overwritten.
            NoFreePin: Too many frames are pinned; copying needs no pin.
        """
        self._check(descriptor)
        pins = self._control.pins
        entry = pins.claim()
        pins.pin(entry, State(epoch=0, number=descriptor.sequence, buffer=descriptor.slot).word)
        pin = Pin(pins, entry)
        try:
            self._require(descriptor)
            return PinnedFrame(frame=self._frame(descriptor.slot), pin=pin)
        except BaseException:
            pin.release()
            raise

    @contextlib.contextmanager
    def using(self, descriptor: FrameDescriptor) -> Iterator[Frame]:
        """The frame in place for the length of a ``with`` block; raises as :meth:`pinned`."""
        held = self.pinned(descriptor)
        try:
            yield held.frame
        finally:
            held.release()

    def copied(self, descriptor: FrameDescriptor) -> Frame:
        """A copy of the frame; raises FrameGone if it was overwritten, also in the middle of the copy."""
        self._check(descriptor)
        self._require(descriptor)
        slot = descriptor.slot
        rgb, depth = self._area.rgb(slot).copy(), self._area.depth(slot).copy()
        facts = self._area.facts(slot)
        fence()
        self._require(descriptor)
        return Frame(rgb=rgb, depth=depth, **facts.of_frame())

    def _frame(self, slot: int) -> Frame:
        return Frame(rgb=self._area.rgb(slot), depth=self._area.depth(slot), **self._area.facts(slot).of_frame())

    def _check(self, descriptor: FrameDescriptor) -> None:
        if not (0 <= descriptor.slot < self.spec.slots and 1 <= descriptor.sequence < 2**40):
            raise FrameGone(f"{self.path}: there is no slot {descriptor.slot} or no frame {descriptor.sequence}")

    def _require(self, descriptor: FrameDescriptor) -> None:
        if self._area.slot_state(descriptor.slot) != 2 * descriptor.sequence:
            raise self._gone(descriptor)

    def _gone(self, descriptor: FrameDescriptor) -> FrameGone:
        return FrameGone(f"{self.path}: frame {descriptor.sequence} was overwritten in slot {descriptor.slot}")

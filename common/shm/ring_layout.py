"""Where things lie in a frame ring (docs/protocol-shm.md, section 4)."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.external_pose import ExternalPose
from vtslam.common.frame import Frame
from vtslam.common.geometry.camera import Camera
from vtslam.common.shm._atomics import Words
from vtslam.common.shm.blocks import CONTROL_BYTES, MAX_PINS, PAGE_BYTES, ControlPage, aligned, column, mapped

DESCRIPTION = np.dtype([("width", "<u4"), ("height", "<u4"), ("slots", "<u4"), ("pins", "<u4")])
MAX_SLOTS = 256
_WORDS_PER_SLOT = 64
_FACTS, _PRIOR = slice(1, 9), slice(9, 61)  # words of a slot after the first; the last of the facts: has a prior
_FACTS_FORMAT, _PRIOR_FORMAT = struct.Struct("<qq5dQ"), struct.Struct("<52d")


@dataclass(frozen=True, slots=True, kw_only=True)
class RingSpec:
    """Size of a frame ring.

    Attributes:
        width, height: Of every frame, pixels.
        slots: Frames it holds, at most 256.
        pins: Frames that may be pinned at a time, at most 24; less than ``slots``, so that a slot can always go.

    Raises:
        ValueError: A size is out of range.
    """

    width: int
    height: int
    slots: int = 8
    pins: int = 6

    def __post_init__(self) -> None:
        if not (1 <= self.width <= 65536 and 1 <= self.height <= 65536):
            raise ValueError(f"ring: expected images of 1 to 65536 pixels a side, got {self.width}x{self.height}")
        if not 1 <= self.pins <= MAX_PINS or not self.pins < self.slots <= MAX_SLOTS:
            raise ValueError(
                f"ring: expected 1 to {MAX_PINS} pins and more slots than pins, up to {MAX_SLOTS}; "
                f"got {self.pins} pins, {self.slots} slots"
            )

    @property
    def depth_offset(self) -> int:
        """Where depth starts within a slot."""
        return aligned(3 * self.width * self.height, 64)

    @property
    def slot_bytes(self) -> int:
        """Bytes from one slot to the next."""
        return aligned(self.depth_offset + 2 * self.width * self.height)

    @property
    def data_offset(self) -> int:
        """Where the first slot starts in the file."""
        return CONTROL_BYTES + aligned(8 * _WORDS_PER_SLOT * self.slots)

    @property
    def file_bytes(self) -> int:
        """Size of the whole ring."""
        return self.data_offset + self.slots * self.slot_bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameDescriptor:
    """Where a frame is in the ring: its slot and its sequence number, from 1."""

    slot: int
    sequence: int


class RingArea:
    """A mapped ring: slot words, and images of the slots as arrays.

    Args:
        path: The file, for messages.
        fd: Its descriptor.
        control: Its control page.
        writable: Map the images for writing.
    """

    def __init__(self, path: Path, fd: int, control: ControlPage, *, writable: bool) -> None:
        found = control.description(DESCRIPTION)
        self.spec = RingSpec(**{name: int(found[name]) for name in DESCRIPTION.names or ()})
        assert self.spec.file_bytes == control.file_bytes
        words_bytes = self.spec.data_offset - CONTROL_BYTES
        self._words = Words(mapped(fd, words_bytes, offset=PAGE_BYTES, writable=True).view(np.uint64))
        length = self.spec.file_bytes - self.spec.data_offset
        self._data = mapped(fd, length, offset=self.spec.data_offset, writable=writable)

    def slot_state(self, slot: int) -> int:
        """Slot word 0: twice the sequence number, and 1 more while it is written; 0 if empty."""
        return self._words.load(slot * _WORDS_PER_SLOT)

    def set_slot_state(self, slot: int, value: int) -> None:
        """Store slot word 0."""
        self._words.store(slot * _WORDS_PER_SLOT, value)

    def rgb(self, slot: int) -> npt.NDArray[np.uint8]:
        """Colour of a slot, uint8 [H,W,3]."""
        return column(self._data, slot * self.spec.slot_bytes, np.uint8, (self.spec.height, self.spec.width, 3))

    def depth(self, slot: int) -> npt.NDArray[np.uint16]:
        """Depth of a slot, uint16 [H,W]."""
        offset = slot * self.spec.slot_bytes + self.spec.depth_offset
        return column(self._data, offset, np.uint16, (self.spec.height, self.spec.width))

    def write_facts(self, slot: int, frame: Frame) -> None:
        """Store slot words 1 to 60."""
        camera, prior = frame.camera, frame.pose_prior
        reals = (frame.depth_scale_m, camera.fx, camera.fy, camera.cx, camera.cy)
        packed = _FACTS_FORMAT.pack(frame.frame_id, frame.capture_time_ns, *reals, prior is not None)
        self._store(slot, _FACTS, packed)
        if prior is not None:
            self._store(slot, _PRIOR, _PRIOR_FORMAT.pack(*prior.T_world_camera.ravel(), *prior.covariance.ravel()))

    def facts(self, slot: int) -> "SlotFacts":
        """Slot words 1 to 60, not looked at yet: they may be half written."""
        return SlotFacts(self.spec, self._load(slot, _FACTS), self._load(slot, _PRIOR))

    def _store(self, slot: int, words: slice, packed: bytes) -> None:
        for index, word in enumerate(struct.unpack(f"<{len(packed) // 8}Q", packed), start=words.start):
            self._words.store(slot * _WORDS_PER_SLOT + index, word)

    def _load(self, slot: int, words: slice) -> bytes:
        indices = range(words.start, words.stop)
        return struct.pack(f"<{len(indices)}Q", *(self._words.load(slot * _WORDS_PER_SLOT + i) for i in indices))


@dataclass(frozen=True, slots=True)
class SlotFacts:
    """What a frame in a slot is besides its images, as it was read."""

    spec: RingSpec
    packed: bytes
    packed_prior: bytes

    def of_frame(self) -> dict[str, Any]:
        """By the names of `Frame`; only once it is certain that nobody wrote meanwhile."""
        frame_id, time_ns, scale, fx, fy, cx, cy, has_prior = _FACTS_FORMAT.unpack(self.packed)
        camera = Camera(width=self.spec.width, height=self.spec.height, fx=fx, fy=fy, cx=cx, cy=cy)
        prior = None
        if has_prior:
            reals = np.array(_PRIOR_FORMAT.unpack(self.packed_prior))
            prior = ExternalPose(T_world_camera=reals[:16].reshape(4, 4), covariance=reals[16:].reshape(6, 6))
        facts = {"frame_id": frame_id, "capture_time_ns": time_ns, "depth_scale_m": scale}
        return {**facts, "camera": camera, "pose_prior": prior}

"""What a commit in the map store holds beside the section: all else that tracker and mapper carry between frames."""

import json
import zlib
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.frame import Frame
from vtslam.common.messages import TrackerHistory
from vtslam.services.frame_facts import CommittedFrame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommitFacts:
    """The stream up to one committed frame.

    Attributes:
        num_frames: Frames committed, this one included.
        num_tracked: Frames tracked when this one was, itself included; in realtime more than are committed.
        sequence: The frame's number in the frame ring.
        iterations: Optimiser steps spent on it.
        frame: The frame.
        T_world_previous: float64 [4,4], the committed pose before it; None for the first frame.
        history: What the tracker remembers.
        pixels_crc32: `pixels_crc32` of the frame.
    """

    num_frames: int
    num_tracked: int
    sequence: int
    iterations: int
    frame: CommittedFrame
    T_world_previous: npt.NDArray[np.float64] | None
    history: TrackerHistory
    pixels_crc32: int

    def saw(self, frame: Frame) -> bool:
        """Whether ``frame`` has the pixels of the one that was committed."""
        return pixels_crc32(frame) == self.pixels_crc32

    @property
    def committed_poses(self) -> tuple[npt.NDArray[np.float64], ...]:
        """The last two committed poses float64 [4,4], older first; one after the first frame."""
        last = self.frame.T_world_camera
        return (last,) if self.T_world_previous is None else (self.T_world_previous, last)

    @property
    def exposure(self) -> Exposure:
        """The frame's exposure."""
        facts = self.frame.facts
        return Exposure(
            gain=np.array(facts.exposure_gain, np.float32), offset=np.array(facts.exposure_offset, np.float32)
        )

    def with_seal(self, *, gaussians: int, renders: int, seconds: float) -> "CommitFacts":
        """The facts with the end of the section that the frame was the last of."""
        facts = self.frame.facts.with_seal(gaussians=gaussians, renders=renders, seconds=seconds)
        return replace(self, frame=replace(self.frame, facts=facts))

    def packed(self) -> bytes:
        """As the map store keeps it; every number comes back exactly."""
        before = None if self.T_world_previous is None else self.T_world_previous.tolist()
        plain = {
            "num_frames": self.num_frames,
            "num_tracked": self.num_tracked,
            "sequence": self.sequence,
            "iterations": self.iterations,
            "frame": self.frame.as_plain(),
            "T_world_previous": before,
            "history": asdict(self.history),
            "pixels_crc32": self.pixels_crc32,
        }
        return json.dumps(plain).encode()

    @classmethod
    def unpacked(cls, data: bytes) -> "CommitFacts":
        """The facts of :meth:`packed`'s bytes."""
        plain = json.loads(data)
        before = plain["T_world_previous"]
        return cls(
            num_frames=plain["num_frames"],
            num_tracked=plain["num_tracked"],
            sequence=plain["sequence"],
            iterations=plain["iterations"],
            frame=CommittedFrame.from_plain(plain["frame"]),
            T_world_previous=None if before is None else np.array(before, np.float64),
            history=_history_of(plain["history"]),
            pixels_crc32=plain["pixels_crc32"],
        )


def _history_of(plain: dict[str, Any]) -> TrackerHistory:
    """The history of a JSON object; of an earlier version's it lacks what has a default."""
    values: dict[str, Any] = {k: tuple(value) if isinstance(value, list) else value for k, value in plain.items()}
    return TrackerHistory(**values)


def pixels_crc32(frame: Frame) -> int:
    """A checksum of a frame's colour and depth."""
    return zlib.crc32(np.ascontiguousarray(frame.depth).data, zlib.crc32(np.ascontiguousarray(frame.rgb).data))

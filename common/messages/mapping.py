"""Messages of tracker, mapper and archiver: poses, commits, sections."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, ClassVar

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure
from vtslam.common.messages.base import (
    EXPOSURE,
    Count,
    Measure,
    Message,
    Name,
    NonNegative,
    Note,
    OptionalId,
    Pose,
    Sha256,
    Switch,
)
from vtslam.common.messages.rules import COVARIANCE, Choice, Fields, Flag, Integer, Maybe, Numbers, Real, Series
from vtslam.common.messages.rules import MAX_INT as _MAX
from vtslam.common.tracking_facts import TrackingQuality, TrackingState

_Covariance = Annotated[npt.NDArray[np.float64], COVARIANCE]


_QUALITY = Fields(
    TrackingQuality,
    {
        "color_loss": Real(0.0),
        "depth_loss_m": Real(0.0),
        "covered_share": Real(0.0, 1.0),
        "renders": Integer(0, _MAX),
        "section_id": Integer(-1, _MAX),
        "rescued": Flag(),
    },
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerHistory:
    """What a tracker remembers of the frames so far; it is committed with the frame, so that it outlives the tracker.

    Attributes:
        color_losses, depth_losses_m: Losses of past frames, newest last, as many of one as of the other.
        largest_mean_depths_m: The largest mean depths of frames, descending.
        ignores_priors: Whether the first frame came without a pose, so that those of later ones are of another world.

    Raises:
        ValueError: There are more losses of one kind than of the other.
    """

    color_losses: tuple[float, ...] = ()
    depth_losses_m: tuple[float, ...] = ()
    largest_mean_depths_m: tuple[float, ...] = ()
    ignores_priors: bool = False

    def __post_init__(self) -> None:
        if len(self.color_losses) != len(self.depth_losses_m):
            raise ValueError(f"{len(self.color_losses)} losses of colour, {len(self.depth_losses_m)} of depth")


MAX_LOSSES = 200  # remembered
MAX_MEAN_DEPTHS = 30
_HISTORY = Fields(
    TrackerHistory,
    {
        "color_losses": Series(MAX_LOSSES),
        "depth_losses_m": Series(MAX_LOSSES),
        "largest_mean_depths_m": Series(MAX_MEAN_DEPTHS),
        "ignores_priors": Flag(),
    },
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedPose(Message):
    """The pose that the tracker proposes for a frame.

    Attributes:
        frame_id, capture_time_ns, slot, slot_sequence: The frame, as in its descriptor.
        section_id: The section that it shall belong to.
        generation: Of the map that it was tracked against.
        epoch: Of the tracker.
        T_world_camera: float64 [4,4].
        covariance: float64 [6,6] of a left twist on ``T_camera_world`` (translation m, rotation rad).
        quality: What it rests on; None for a pose that was not tracked (the first frame's).
        state: Whether to trust it.
        overlap_section_id: For heads, the section it was tracked against; -1 otherwise.
        history: What the tracker remembers once the frame is committed.
        num_tracked: Frames tracked so far, this one included; in realtime fewer than were published.
        read_s, track_s: Seconds that reading the frame from its source and tracking it took.
    """

    KIND: ClassVar[str] = "tracked_pose"
    VERSION: ClassVar[int] = 3

    frame_id: Count
    capture_time_ns: Count
    slot: Count
    slot_sequence: Count
    section_id: Count
    generation: Count
    epoch: Count
    T_world_camera: Pose
    covariance: _Covariance
    quality: Annotated[TrackingQuality | None, Maybe(_QUALITY)]
    state: Annotated[TrackingState, Choice(TrackingState)]
    overlap_section_id: OptionalId
    history: Annotated[TrackerHistory, _HISTORY] = field(default_factory=TrackerHistory)
    num_tracked: Count = 0
    read_s: NonNegative = 0.0
    track_s: NonNegative = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Odometry(Message):
    """What a robot reads: where the camera is, how it moves, and how sure that is.

    Attributes:
        frame_id, capture_time_ns: The frame it was estimated from.
        T_world_camera: float64 [4,4]; camera axes are x right, y down, z forward.
        velocity_camera: float64 [6], camera axes: linear m/s, angular rad/s.
        pose_covariance: float64 [6,6] of a left twist on ``T_camera_world`` (translation m, rotation rad).
        velocity_covariance: float64 [6,6] of `velocity_camera`.
        state: Whether to trust it.
        epoch: Of the tracker.
    """

    KIND: ClassVar[str] = "odometry"
    VERSION: ClassVar[int] = 1

    frame_id: Count
    capture_time_ns: Count
    T_world_camera: Pose
    velocity_camera: Annotated[npt.NDArray[np.float64], Numbers((6,))]
    pose_covariance: _Covariance
    velocity_covariance: _Covariance
    state: Annotated[TrackingState, Choice(TrackingState)]
    epoch: Count


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameCommitted(Message):
    """A frame's pose and map changes are in the map store.

    Attributes:
        frame_id, capture_time_ns: The frame.
        section_id: Its section.
        frame_index: Its row in the section's frame table.
        T_world_camera: float64 [4,4], its committed pose.
        exposure: How the frame shows the map's colours.
        gaussians_added: New Gaussians tied to it.
        gaussians: Gaussians of the section afterwards.
        iterations: Optimiser steps spent.
        renders: Renders spent, on ending the section too if the frame did.
        loss: Eq. 2 at the last step; 0 if there was none.
        held_out: Whether the frame was kept out of mapping.
        block: The section's block in the map store.
        generation: The block's generation that holds the commit.
        epoch: Of the mapper.
    """

    KIND: ClassVar[str] = "frame_committed"
    VERSION: ClassVar[int] = 1

    frame_id: Count
    capture_time_ns: Count
    section_id: Count
    frame_index: Count
    T_world_camera: Pose
    exposure: Annotated[Exposure, EXPOSURE]
    gaussians_added: Count
    gaussians: Count
    iterations: Count
    renders: Count
    loss: Measure
    held_out: Switch
    block: Name
    generation: Count
    epoch: Count


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionSealed(Message):
    """A section is finished; its payload never changes again.

    Attributes:
        section_id: The section.
        block, generation: Where it lies in the map store.
        first_frame_id, frames: The frames it holds.
        gaussians: Their Gaussians.
        bytes_held: Memory of the block.
        renders: Spent on sealing.
        epoch: Of the mapper.
    """

    KIND: ClassVar[str] = "section_sealed"
    VERSION: ClassVar[int] = 1

    section_id: Count
    block: Name
    generation: Count
    first_frame_id: Count
    frames: Count
    gaussians: Count
    bytes_held: Count
    renders: Count
    epoch: Count


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionArchived(Message):
    """A section is on disk and was read back: it may leave memory.

    Attributes:
        section_id: The section.
        file_name: Its file in the run folder.
        file_bytes: Size of the file.
        sha256: Checksum of the file, hexadecimal.
        epoch: Of the archiver.
    """

    KIND: ClassVar[str] = "section_archived"
    VERSION: ClassVar[int] = 1

    section_id: Count
    file_name: Name
    file_bytes: Count
    sha256: Sha256
    epoch: Count


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionRequest(Message):
    """A reader needs a section in memory.

    Attributes:
        section_id: The section.
        reader: Who asks.
    """

    KIND: ClassVar[str] = "section_request"
    VERSION: ClassVar[int] = 1

    section_id: Count
    reader: Name


class LoadOutcome(StrEnum):
    """What became of a section that was asked for."""

    RESIDENT = "resident"
    UNKNOWN = "unknown"  # there is no such section
    NO_ROOM = "no_room"  # the budget is used up by sections that may not leave
    DAMAGED = "damaged"  # its file failed verification


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionReply(Message):
    """The answer to a `SectionRequest`.

    Attributes:
        section_id: The section.
        outcome: What became of it.
        block: Its block if it is resident; None otherwise.
        generation: The block's generation; 0 if there is none.
        detail: What to tell the user.
    """

    KIND: ClassVar[str] = "section_reply"
    VERSION: ClassVar[int] = 1

    section_id: Count
    outcome: Annotated[LoadOutcome, Choice(LoadOutcome)]
    block: Annotated[str | None, Maybe(Name.__metadata__[0])]
    generation: Count
    detail: Note = ""

"""What is kept of one frame of a run, and how the steps of a frame add up to it."""

from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from vtslam.common.exposure import Exposure


def untracked_state(*, is_first: bool) -> str:
    """The state of a frame that was not tracked: it defines the world, or came with its pose."""
    return "first" if is_first else "known"


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFacts:
    """What the catalogue keeps as the quality of a frame.

    Attributes:
        frame_id: Place in the stream, from 0.
        section_id: Section of the frame.
        is_head: Whether it opens its section.
        held_out: Whether it was kept out of mapping.
        state: "first", "known", "ok", "weak" or "lost".
        tracked_section_id: The section it was tracked against; -1 if none.
        rescued: Whether odometry replaced the guess.
        covered_share: Share of the pixels that tracking used.
        color_loss, depth_loss_m: Loss per pixel at the end of tracking.
        position_sigma_m, rotation_sigma_rad: Standard deviations (all axes together) by the tracker's covariance.
        exposure_gain, exposure_offset: How the frame shows the map's colours, per channel.
        map_loss: Loss at the last step of mapping.
        gaussians_added: New Gaussians.
        gaussians: Gaussians of the section afterwards.
        track_renders, map_renders: Renders spent; ending a section counts for its last frame.
        read_s, track_s, map_s, total_s: Wall-clock seconds: reading, tracking, mapping, all of it.
    """

    frame_id: int
    section_id: int
    is_head: bool
    held_out: bool
    state: str
    tracked_section_id: int
    rescued: bool
    covered_share: float
    color_loss: float
    depth_loss_m: float
    position_sigma_m: float
    rotation_sigma_rad: float
    exposure_gain: tuple[float, ...]
    exposure_offset: tuple[float, ...]
    map_loss: float
    gaussians_added: int
    gaussians: int
    track_renders: int
    map_renders: int
    read_s: float
    track_s: float
    map_s: float
    total_s: float

    def with_seal(self, *, gaussians: int, renders: int, seconds: float) -> "FrameFacts":
        """These facts with the end of the section that the frame was the last of."""
        return replace(
            self,
            gaussians=gaussians,
            map_renders=self.map_renders + renders,
            map_s=self.map_s + seconds,
            total_s=self.total_s + seconds,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommittedFrame:
    """A committed frame.

    Attributes:
        facts: What is known of it.
        capture_time_ns: Capture time.
        T_world_camera: float64 [4,4], its committed pose.
    """

    facts: FrameFacts
    capture_time_ns: int
    T_world_camera: npt.NDArray[np.float64]

    def as_plain(self) -> dict[str, Any]:
        """The frame as values that JSON keeps exactly."""
        return {
            "facts": asdict(self.facts),
            "capture_time_ns": self.capture_time_ns,
            "T_world_camera": self.T_world_camera.tolist(),
        }

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> "CommittedFrame":
        """The frame of :meth:`as_plain`'s values."""
        facts: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in plain["facts"].items()
        }
        return cls(
            facts=FrameFacts(**facts),
            capture_time_ns=plain["capture_time_ns"],
            T_world_camera=np.array(plain["T_world_camera"], np.float64),
        )


class _Quality(Protocol):
    """What a tracked pose rests on, as the tracker and its message say it."""

    @property
    def color_loss(self) -> float: ...
    @property
    def depth_loss_m(self) -> float: ...
    @property
    def covered_share(self) -> float: ...
    @property
    def renders(self) -> int: ...
    @property
    def section_id(self) -> int: ...
    @property
    def rescued(self) -> bool: ...


class _Commit(Protocol):
    """What mapping a frame changed, as the mapper says it."""

    @property
    def frame_id(self) -> int: ...
    @property
    def section_id(self) -> int: ...
    @property
    def frame_index(self) -> int: ...
    @property
    def exposure(self) -> Exposure: ...
    @property
    def gaussians_added(self) -> int: ...
    @property
    def gaussians(self) -> int: ...
    @property
    def renders(self) -> int: ...
    @property
    def loss(self) -> float: ...
    @property
    def held_out(self) -> bool: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Seconds:
    """Wall-clock seconds of one frame: reading, tracking, mapping, all of it."""

    read_s: float
    track_s: float
    map_s: float
    total_s: float


def frame_facts(
    commit: _Commit,
    quality: _Quality | None,
    covariance: npt.NDArray[np.float64],
    *,
    state: str,
    seconds: Seconds,
) -> FrameFacts:
    """The facts of a frame.

    Args:
        commit: What mapping it changed.
        quality: What its pose rests on; None if it was not tracked.
        covariance: float64 [6,6] of the pose; zeros if it was not tracked.
        state: See `FrameFacts`.
        seconds: Where the time went.
    """
    variances = np.maximum(np.diag(covariance), 0.0)
    return FrameFacts(
        frame_id=commit.frame_id,
        section_id=commit.section_id,
        is_head=commit.frame_index == 0,
        held_out=commit.held_out,
        state=state,
        tracked_section_id=-1 if quality is None else quality.section_id,
        rescued=quality is not None and quality.rescued,
        covered_share=0.0 if quality is None else quality.covered_share,
        color_loss=0.0 if quality is None else quality.color_loss,
        depth_loss_m=0.0 if quality is None else quality.depth_loss_m,
        position_sigma_m=float(np.sqrt(variances[:3].sum())),
        rotation_sigma_rad=float(np.sqrt(variances[3:].sum())),
        exposure_gain=tuple(commit.exposure.gain.tolist()),
        exposure_offset=tuple(commit.exposure.offset.tolist()),
        map_loss=commit.loss,
        gaussians_added=commit.gaussians_added,
        gaussians=commit.gaussians,
        track_renders=0 if quality is None else quality.renders,
        map_renders=commit.renders,
        read_s=seconds.read_s,
        track_s=seconds.track_s,
        map_s=seconds.map_s,
        total_s=seconds.total_s,
    )

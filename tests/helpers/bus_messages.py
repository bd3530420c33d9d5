"""Messages for tests of the bus: one of each kind, with values drawn at random."""

from collections.abc import Callable
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np

from vtslam.common.exposure import Exposure
from vtslam.common.external_pose import ExternalPose
from vtslam.common.geometry import se3
from vtslam.common.geometry.camera import Camera
from vtslam.common.messages import (
    Command,
    Control,
    Credit,
    FleetEvent,
    FrameCommitted,
    FrameCondition,
    FrameDescriptor,
    FramePixels,
    LoadOutcome,
    Message,
    Odometry,
    SectionArchived,
    SectionReply,
    SectionRequest,
    SectionSealed,
    ServiceState,
    ServiceStatus,
    TrackedPose,
    TrackerHistory,
)
from vtslam.common.tracking_facts import TrackingQuality, TrackingState

E = TypeVar("E", bound=StrEnum)

MAX_BYTES = 1 << 20


def descriptor(frame_id: int, **changes: object) -> FrameDescriptor:
    values: dict[str, Any] = {
        "frame_id": frame_id,
        "capture_time_ns": 1_000 * frame_id,
        "slot": frame_id % 8,
        "slot_sequence": frame_id // 8,
        "width": 160,
        "height": 120,
        "epoch": 1,
    }
    return FrameDescriptor(**values | changes)


def status(service: str, **changes: object) -> ServiceStatus:
    values: dict[str, Any] = {
        "service": service,
        "pid": 7,
        "epoch": 1,
        "state": ServiceState.WORKING,
        "last_frame_id": 3,
    }
    return ServiceStatus(**values | changes)


def _id(rng: np.random.Generator) -> int:
    return int(rng.integers(0, 2**63 - 1, endpoint=True) >> int(rng.integers(0, 63)))


def _one(rng: np.random.Generator, members: type[E]) -> E:
    return list(members)[int(rng.integers(len(members)))]


def _pose(rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.float64]]:
    return se3.exp(rng.normal(0.0, 2.0, 6))


def _covariance(rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.float64]]:
    a = rng.normal(0.0, 10.0 ** rng.uniform(-6, 3), (6, 6))
    return np.asarray(a @ a.T)


def _float32(rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.float32]]:
    return rng.normal(1.0, 0.2, 3).astype(np.float32)


def _descriptor(rng: np.random.Generator) -> Message:
    return descriptor(_id(rng), capture_time_ns=_id(rng), dropped_before=_id(rng), condition=_one(rng, FrameCondition))


def _pixels(rng: np.random.Generator) -> Message:
    height, width = int(rng.integers(1, 12)), int(rng.integers(1, 12))
    return FramePixels(
        stream="cam-0",
        frame_id=_id(rng),
        capture_time_ns=_id(rng) >> 1,
        depth_scale_m=float(rng.uniform(1e-4, 1.0)),
        camera=Camera(width=width, height=height, fx=120.0, fy=121.5, cx=width / 2, cy=height / 2),
        rgb=rng.integers(0, 256, (height, width, 3), np.uint8),
        depth=rng.integers(0, 65536, (height, width), np.uint16),
        pose_prior=_prior(rng) if rng.integers(2) else None,
    )


def _prior(rng: np.random.Generator) -> ExternalPose:
    return ExternalPose(T_world_camera=_pose(rng), covariance=_covariance(rng))


def _credit(rng: np.random.Generator) -> Message:
    return Credit(acknowledged_frame_id=-1, next_frame_id=_id(rng), limit_frame_id=_id(rng), epoch=_id(rng))


def _quality(rng: np.random.Generator) -> TrackingQuality:
    return TrackingQuality(
        color_loss=float(rng.uniform()),
        depth_loss_m=float(rng.uniform()),
        covered_share=float(rng.uniform()),
        renders=_id(rng),
        section_id=_id(rng),
        rescued=bool(rng.integers(2)),
    )


def tracked_pose(rng: np.random.Generator) -> TrackedPose:
    return TrackedPose(
        frame_id=_id(rng),
        capture_time_ns=_id(rng),
        slot=_id(rng),
        slot_sequence=_id(rng),
        section_id=_id(rng),
        generation=_id(rng),
        epoch=_id(rng),
        T_world_camera=_pose(rng),
        covariance=_covariance(rng),
        quality=_quality(rng) if rng.integers(2) else None,
        state=_one(rng, TrackingState),
        overlap_section_id=-1,
        history=TrackerHistory(
            color_losses=tuple(rng.uniform(size=4).tolist()),
            depth_losses_m=tuple(rng.uniform(size=4).tolist()),
            largest_mean_depths_m=tuple(rng.uniform(size=3).tolist()),
            ignores_priors=bool(rng.integers(2)),
        ),
        read_s=float(rng.uniform()),
        track_s=float(rng.uniform()),
    )


def _odometry(rng: np.random.Generator) -> Message:
    return Odometry(
        frame_id=_id(rng),
        capture_time_ns=_id(rng),
        T_world_camera=_pose(rng),
        velocity_camera=rng.normal(0.0, 1.0, 6),
        pose_covariance=_covariance(rng),
        velocity_covariance=_covariance(rng),
        state=_one(rng, TrackingState),
        epoch=_id(rng),
    )


def _committed(rng: np.random.Generator) -> Message:
    return FrameCommitted(
        frame_id=_id(rng),
        capture_time_ns=_id(rng),
        section_id=_id(rng),
        frame_index=_id(rng),
        T_world_camera=_pose(rng),
        exposure=Exposure(gain=_float32(rng), offset=_float32(rng)),
        gaussians_added=_id(rng),
        gaussians=_id(rng),
        iterations=_id(rng),
        renders=_id(rng),
        loss=float(rng.normal()),
        held_out=bool(rng.integers(2)),
        block="section-000001",
        generation=_id(rng),
        epoch=_id(rng),
    )


def _sealed(rng: np.random.Generator) -> Message:
    return SectionSealed(
        section_id=_id(rng),
        block="section-000001",
        generation=_id(rng),
        first_frame_id=_id(rng),
        frames=_id(rng),
        gaussians=_id(rng),
        bytes_held=_id(rng),
        renders=_id(rng),
        epoch=_id(rng),
    )


def _archived(rng: np.random.Generator) -> Message:
    digest = rng.bytes(32).hex()
    return SectionArchived(
        section_id=_id(rng), file_name="000001.vts", file_bytes=_id(rng), sha256=digest, epoch=_id(rng)
    )


def _request(rng: np.random.Generator) -> Message:
    return SectionRequest(section_id=_id(rng), reader="tracker")


def _reply(rng: np.random.Generator) -> Message:
    resident = bool(rng.integers(2))
    return SectionReply(
        section_id=_id(rng),
        outcome=LoadOutcome.RESIDENT if resident else LoadOutcome.NO_ROOM,
        block="section-000001" if resident else None,
        generation=_id(rng),
        detail="",
    )


def _status(rng: np.random.Generator) -> Message:
    counters = {f"frames.{i}": _id(rng) for i in range(int(rng.integers(0, 8)))}
    return status("mapper", state=_one(rng, ServiceState), counters=counters, gauges={"map_mb": float(rng.normal())})


def _event(rng: np.random.Generator) -> Message:
    return FleetEvent(service="mapper", kind="restarted", text="mapper: started again", time_ns=_id(rng))


def _control(rng: np.random.Generator) -> Message:
    return Control(command=_one(rng, Command), through_frame_id=-1, epoch=_id(rng), why="the run is over")


RANDOM: dict[type[Message], Callable[[np.random.Generator], Message]] = {
    FrameDescriptor: _descriptor,
    FramePixels: _pixels,
    Credit: _credit,
    TrackedPose: tracked_pose,
    Odometry: _odometry,
    FrameCommitted: _committed,
    SectionSealed: _sealed,
    SectionArchived: _archived,
    SectionRequest: _request,
    SectionReply: _reply,
    ServiceStatus: _status,
    FleetEvent: _event,
    Control: _control,
}

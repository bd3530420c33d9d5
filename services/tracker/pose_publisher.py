"""What the tracker says of a frame: the pose it proposes to the mapper, and what robots read."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from vtslam.common.bus import Bus
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.messages import Odometry, TrackedPose
from vtslam.common.shm.ring_layout import FrameDescriptor
from vtslam.common.topics import TRACKER_ODOMETRY, TRACKER_POSE
from vtslam.common.tracking_facts import TrackingQuality, TrackingState
from vtslam.services.commit_facts import CommitFacts
from vtslam.services.service_link import ServiceLink
from vtslam.services.tracker.state import UNKNOWN_VARIANCE, TrackerState, TrackResult, untracked_pose


class PosePublisher:
    """Publishes poses, and counts them by state.

    Args:
        bus: The tracker's session.
        link: What it says of itself.
    """

    def __init__(self, bus: Bus, link: ServiceLink) -> None:
        self._link = link
        self._poses = bus.publisher(TRACKER_POSE)
        self._odometry = bus.publisher(TRACKER_ODOMETRY)

    def publish(
        self,
        frame: Frame,
        descriptor: FrameDescriptor,
        result: TrackResult | None,
        before: TrackerState,
        after: TrackerState,
        *,
        section_id: int,
        generation: int,
        num_tracked: int,
        read_s: float,
        track_s: float,
    ) -> TrackedPose:
        """Publish the pose of ``frame``; returns what was said.

        Args:
            frame: The frame.
            descriptor: Where it lies in the ring.
            result: What tracking found; None for the first frame, whose pose says where the world is.
            before: What the tracker remembers without the frame.
            after: What it remembers with it.
            section_id: The section it shall belong to.
            generation: Frames in the map that it was tracked against.
            num_tracked: Frames tracked so far.
            read_s: Seconds that reading it took.
            track_s: Seconds that tracking it took.
        """
        T_world_camera = untracked_pose(frame) if result is None else result.T_world_camera
        covariance = np.zeros((6, 6)) if result is None else _sendable(result.covariance)
        pose = TrackedPose(
            frame_id=frame.frame_id,
            capture_time_ns=frame.capture_time_ns,
            slot=descriptor.slot,
            slot_sequence=descriptor.sequence,
            section_id=section_id,
            generation=generation,
            epoch=self._link.epoch,
            T_world_camera=T_world_camera,
            covariance=covariance,
            quality=None if result is None else _quality(result),
            state=TrackingState.OK if result is None else result.state,
            overlap_section_id=-1 if result is None else result.overlap_section_id,
            history=after.history(),
            num_tracked=num_tracked,
            read_s=read_s,
            track_s=track_s,
        )
        self._poses.publish(pose)
        self._odometry.publish(self._odometry_of(frame, T_world_camera, covariance, result, before))
        if result is not None and result.state is not TrackingState.OK:
            self._link.count(f"poses.{result.state.value}")
        return pose

    def repeat(self, pose: TrackedPose) -> None:
        """Publish a pose once more for the mapper, which may have missed it."""
        self._poses.publish(pose)
        self._link.count("poses.repeated")

    def _odometry_of(
        self,
        frame: Frame,
        T_world_camera: npt.NDArray[np.float64],
        covariance: npt.NDArray[np.float64],
        result: TrackResult | None,
        state: TrackerState,
    ) -> Odometry:
        """The pose with the velocity since the last committed one, whose uncertainty is taken to be the same."""
        velocity, velocity_covariance = np.zeros(6), UNKNOWN_VARIANCE * np.eye(6)
        before = state.previous_frame
        if before is not None and frame.capture_time_ns > before.capture_time_ns:
            seconds = 1e-9 * (frame.capture_time_ns - before.capture_time_ns)
            velocity = se3.log(se3.inverse(state.committed_poses[-1]) @ T_world_camera) / seconds
            velocity_covariance = 2.0 * covariance / seconds**2
        return Odometry(
            frame_id=frame.frame_id,
            capture_time_ns=frame.capture_time_ns,
            T_world_camera=T_world_camera,
            velocity_camera=velocity,
            pose_covariance=covariance,
            velocity_covariance=_sendable(velocity_covariance),
            state=TrackingState.OK if result is None else result.state,
            epoch=self._link.epoch,
        )


def committed_state(facts: CommitFacts | None, frame: Frame | None) -> TrackerState:
    """What the tracker remembers after a commit: its ``facts``, and the frame; nothing before the first."""
    if facts is None:
        return TrackerState()
    return TrackerState.resumed(facts.committed_poses, frame, facts.history, facts.exposure)


def _quality(result: TrackResult) -> TrackingQuality:
    quality = result.quality
    return replace(
        quality,
        color_loss=_finite(quality.color_loss),
        depth_loss_m=_finite(quality.depth_loss_m),
        covered_share=_finite(quality.covered_share),
        rescued=bool(quality.rescued),
    )


def _finite(value: float) -> float:
    return float(value) if np.isfinite(value) else 0.0


def _sendable(covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A covariance that messages take: symmetric, positive and bounded; unknown if it is far from that."""
    symmetric = 0.5 * (covariance + covariance.T)
    if not np.isfinite(symmetric).all() or np.abs(symmetric).max() > 1e12:
        return UNKNOWN_VARIANCE * np.eye(6)
    values, vectors = np.linalg.eigh(symmetric)
    if values.min() >= 0.0:
        return symmetric
    lifted = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return np.asarray(0.5 * (lifted + lifted.T))

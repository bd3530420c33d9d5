"""The tracker as a service: the next frame of the ring against the map as committed, a pose on the bus."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.bus import Bus
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.messages import (
    Odometry,
    PoseQuality,
    PoseState,
    ServiceState,
    TrackedPose,
)
from vtslam.common.shm.errors import SharedMemoryError
from vtslam.common.shm.frame_ring import FrameRingReader
from vtslam.common.shm.ring_layout import FrameDescriptor
from vtslam.common.topics import MAPPER_COMMITTED, SENSOR_FRAME, TRACKER_ODOMETRY, TRACKER_POSE
from vtslam.services.map_follower import MapFollower
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.masks import mean_depth_m
from vtslam.services.tracker.state import UNKNOWN_VARIANCE, TrackerState, TrackingState, TrackResult


class TrackerService:
    """Tracks each frame once all before it are committed (lockstep).

    What it knows of the stream it takes from the map store and the ring at every step: messages only wake it, so a
    restart needs nothing else. A frame that was tracked but not committed is tracked again, with the same result.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        tracker: The core.
        follower: The map.
        ring_path: Where the frame ring is, or will be.
        section_length: Frames of a section.
    """

    def __init__(
        self,
        bus: Bus,
        link: ServiceLink,
        tracker: Tracker,
        follower: MapFollower,
        ring_path: Path,
        *,
        section_length: int,
    ) -> None:
        self._bus, self._link, self._tracker, self._follower = bus, link, tracker, follower
        self._ring_path, self._section_length = ring_path, section_length
        self._ring: FrameRingReader | None = None
        self._frames = bus.subscriber(SENSOR_FRAME)
        self._commits = bus.subscriber(MAPPER_COMMITTED)
        self._poses = bus.publisher(TRACKER_POSE)
        self._odometry = bus.publisher(TRACKER_ODOMETRY)
        self._read_s: dict[int, float] = {}
        self._proposed = -1  # the last frame a pose was published of

    def step(self) -> float | None:
        """See `Steps`."""
        self._link.poll()
        self._listen()
        if self._link.stopping:
            self._follower.release()
            self._link.tell(ServiceState.FINISHED, self._proposed)
            return None
        if self._track_next():
            self._link.tell(ServiceState.WORKING, self._proposed)
            return 0.0
        self._link.tell(ServiceState.READY, self._proposed)
        return HEARTBEAT_S

    def _listen(self) -> None:
        while (frame := self._frames.receive()) is not None:
            if frame.message.frame_id >= self._follower.num_frames:
                self._read_s[frame.message.frame_id] = frame.message.read_s
        while self._commits.receive() is not None:
            pass  # what was committed is in the store

    def _track_next(self) -> bool:
        """Track the frame after the last committed one; false if it was, or cannot be yet."""
        self._follower.refresh()
        frame_id = self._follower.num_frames
        section_id, row = divmod(frame_id, self._section_length)
        if frame_id <= self._proposed or (row == 0 and self._follower.map.active is not None):
            return False  # the section before a head is sealed first
        descriptor = self._descriptor_of(frame_id)
        if descriptor is None or self._ring is None:
            return False
        start_ns = self._bus.clock.monotonic_ns()
        frame = self._ring.copied(descriptor)
        state = self._state()
        result = None
        if frame_id > 0:
            result = self._tracker.track(frame, self._follower.map, state, section_id=section_id, is_head=row == 0)
        track_s = 1e-9 * (self._bus.clock.monotonic_ns() - start_ns)
        self._publish(frame, descriptor, state, result, section_id, track_s)
        self._proposed = frame_id
        return True

    def _descriptor_of(self, frame_id: int) -> FrameDescriptor | None:
        """Where a frame that is not done with lies in the ring; None if it is not there."""
        try:
            self._ring = self._ring or FrameRingReader(self._ring_path)
        except SharedMemoryError:
            return None  # not made yet
        # A recording's frames are numbered from 0, the ring's sequence from 1, and lockstep leaves none out.
        found = (each for each in self._ring.unacknowledged() if each.sequence == frame_id + 1)
        return next(found, None)

    def _state(self) -> TrackerState:
        facts = self._follower.facts
        if facts is None:
            return TrackerState()
        return TrackerState.resumed(facts.committed_poses, self._follower.frame, facts.history, facts.exposure)

    def _publish(
        self,
        frame: Frame,
        descriptor: FrameDescriptor,
        state: TrackerState,
        result: TrackResult | None,
        section_id: int,
        track_s: float,
    ) -> None:
        T_world_camera = np.eye(4) if result is None else result.T_world_camera
        covariance = np.zeros((6, 6)) if result is None else _sendable(result.covariance)
        after = state.after(frame, T_world_camera, result, mean_depth_m(frame))
        self._poses.publish(
            TrackedPose(
                frame_id=frame.frame_id,
                capture_time_ns=frame.capture_time_ns,
                slot=descriptor.slot,
                slot_sequence=descriptor.sequence,
                section_id=section_id,
                generation=self._follower.num_frames,
                epoch=self._link.epoch,
                T_world_camera=T_world_camera,
                covariance=covariance,
                quality=None if result is None else _quality(result),
                state=PoseState.OK if result is None else PoseState(result.state.value),
                overlap_section_id=-1 if result is None else result.overlap_section_id,
                history=after.history(),
                read_s=self._read_s.pop(frame.frame_id, 0.0),
                track_s=track_s,
            )
        )
        self._odometry.publish(self._odometry_of(frame, T_world_camera, covariance, result, state))
        self._link.count("frames.tracked")
        if result is not None and result.state is not TrackingState.OK:
            self._link.count(f"poses.{result.state.value}")

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
            state=PoseState.OK if result is None else PoseState(result.state.value),
            epoch=self._link.epoch,
        )


def _quality(result: TrackResult) -> PoseQuality:
    quality = result.quality
    return PoseQuality(
        color_loss=_finite(quality.color_loss),
        depth_loss_m=_finite(quality.depth_loss_m),
        covered_share=_finite(quality.covered_share),
        renders=quality.renders,
        section_id=quality.section_id,
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

"""The tracker as a service: the next frame of the ring against the map as committed, a pose on the bus."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.bus import Bus
from vtslam.common.frame import Frame
from vtslam.common.messages import ServiceState
from vtslam.common.section_end import SectionEnd, tracked_against
from vtslam.common.settings import Settings
from vtslam.common.shm.errors import SharedMemoryError
from vtslam.common.shm.frame_ring import FrameRingReader
from vtslam.common.shm.ring_layout import FrameDescriptor
from vtslam.common.topics import MAPPER_COMMITTED
from vtslam.services.free_memory import give_back_free_memory
from vtslam.services.map_follower import MapFollower
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.descriptors import Descriptors
from vtslam.services.tracker.masks import mean_depth_m
from vtslam.services.tracker.pose_publisher import PosePublisher, committed_state
from vtslam.services.tracker.priors import told_prior
from vtslam.services.tracker.state import TrackerState, TrackResult, untracked_pose
from vtslam.services.tracker.untaken_poses import UntakenPoses


class TrackerService:
    """Tracks every frame, in order, against a map of which the frame's number alone decides the commit.

    Without a lead (lockstep) that is the commit of the frame before it. With a lead of L (pipelined) it is that of
    the frame L before that one, or the section's first if that comes later; heads wait for the section before them to
    be sealed. The poses between come from the tracker itself; they are what the mapper will commit, so a tracker that
    starts again finds them in the map store or gets the same ones by tracking those frames again. What it knows of the
    stream it takes from the map store and the ring at every step: messages only wake it.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        tracker: The core.
        follower: The map; the store keeps ``lead`` generations besides the last.
        ring_path: Where the frame ring is, or will be.
        settings: The effective settings; they say where sections end.
        lead: Frames that tracking may be ahead of mapping.
    """

    def __init__(
        self,
        bus: Bus,
        link: ServiceLink,
        tracker: Tracker,
        follower: MapFollower,
        ring_path: Path,
        *,
        settings: Settings,
        lead: int = 0,
    ) -> None:
        self._clock, self._link, self._tracker, self._follower = bus.clock, link, tracker, follower
        self._ring_path, self._settings, self._lead = ring_path, settings, lead
        self._ring: FrameRingReader | None = None
        self._descriptors = Descriptors(bus, link)
        self._commits = bus.subscriber(MAPPER_COMMITTED)
        self._poses, self._untaken = PosePublisher(bus, link), UntakenPoses(bus.clock)
        self._proposed = -1  # the last frame a pose was published of
        self._proposed_head = False  # whether it was a head
        self._ahead = TrackerState()  # what is remembered after it
        self._poses_ahead: dict[int, npt.NDArray[np.float64]] = {}  # T_section_frame by frame, of those not committed

    def step(self) -> float | None:
        """See `Steps`."""
        self._link.poll()
        self._descriptors.listen(started=self._follower.num_frames > 0)
        while self._commits.receive() is not None:
            pass  # what was committed is in the store
        if self._link.stopping:
            self._follower.release()
            self._link.tell(ServiceState.FINISHED, self._proposed)
            return None
        if self._track_next():
            if self._proposed_head:  # what was compared to find the head's pose is gone
                give_back_free_memory()
            self._link.tell(ServiceState.WORKING, self._proposed)
            return 0.0
        repeated = self._untaken.to_repeat(self._follower.num_frames)
        if repeated is not None:
            self._poses.repeat(repeated)
        self._link.tell(ServiceState.READY, self._proposed)
        return HEARTBEAT_S

    def _track_next(self) -> bool:
        """Track the first frame that is neither committed nor proposed; false if that cannot be yet."""
        self._follower.look()
        frame_id = max(self._follower.num_frames, self._proposed + 1)
        poses = self._poses_before(frame_id)
        section_id, row = self._follower.section_id, len(poses)
        if not self._map_is_there(frame_id, section_id, row) or self._is_full(poses):
            return False  # a full section is sealed before its successor's head is tracked
        descriptor = self._descriptor_of(frame_id)
        if descriptor is None or self._ring is None:
            return False
        start_ns = self._clock.monotonic_ns()
        frame = self._ring.copied(descriptor)
        state, result = self._state(frame_id, section_id), None
        prior = told_prior(frame, state, self._link)
        if self._tracker.tracks(prior, is_first=frame_id == 0):
            result = self._tracker.track(
                frame, self._follower.map, state, section_id=section_id, is_head=row == 0, prior=prior
            )
        self._ahead = self._after(frame, state, result, section_id)
        pose = self._poses.publish(
            frame,
            descriptor,
            result,
            state,
            self._ahead,
            section_id=section_id,
            generation=frame_id - row + self._generation(row),
            num_tracked=frame_id + 1,
            read_s=self._descriptors.read_s(frame_id),
            track_s=1e-9 * (self._clock.monotonic_ns() - start_ns),
        )
        self._untaken.add(pose)
        self._link.count("frames.tracked")
        self._proposed, self._proposed_head = frame_id, row == 0
        return True

    def _poses_before(self, frame_id: int) -> tuple[npt.NDArray[np.float64], ...]:
        """``T_section_frame`` of the frames before this one in the section that goes on: committed, then proposed."""
        num_frames = self._follower.num_frames
        self._poses_ahead = {each: pose for each, pose in self._poses_ahead.items() if each >= num_frames}
        return (*self._follower.poses, *(self._poses_ahead[each] for each in range(num_frames, frame_id)))

    def _generation(self, row: int) -> int:
        """Frames of its section that a frame is tracked against."""
        return tracked_against(row, self._lead)

    def _is_full(self, poses: tuple[npt.NDArray[np.float64], ...]) -> bool:
        """Whether the section that goes on takes no frame after these; the map is there."""
        section = self._follower.map.active
        if not poses or section is None:
            return False
        end = SectionEnd.of(self._settings, section.camera, lead=self._lead)
        return end.is_reached_by_poses(poses) or end.is_reached_by_gaussians(section.gaussians.frame_index, len(poses))

    def _map_is_there(self, frame_id: int, section_id: int, row: int) -> bool:
        """Bring the map to where the frame in ``row`` is tracked against it; false if it is not that far."""
        if row == 0:  # the section before a head is sealed first
            return self._follower.num_frames == frame_id and self._follower.active_id is None
        return self._follower.go_to(section_id, self._generation(row))

    def _descriptor_of(self, frame_id: int) -> FrameDescriptor | None:
        """Where a frame that is not done with lies in the ring; None if it is not there."""
        try:
            self._ring = self._ring or FrameRingReader(self._ring_path)
        except SharedMemoryError:
            return None  # not made yet
        # A recording's frames are numbered from 0, the ring's sequence from 1, and none is left out.
        found = (each for each in self._ring.unacknowledged() if each.sequence == frame_id + 1)
        return next(found, None)

    def _state(self, frame_id: int, section_id: int) -> TrackerState:
        """What is remembered of the frames before: as committed, or as proposed, which will be committed so."""
        if frame_id == self._follower.num_frames:
            state = committed_state(self._follower.facts, self._follower.frame)
        else:
            state = self._ahead
        active = self._follower.map.active
        if active is None or active.section_id != section_id:
            return state
        # The mapper's estimate, as of the map: a later one may or may not be there yet.
        return replace(state, exposure=active.frames[-1].exposure)

    def _after(self, frame: Frame, state: TrackerState, result: TrackResult | None, section_id: int) -> TrackerState:
        """What is remembered with the frame; its pose goes through the section's frame, as the mapper's does."""
        T_world_camera = untracked_pose(frame) if result is None else result.T_world_camera
        after = state.after(frame, T_world_camera, result, mean_depth_m(frame))
        active = self._follower.map.active
        if active is None or active.section_id != section_id:
            self._poses_ahead[frame.frame_id] = np.eye(4)  # a head
            return after
        self._poses_ahead[frame.frame_id] = T_section_camera = active.T_section_camera(T_world_camera)
        T_world_camera = active.T_world_section @ T_section_camera
        return replace(after, committed_poses=(*after.committed_poses[:-1], T_world_camera))

"""The tracker as a service in realtime: always the newest frame, against the map as committed last."""

import contextlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from vtslam.common.bus import Bus
from vtslam.common.frame import Frame
from vtslam.common.geometry import se3
from vtslam.common.messages import ServiceState
from vtslam.common.shm.errors import FrameGone, SharedMemoryError
from vtslam.common.shm.frame_ring import FrameRingReader, PinnedFrame
from vtslam.common.shm.ring_layout import FrameDescriptor
from vtslam.common.topics import MAPPER_COMMITTED
from vtslam.services.map_follower import MapFollower
from vtslam.services.service_link import HEARTBEAT_S, ServiceLink
from vtslam.services.tracker.core import Tracker
from vtslam.services.tracker.descriptors import Descriptors
from vtslam.services.tracker.masks import mean_depth_m
from vtslam.services.tracker.pose_ages import PoseAges
from vtslam.services.tracker.pose_publisher import PosePublisher, committed_state
from vtslam.services.tracker.priors import told_prior
from vtslam.services.tracker.state import TrackerState, TrackResult, untracked_pose

_MAX_STEPS_AHEAD = 3.0  # as far as a velocity is trusted, in times of what it was measured over


class RealtimeTracker:
    """Tracks the newest frame, again and again; frames that came in between are dropped, and counted.

    Frames tracked and frames dropped are together those published, up to the one tracked last; a tracker that starts
    again counts what the map does not know of as dropped. The frame of the last pose stays pinned in the ring until the
    next pose is out, so that the mapper finds it.

    Args:
        bus: Its session.
        link: What it says of itself and is told.
        tracker: The core.
        follower: The map.
        ring_path: Where the frame ring is, or will be.
    """

    def __init__(
        self,
        bus: Bus,
        link: ServiceLink,
        tracker: Tracker,
        follower: MapFollower,
        ring_path: Path,
    ) -> None:
        self._clock, self._link, self._tracker, self._follower = bus.clock, link, tracker, follower
        self._ring_path = ring_path
        self._ring: FrameRingReader | None = None
        self._descriptors = Descriptors(bus, link)
        self._commits = bus.subscriber(MAPPER_COMMITTED)
        self._poses, self._ages = PosePublisher(bus, link), PoseAges()
        self._state: TrackerState | None = None  # what is remembered; None at a start
        self._step_ns = 0  # between the last two frames tracked
        self._held: PinnedFrame | None = None  # the frame of the last pose
        follower.look()
        facts = follower.facts
        self._sequence, self._tracked = (0, 0) if facts is None else (facts.sequence, facts.num_tracked)
        if (ring := self._open_ring()) is not None:
            self._sequence = max(self._sequence, ring.acknowledged)
        self._tell_counts()

    def step(self) -> float | None:
        """See `Steps`."""
        self._link.poll()
        self._descriptors.listen(started=self._follower.num_frames > 0)
        while self._commits.receive() is not None:
            pass  # what was committed is in the store
        if self._link.stopping:
            self._end()
            return None
        if self._track_newest():
            self._link.tell(ServiceState.WORKING, self._sequence - 1)
            return 0.0
        through = self._link.drain_through
        if through is not None and self._sequence > through:
            self._end()
            return None
        self._link.tell(ServiceState.READY, self._sequence - 1)
        return HEARTBEAT_S

    def _end(self) -> None:
        self._follower.release()
        if self._held is not None:
            self._held.release()
        self._link.tell(ServiceState.FINISHED, self._sequence - 1)

    def _track_newest(self) -> bool:
        """Track the newest frame; false if it was, or if there is no map yet."""
        self._follower.refresh()
        pinned = self._newest()
        if pinned is None:
            return False
        held, descriptor = pinned
        start_ns, frame = self._clock.monotonic_ns(), held.frame
        active_id, num_frames = self._follower.active_id, self._follower.num_frames
        section_id = self._follower.section_id
        state, result = self._remembered(), None
        prior = told_prior(frame, state, self._link)
        if self._tracker.tracks(prior, is_first=num_frames == 0):
            result = self._tracker.track(
                frame,
                self._follower.map,
                state,
                section_id=section_id,
                is_head=active_id is None,
                guess=self._guess(state, frame),
                prior=prior,
            )
        after = self._remember(state, frame, result)
        self._tracked += 1
        self._poses.publish(
            frame,
            descriptor,
            result,
            state,
            after,
            section_id=section_id,
            generation=num_frames,
            num_tracked=self._tracked,
            read_s=self._descriptors.read_s(frame.frame_id),
            track_s=1e-9 * (self._clock.monotonic_ns() - start_ns),
        )
        self._done_with(held, descriptor)
        if num_frames > 0:
            self._note_age(frame.frame_id)
        return True

    def _note_age(self, frame_id: int) -> None:
        published_ns = self._descriptors.published_ns(frame_id)
        if published_ns is not None:
            self._ages.published(published_ns, self._clock.wall_ns())
            self._link.gauges["pose_age_p99_ms"] = self._ages.quantile_ms(0.99)

    def _newest(self) -> tuple[PinnedFrame, FrameDescriptor] | None:
        """The newest frame, pinned; None if it was tracked, or waits for the first one to be in the map."""
        ring = self._open_ring()
        if ring is None or (self._follower.num_frames == 0 and self._tracked > 0):
            return None
        while (descriptor := ring.newest()) is not None and descriptor.sequence > self._sequence:
            try:
                return ring.pinned(descriptor), descriptor
            except FrameGone:
                continue  # there is a newer one
        return None

    def _open_ring(self) -> FrameRingReader | None:
        """The ring, once it was made."""
        with contextlib.suppress(SharedMemoryError):
            self._ring = self._ring or FrameRingReader(self._ring_path)
        return self._ring

    def _remembered(self) -> TrackerState:
        """What is remembered of the frames before, with the exposure that was estimated last."""
        committed = committed_state(self._follower.facts, self._follower.frame)
        if self._state is not None:
            return replace(self._state, exposure=committed.exposure)
        return replace(committed, committed_poses=committed.committed_poses[-1:])  # when the other was is not known

    def _guess(self, state: TrackerState, frame: Frame) -> npt.NDArray[np.float64]:
        """The pose at constant velocity: frames that were dropped make steps of different lengths."""
        newer, before = state.committed_poses[-1], state.previous_frame
        if len(state.committed_poses) < 2 or before is None or self._step_ns <= 0:
            return newer
        steps = (frame.capture_time_ns - before.capture_time_ns) / self._step_ns
        motion = se3.log(newer @ se3.inverse(state.committed_poses[0]))
        return se3.orthonormalized(se3.exp(float(np.clip(steps, 0.0, _MAX_STEPS_AHEAD)) * motion) @ newer)

    def _remember(self, state: TrackerState, frame: Frame, result: TrackResult | None) -> TrackerState:
        before = state.previous_frame
        self._step_ns = 0 if before is None else frame.capture_time_ns - before.capture_time_ns
        T_world_camera = untracked_pose(frame) if result is None else result.T_world_camera
        self._state = state.after(frame, T_world_camera, result, mean_depth_m(frame))
        return self._state

    def _done_with(self, held: PinnedFrame, descriptor: FrameDescriptor) -> None:
        """Let go of the frame before, once the pose of this one is out."""
        assert self._ring is not None
        if self._held is not None:
            self._held.release()
        self._held, self._sequence = held, descriptor.sequence
        self._ring.acknowledge(descriptor.sequence)
        self._tell_counts()

    def _tell_counts(self) -> None:
        self._link.counters["frames.tracked"] = self._tracked
        self._link.counters["frames.dropped"] = self._sequence - self._tracked

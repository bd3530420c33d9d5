"""Which of the tracker's poses is mapped next: each in its turn, or the newest."""

from typing import Protocol

from vtslam.common.bus import Bus
from vtslam.common.messages import TrackedPose
from vtslam.common.topics import TRACKER_POSE


class PoseIntake(Protocol):
    """Takes in poses, and gives the one to map."""

    @property
    def may_skip(self) -> bool:
        """Whether a pose need not be mapped."""
        ...

    def listen(self, num_frames: int, sequence: int, *, section_id: int, row: int) -> None:
        """Take in what has come.

        Args:
            num_frames: Committed up to now.
            sequence: Of the last one, in the ring.
            section_id: Of the next one.
            row: Of the next one, in that section.
        """
        ...

    def take(self, num_frames: int) -> TrackedPose | None:
        """The pose to map next, if it is there."""
        ...

    def is_drained(self, num_frames: int, through_frame_id: int | None) -> bool:
        """Whether nothing is left to map, once an order to end has come."""
        ...


class EveryPose:
    """All poses, in order (lockstep, pipelined); one that is repeated while it is mapped is forgotten afterwards.

    Args:
        bus: The mapper's session.
    """

    may_skip = False

    def __init__(self, bus: Bus) -> None:
        self._tracked = bus.subscriber(TRACKER_POSE)
        self._poses: dict[int, TrackedPose] = {}

    def listen(self, num_frames: int, sequence: int, *, section_id: int, row: int) -> None:
        """See `PoseIntake`."""
        while (tracked := self._tracked.receive()) is not None:
            self._poses[tracked.message.frame_id] = tracked.message
        for frame_id in [each for each in self._poses if each < num_frames]:
            del self._poses[frame_id]

    def take(self, num_frames: int) -> TrackedPose | None:
        """See `PoseIntake`."""
        return self._poses.pop(num_frames, None)

    def is_drained(self, num_frames: int, through_frame_id: int | None) -> bool:
        """See `PoseIntake`."""
        return through_frame_id is not None and num_frames > through_frame_id


class NewestPose:
    """The newest pose that fits where the map stands (realtime); older ones are never mapped.

    A section's head has to be tracked after the section before it was sealed, and its other frames against it.

    Args:
        bus: The mapper's session.
    """

    may_skip = True

    def __init__(self, bus: Bus) -> None:
        # Not newest-only: a mapper that starts again gets the pose that came before, which may be the only one.
        self._tracked = bus.subscriber(TRACKER_POSE)
        self._newest: TrackedPose | None = None
        self._ended = False

    def listen(self, num_frames: int, sequence: int, *, section_id: int, row: int) -> None:
        """See `PoseIntake`."""
        while (tracked := self._tracked.receive()) is not None:
            if self._newest is None or tracked.message.slot_sequence > self._newest.slot_sequence:
                self._newest = tracked.message
        newest = self._newest
        if newest is None:
            return
        fits = newest.section_id == section_id and newest.generation >= num_frames - row + min(row, 1)
        if newest.slot_sequence <= sequence or not fits:
            self._newest = None

    def take(self, num_frames: int) -> TrackedPose | None:
        """See `PoseIntake`."""
        pose, self._newest = self._newest, None
        return None if self._ended else pose

    def is_drained(self, num_frames: int, through_frame_id: int | None) -> bool:
        """See `PoseIntake`."""
        if through_frame_id is not None and self._newest is None:
            self._ended = True  # poses that come later are not mapped
        return self._ended

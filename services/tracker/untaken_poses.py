"""Poses that were published and are not committed yet."""

from vtslam.common.bus import Clock
from vtslam.common.messages import TrackedPose

_PATIENCE_S = 2.0  # until a pose is said again; doubled each time, as mapping may take long


class UntakenPoses:
    """Knows when the pose that the mapper is to map next should be said again, since nobody else would notice its loss.

    Args:
        clock: What time it is.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._poses: dict[int, TrackedPose] = {}  # by frame
        self._awaited, self._since_ns, self._patience_s = -1, 0, _PATIENCE_S

    def add(self, pose: TrackedPose) -> None:
        """Take in a pose that was published."""
        self._poses[pose.frame_id] = pose

    def to_repeat(self, num_frames: int) -> TrackedPose | None:
        """The pose to publish once more, if any.

        Args:
            num_frames: Committed up to now.
        """
        self._poses = {frame_id: pose for frame_id, pose in self._poses.items() if frame_id >= num_frames}
        pose, now_ns = self._poses.get(num_frames), self._clock.monotonic_ns()
        if pose is None or num_frames != self._awaited:
            self._awaited, self._since_ns, self._patience_s = num_frames, now_ns, _PATIENCE_S
            return None
        if now_ns - self._since_ns < 1e9 * self._patience_s:
            return None
        self._since_ns, self._patience_s = now_ns, 2.0 * self._patience_s
        return pose

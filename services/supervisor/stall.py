"""Whether a fleet stands still although each of its processes seems sound."""

from pathlib import Path

from vtslam.common.shm.errors import SharedMemoryError
from vtslam.common.shm.frame_ring import FrameRingReader


class StallWatch:
    """Notices when frames lie in the ring for long, and nobody does anything about them.

    Args:
        ring_path: Where the ring is, or will be.
        limit_s: How long is too long.

    Attributes:
        limit_s: As given.
    """

    def __init__(self, ring_path: Path, limit_s: float) -> None:
        self._ring_path, self.limit_s = ring_path, limit_s
        self._ring: FrameRingReader | None = None
        self._frames, self._since_s = -1, 0.0

    def is_there(self, now_s: float, frames: int, *, waits: bool) -> bool:
        """Whether the fleet stands still; to be asked often. Once it does, its time begins anew.

        Args:
            now_s: The time.
            frames: Frames committed.
            waits: Whether all who could do something say that there is nothing to do.
        """
        if not waits or frames != self._frames or not self._frames_wait():
            self._frames, self._since_s = frames, now_s
        if now_s - self._since_s <= self.limit_s:
            return False
        self._since_s = now_s
        return True

    def _frames_wait(self) -> bool:
        try:
            self._ring = self._ring or FrameRingReader(self._ring_path)
        except SharedMemoryError:
            return False  # not made yet
        return self._ring.published > self._ring.acknowledged

"""Follows a run for the person in front of it: progress, and a line whenever tracking is lost or found again."""

from vtslam.services.cli.console import Progress
from vtslam.services.frame_facts import FrameFacts


class FrameWatch:
    """Told of each frame.

    Args:
        progress: Where it shows.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._lost_since: int | None = None

    def __call__(self, facts: FrameFacts) -> None:
        """Take note of a frame."""
        lost = facts.state == "lost"
        if lost and self._lost_since is None:
            self._lost_since = facts.frame_id
            self._progress.note(
                f"frame {facts.frame_id}: tracking lost ({100 * facts.covered_share:.1f} % of the image usable); "
                "poses are guesses until it is found again"
            )
        if not lost and self._lost_since is not None:
            self._progress.note(f"frame {facts.frame_id}: tracking again, lost since frame {self._lost_since}")
            self._lost_since = None
        self._progress.step()

"""Reads a recording's next frame while the one before is being worked on."""

from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from vtslam.common.frame import Frame
from vtslam.services.sensor.sources.base import Source, live_camera


class ReadAhead:
    """The frames of a source in order, each read in a thread of its own; those of a live camera only when asked for.

    Args:
        source: The source; no one else reads it meanwhile.
        first: Index of the first frame.

    Attributes:
        next_index: Index of the frame that :meth:`next` gives.
    """

    def __init__(self, source: Source, *, first: int = 0) -> None:
        self._source, self.next_index = source, first
        self._waits = live_camera(source) is not None
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead")
        self._ahead: Future[Frame] | None = None

    def __enter__(self) -> "ReadAhead":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._reader.shutdown(cancel_futures=True)

    def next(self) -> Frame:
        """The next frame; raises what reading it raised, and IndexError after the last."""
        frame = self._source.frame(self.next_index) if self._ahead is None else self._ahead.result()
        self.next_index += 1
        more = self.next_index < len(self._source) and not self._waits
        self._ahead = self._reader.submit(self._source.frame, self.next_index) if more else None
        return frame

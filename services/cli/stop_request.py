"""Ctrl-C and SIGTERM as a polite request: the current frame is finished, and what was done is kept."""

import signal
import sys
from types import FrameType, TracebackType
from typing import Any, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """While entered, the first SIGINT or SIGTERM is remembered; a second one acts as it did before.

    Attributes:
        signal_number: The signal that came, or None.
    """

    def __init__(self) -> None:
        self.signal_number: int | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._previous = {number: signal.signal(number, self._remember) for number in _SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._restore()

    def __call__(self) -> bool:
        """Whether to stop."""
        return self.signal_number is not None

    @property
    def exit_status(self) -> int:
        """0 if nobody asked to stop, else 128 + the signal's number."""
        return 0 if self.signal_number is None else 128 + self.signal_number

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self.signal_number = number
        self._restore()
        print("\nstopping after this frame; what is done will be kept (again to stop at once)", file=sys.stderr)

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}

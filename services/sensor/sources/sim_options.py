"""Options of simulated sources, checked."""

import os
import re
from dataclasses import dataclass

from vtslam.services.sensor.sources.base import SourceError

_SIZE = re.compile(r"([0-9]+)x([0-9]+)")


@dataclass(frozen=True, slots=True)
class SimOptions:
    """Refuses options in the name of a source.

    Attributes:
        source: The source, as in ``sim:room``.
    """

    source: str

    def check(self, name: str, value: int, low: int, high: int) -> None:
        """Raise SourceError unless ``value`` is ``low`` to ``high``."""
        if not low <= value <= high:
            raise SourceError(f"{self.source}: {name} must be {low} to {high}; got {value}")

    def whole(self, name: str, text: str) -> int:
        """A whole number; raises SourceError."""
        try:
            return int(text)
        except ValueError:
            raise SourceError(f"{self.source}: {name} must be a whole number; got {text!r}") from None

    def size(self, text: str, *, usual: str) -> tuple[int, int]:
        """Width and height in pixels from ``WxH``, with ``usual`` as an example; raises SourceError."""
        match = _SIZE.fullmatch(text)
        if match is None:
            raise SourceError(f"{self.source}: size must read WxH, as in {usual}; got {text!r}")
        return int(match[1]), int(match[2])


def num_threads() -> int:
    """Threads that rendering a simulated frame may take: the processors of this process."""
    return len(os.sched_getaffinity(0))

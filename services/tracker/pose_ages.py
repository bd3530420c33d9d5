"""How old the newest pose is, as somebody who needs one at any moment finds it."""

from collections import deque

import numpy as np

_SAMPLE_MS = 5.0
_SAMPLES = 12_000  # a minute


class PoseAges:
    """Ages of the newest pose, in even steps of time: it grows until the next pose replaces it."""

    def __init__(self) -> None:
        self._ages_ms: deque[float] = deque(maxlen=_SAMPLES)
        self._last: tuple[int, int] | None = None

    def published(self, capture_ns: int, now_ns: int) -> None:
        """A pose went out ``now_ns`` of a frame that was there since ``capture_ns``, both of one clock."""
        if self._last is not None:
            captured_ns, since_ns = self._last
            first_ms, last_ms = 1e-6 * (since_ns - captured_ns), 1e-6 * (now_ns - captured_ns)
            first_ms = max(first_ms, last_ms - _SAMPLES * _SAMPLE_MS)
            self._ages_ms.extend(np.arange(first_ms, last_ms, _SAMPLE_MS).tolist())
        self._last = capture_ns, now_ns

    def quantile_ms(self, share: float) -> float:
        """The age that is not exceeded in this share of the time; 0 before the second pose."""
        return float(np.quantile(self._ages_ms, share)) if self._ages_ms else 0.0

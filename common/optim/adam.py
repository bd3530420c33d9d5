"""Adam (Kingma and Ba, 2015, algorithm 1), fused and in place (C++)."""

import numpy as np
import numpy.typing as npt

from vtslam.common.rows import compacted
from vtslam.common.splat import _native
from vtslam.common.splat.engine import FloatArray
from vtslam.common.splat.native_engine import checked


class Adam:
    """Adam for one float32 array of any shape, with the bias correction of torch's.

    The state is plain: ``m`` and ``v`` (first and second moments, shape of the parameters) and ``step_count``.

    Args:
        shape: Of the parameters.
        lr: Step length.
        betas: Decay of the two moments.
        eps: Added to the root of the second moment.
        threads: None for the process's default.

    Raises:
        ValueError: A constant is out of range.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        *,
        lr: float,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
        threads: int | None = None,
    ) -> None:
        if not (0.0 <= betas[0] < 1.0 and 0.0 <= betas[1] < 1.0 and lr >= 0.0 and eps > 0.0):
            raise ValueError(f"Adam takes lr >= 0, 0 <= betas < 1, eps > 0; got {lr}, {betas}, {eps}")
        self.lr = lr
        self.betas = betas
        self.eps = eps
        self.m: FloatArray = np.zeros(shape, np.float32)
        self.v: FloatArray = np.zeros(shape, np.float32)
        self.step_count = 0
        self._threads = threads or 0

    def grow(self, rows: int) -> None:
        """Append rows with zero moments; the step count, and so the bias correction, is that of the older rows."""
        added = np.zeros((rows, *self.m.shape[1:]), np.float32)
        self.m = np.concatenate([self.m, added])
        self.v = np.concatenate([self.v, added])

    def thin(self, kept: npt.NDArray[np.bool_]) -> None:
        """Leave out those of the last rows that are not ``kept`` (bool [M])."""
        self.m, self.v = compacted(self.m, kept), compacted(self.v, kept)

    def step(self, parameters: FloatArray, gradients: FloatArray, *, rate: float = 1.0) -> None:
        """Move ``parameters`` in place a step of ``rate * lr`` against ``gradients`` (float32, shape of the state).

        Raises:
            ValueError: An array is misshapen, of another type, not contiguous, or the parameters are read-only.
        """
        checked("parameters", parameters, np.float32, self.m.shape)
        checked("gradients", gradients, np.float32, self.m.shape)
        if not parameters.flags.writeable:
            raise ValueError("parameters must be writable")
        self.step_count += 1
        flat: list[npt.NDArray[np.float32]] = [a.reshape(-1) for a in (parameters, gradients, self.m, self.v)]
        _native.adam_step(
            flat[0], flat[1], flat[2], flat[3], rate * self.lr, *self.betas, self.eps, self.step_count, self._threads
        )

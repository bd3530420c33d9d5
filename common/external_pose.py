"""A pose that something else than the tracker knows: wheels, an IMU, GNSS, another SLAM."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExternalPose:
    """A pose from another sensor, in the world that the map shall have.

    Attributes:
        T_world_camera: float64 [4,4].
        covariance: float64 [6,6] of a left twist on ``T_camera_world`` (translation m, rotation rad).

    Raises:
        ValueError: The pose is not rigid, or the covariance not symmetric, finite and positive semi-definite.
    """

    T_world_camera: npt.NDArray[np.float64]
    covariance: npt.NDArray[np.float64]

    def __post_init__(self) -> None:
        c = self.covariance
        if not se3.is_rigid(self.T_world_camera):
            raise ValueError("an external pose must be a rigid motion [4,4]")
        if c.shape != (6, 6) or not np.isfinite(c).all() or not np.allclose(c, c.T):
            raise ValueError("the covariance of an external pose must be a finite, symmetric [6,6] matrix")
        if np.linalg.eigvalsh(c).min() < -1e-9 * max(float(np.abs(c).max()), 1e-30):
            raise ValueError("the covariance of an external pose must be positive semi-definite")

    def information(self) -> npt.NDArray[np.float64]:
        """The inverse covariance [6,6]; directions said to be exact get a standard deviation of a micrometre."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.asarray((vectors / np.maximum(values, 1e-12)) @ vectors.T)

    def copied(self) -> "ExternalPose":
        """The same with arrays of its own."""
        return ExternalPose(T_world_camera=self.T_world_camera.copy(), covariance=self.covariance.copy())

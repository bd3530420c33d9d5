"""Adam on one camera pose, as the paper does it: unnormalised quaternion and translation of ``T_camera_map``."""

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-8


def _quaternion_product(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Hamilton product of quaternions (x, y, z, w)."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.array([*vector, a[3] * b[3] - a[:3] @ b[:3]])


class PoseAdam:
    """State of Adam over the 7 numbers (quaternion x y z w, translation m) of a pose ``T_camera_map``."""

    def __init__(self, T_camera_map: npt.NDArray[np.float64], *, rate_rotation: float, rate_translation: float) -> None:
        self._parameters = np.concatenate([se3.quaternion_xyzw(T_camera_map), T_camera_map[:3, 3]])
        self._rates = np.array([rate_rotation] * 4 + [rate_translation] * 3)
        self._m, self._v, self._step = np.zeros(7), np.zeros(7), 0

    @property
    def T_camera_map(self) -> npt.NDArray[np.float64]:
        """The pose now, float64 [4,4]."""
        return se3.from_quaternion_xyzw(self._parameters[4:], self._parameters[:4])

    def step(self, d_twist: npt.NDArray[np.float64]) -> None:
        """Descend along the gradient [6] of a left twist (translation m, rotation rad) of ``T_camera_map``."""
        gradient = self._parameter_gradient(d_twist)
        self._step += 1
        self._m = _BETA1 * self._m + (1 - _BETA1) * gradient
        self._v = _BETA2 * self._v + (1 - _BETA2) * gradient * gradient
        m = self._m / (1 - _BETA1**self._step)
        v = self._v / (1 - _BETA2**self._step)
        self._parameters = self._parameters - self._rates * m / (np.sqrt(v) + _EPSILON)

    def _parameter_gradient(self, d_twist: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Chain rule from the twist to (q, t).

        A left twist moves t by rho + phi x t, so the rotation alone has the gradient g_phi - t x g_rho; and a rotation
        phi moves the unit quaternion by (phi, 0) * q / 2 along directions that are orthogonal and of length 1/2.
        """
        q, t = self._parameters[:4], self._parameters[4:]
        norm = float(np.linalg.norm(q))
        g_rotation = d_twist[3:] - np.cross(t, d_twist[:3])
        tangent = _quaternion_product(np.array([*g_rotation, 0.0]), q / norm)
        return np.concatenate([2.0 * tangent / norm, d_twist[:3]])

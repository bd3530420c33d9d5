"""Bundle adjustment of a head: its pose and its section's attributes are refined together (paper, section 3.5)."""

import numpy as np
import numpy.typing as npt

from vtslam.common.geometry import se3
from vtslam.common.settings import MapperSettings

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15


class HeadBundle:
    """Adam over a left twist of the head's ``T_camera_world``; the anchor follows."""

    def __init__(self, T_world_section: npt.NDArray[np.float64], settings: MapperSettings) -> None:
        self._T_world_section = T_world_section
        self._rates = np.array([settings.bundle_translation_rate] * 3 + [settings.bundle_rotation_rate] * 3)
        self._m, self._v, self._step = np.zeros(6), np.zeros(6), 0

    def moved(self, gradient: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The anchor ``T_world_section`` after one step along ``gradient`` [6]; unmoved while nothing pulls on it."""
        if not gradient.any() or not self._rates.any():
            return self._T_world_section
        self._step += 1
        self._m = _BETA1 * self._m + (1 - _BETA1) * gradient
        self._v = _BETA2 * self._v + (1 - _BETA2) * gradient * gradient
        m, v = self._m / (1 - _BETA1**self._step), self._v / (1 - _BETA2**self._step)
        twist = -self._rates * m / (np.sqrt(v) + _EPSILON)
        # T_camera_world <- exp(twist) T_camera_world, and the head's camera is the section's frame.
        self._T_world_section = se3.orthonormalized(self._T_world_section @ se3.exp(-twist))
        return self._T_world_section

"""Adam on quaternion and translation: its chain rule by finite differences, and that it descends."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from vtslam.common.geometry import se3
from vtslam.common.optim.pose_adam import PoseAdam

Array = npt.NDArray[np.float64]

POINTS = np.random.default_rng(5).uniform(-2.0, 2.0, (40, 3))


def pose(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return se3.exp(np.concatenate([rng.uniform(-2, 2, 3), rng.uniform(-1, 1, 3)]))


def squared_error(T: Array, true: Array) -> float:
    """Half the sum of squared distances of points moved by two poses."""
    return 0.5 * float(np.square(POINTS @ (T - true)[:3, :3].T + (T - true)[:3, 3]).sum())


def twist_gradient(function: Callable[[Array], float], T: Array) -> Array:
    steps = 1e-6 * np.eye(6)
    return np.array([(function(se3.exp(s) @ T) - function(se3.exp(-s) @ T)) / 2e-6 for s in steps])


@pytest.mark.parametrize("seed", range(5))
def test_first_step_follows_the_sign_of_the_derivative_by_quaternion_and_translation(seed: int) -> None:
    # Adam's first step is the rate times the sign of each parameter's gradient.
    T, true = pose(seed), pose(seed + 100)
    rotation_rate, translation_rate = 3e-4, 7e-4
    adam = PoseAdam(T, rate_rotation=rotation_rate, rate_translation=translation_rate)
    adam.step(twist_gradient(lambda at: squared_error(at, true), T))

    parameters = np.concatenate([se3.quaternion_xyzw(T), T[:3, 3]])
    numeric = np.zeros(7)
    for i in range(7):
        step = np.zeros(7)
        step[i] = 1e-6
        ends = [parameters + step, parameters - step]
        values = [squared_error(se3.from_quaternion_xyzw(p[4:], p[:4]), true) for p in ends]
        numeric[i] = (values[0] - values[1]) / 2e-6
    rates = np.array([rotation_rate] * 4 + [translation_rate] * 3)
    expected = parameters - rates * np.sign(numeric)
    np.testing.assert_allclose(adam.T_camera_map, se3.from_quaternion_xyzw(expected[4:], expected[:4]), atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_many_steps_match_adam_on_the_numeric_gradient_of_all_seven_numbers(seed: int) -> None:
    start, true = pose(seed), pose(seed + 50)
    adam = PoseAdam(start, rate_rotation=0.01, rate_translation=0.02)
    parameters = np.concatenate([se3.quaternion_xyzw(start), start[:3, 3]])
    rates, m, v = np.array([0.01] * 4 + [0.02] * 3), np.zeros(7), np.zeros(7)

    def value(p: Array) -> float:
        return squared_error(se3.from_quaternion_xyzw(p[4:], p[:4]), true)

    for count in range(1, 13):
        adam.step(twist_gradient(lambda at: squared_error(at, true), adam.T_camera_map))
        gradient = np.array([(value(parameters + s) - value(parameters - s)) / 2e-6 for s in 1e-6 * np.eye(7)])
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        parameters = parameters - rates * (m / (1 - 0.9**count)) / (np.sqrt(v / (1 - 0.999**count)) + 1e-8)
    # The quaternion is no longer of length 1, which the chain rule must know.
    assert abs(np.linalg.norm(parameters[:4]) - 1.0) > 1e-4
    np.testing.assert_allclose(adam.T_camera_map, se3.from_quaternion_xyzw(parameters[4:], parameters[:4]), atol=1e-5)


def test_it_descends_to_the_minimum() -> None:
    true = pose(3)
    start = se3.exp(np.array([0.02, -0.03, 0.01, 0.02, 0.03, -0.02])) @ true
    adam = PoseAdam(start, rate_rotation=0.002, rate_translation=0.002)
    first = squared_error(start, true)
    for _ in range(150):
        adam.step(twist_gradient(lambda at: squared_error(at, true), adam.T_camera_map))
    assert squared_error(adam.T_camera_map, true) < 1e-3 * first


def test_no_gradient_means_no_motion() -> None:
    T = pose(4)
    adam = PoseAdam(T, rate_rotation=0.002, rate_translation=0.002)
    adam.step(np.zeros(6))
    np.testing.assert_allclose(adam.T_camera_map, T, atol=1e-12)


def test_the_pose_stays_rigid() -> None:
    adam = PoseAdam(pose(1), rate_rotation=0.1, rate_translation=0.1)
    rng = np.random.default_rng(0)
    for _ in range(50):
        adam.step(rng.normal(size=6) * 100.0)
        assert se3.is_rigid(adam.T_camera_map, tolerance=1e-12)

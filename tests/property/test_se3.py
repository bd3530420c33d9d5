import hypothesis.strategies as st
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given

from vtslam.common.geometry import se3

Array = npt.NDArray[np.float64]

coordinates = st.floats(-10.0, 10.0)
vectors = st.tuples(coordinates, coordinates, coordinates).map(lambda v: np.array(v, np.float64))
directions = vectors.filter(lambda v: float(np.linalg.norm(v)) > 1e-3).map(lambda v: v / np.linalg.norm(v))
# Most of the angles drawn lie where series and special cases meet: near 0 and near pi.
angles = st.one_of(
    st.floats(0.0, np.pi - 1e-3),
    st.floats(-18.0, -2.0).map(lambda exponent: 10.0**exponent),
    st.floats(-12.0, -2.0).map(lambda exponent: np.pi - 10.0**exponent),
)
rotation_vectors = st.builds(lambda axis, angle: axis * angle, directions, angles)
twists = st.builds(lambda rho, phi: np.concatenate([rho, phi]), vectors, rotation_vectors)
motions = twists.map(se3.exp)


@given(twists)
def test_log_undoes_exp(xi: Array) -> None:
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=2e-7)


@given(twists)
def test_exp_undoes_log(xi: Array) -> None:
    T = se3.exp(xi)
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=2e-7)


@given(twists)
def test_exp_is_the_matrix_exponential(xi: Array) -> None:
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = se3.hat(xi[3:]), xi[:3]
    # The series of xi / 2^10, squared ten times.
    term, total = np.eye(4), np.eye(4)
    for order in range(1, 12):
        term = term @ generator / (order * 1024.0)
        total = total + term
    for _ in range(10):
        total = total @ total
    np.testing.assert_allclose(se3.exp(xi), total, atol=1e-10)


@given(twists)
def test_exp_is_rigid(xi: Array) -> None:
    assert se3.is_rigid(se3.exp(xi), tolerance=1e-12)


@given(directions, angles)
def test_angle(axis: Array, angle: float) -> None:
    T = se3.exp(np.concatenate([np.zeros(3), axis * angle]))
    assert se3.angle_rad(T) == pytest.approx(angle, abs=1e-9)


@given(directions)
def test_rotation_by_pi_turns_about_its_axis(axis: Array) -> None:
    T = se3.exp(np.concatenate([np.zeros(3), axis * np.pi]))
    phi = se3.rotation_log(T[:3, :3])
    np.testing.assert_allclose(np.abs(phi @ axis), np.pi, atol=1e-9)


@given(motions)
def test_inverse(T: Array) -> None:
    np.testing.assert_allclose(T @ se3.inverse(T), se3.identity(), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(T) @ T, se3.identity(), atol=1e-12)


@given(twists, motions)
def test_adjoint_moves_a_perturbation_to_the_other_side(xi: Array, T: Array) -> None:
    left = se3.exp(se3.adjoint(T) @ xi) @ T
    np.testing.assert_allclose(left, T @ se3.exp(xi), atol=1e-9)


@given(motions, motions)
def test_adjoint_of_a_product(a: Array, b: Array) -> None:
    np.testing.assert_allclose(se3.adjoint(a @ b), se3.adjoint(a) @ se3.adjoint(b), atol=1e-10)


@given(motions)
def test_quaternion_round_trip(T: Array) -> None:
    quaternion = se3.quaternion_xyzw(T)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-12)
    assert quaternion[3] >= 0.0
    np.testing.assert_allclose(se3.from_quaternion_xyzw(T[:3, 3], quaternion), T, atol=1e-12)


@given(motions, st.floats(0.1, 10.0))
def test_quaternion_sign_and_length_do_not_matter(T: Array, scale: float) -> None:
    quaternion = se3.quaternion_xyzw(T)
    np.testing.assert_allclose(se3.from_quaternion_xyzw(T[:3, 3], -scale * quaternion), T, atol=1e-12)


@given(vectors, vectors)
def test_hat_is_the_cross_product(a: Array, b: Array) -> None:
    np.testing.assert_allclose(se3.hat(a) @ b, np.cross(a, b), atol=1e-12)


@given(motions, st.integers(0, 2**31))
def test_orthonormalized_removes_rounding(T: Array, seed: int) -> None:
    noisy = T.copy()
    noisy[:3, :3] += np.random.default_rng(seed).normal(0.0, 1e-5, (3, 3))
    repaired = se3.orthonormalized(noisy)
    assert se3.is_rigid(repaired, tolerance=1e-13)
    np.testing.assert_allclose(repaired, T, atol=1e-4)


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0), (np.inf, 0.0, 0.0, 1.0)])
def test_refuses_quaternions_without_direction(quaternion: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="finite and not zero"):
        se3.from_quaternion_xyzw((0.0, 0.0, 0.0), quaternion)


def test_not_rigid() -> None:
    stretched, mirrored, shifted = np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(4)
    stretched[0, 0], shifted[3, 0] = 1.01, 0.1
    for T in (stretched, mirrored, shifted, np.full((4, 4), np.nan), np.eye(3)):
        assert not se3.is_rigid(T)

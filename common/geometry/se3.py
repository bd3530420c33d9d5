"""Rigid motions SE(3) as float64 4x4 matrices: exponential, logarithm, adjoint, inverse.

A twist is ``xi = (rho, phi)``: translation part first (metres), rotation part second (radians). ``T_a_b`` maps
coordinates in ``b`` to coordinates in ``a``. Perturbations are applied on the left: ``exp(xi) @ T``.
"""

import numpy as np
import numpy.typing as npt

Matrix4 = npt.NDArray[np.float64]
Twist = npt.NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-4  # below: Taylor series, whose next term is under 1e-17


def identity() -> Matrix4:
    """The identity motion, float64 [4,4]."""
    return np.eye(4)


def hat(phi: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The skew matrix [3,3] with ``hat(phi) @ x == cross(phi, x)``."""
    x, y, z = phi
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _series(angle_rad: float) -> tuple[float, float, float]:
    """sin(a)/a, (1-cos a)/a^2 and (a-sin a)/a^3."""
    a2 = angle_rad * angle_rad
    if angle_rad < _SMALL_ANGLE_RAD:
        return 1.0 - a2 / 6.0, 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    s, half = np.sin(angle_rad), np.sin(0.5 * angle_rad)
    return float(s / angle_rad), float(2.0 * half * half / a2), float((angle_rad - s) / (a2 * angle_rad))


def exp(xi: Twist) -> Matrix4:
    """The motion [4,4] of twist ``xi`` [6] = (rho m, phi rad)."""
    rho, phi = np.asarray(xi[:3], np.float64), np.asarray(xi[3:], np.float64)
    a, b, c = _series(float(np.linalg.norm(phi)))
    k = hat(phi)
    kk = k @ k
    out = np.eye(4)
    out[:3, :3] += a * k + b * kk
    out[:3, 3] = rho + b * (k @ rho) + c * (kk @ rho)
    return out


def rotation_log(rotation: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The rotation vector phi [3] (rad, norm at most pi) of a rotation matrix [3,3]."""
    w = 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sin_a, cos_a = float(np.linalg.norm(w)), 0.5 * (float(np.trace(rotation)) - 1.0)
    angle = float(np.arctan2(sin_a, cos_a))
    if cos_a > -0.99:
        return w * (angle / sin_a if angle > _SMALL_ANGLE_RAD else 1.0 + angle * angle / 6.0)
    # Near pi the antisymmetric part vanishes: take the axis from the symmetric part, its sign from w.
    axis_outer = (0.5 * (rotation + rotation.T) - cos_a * np.eye(3)) / (1.0 - cos_a)
    column = int(np.argmax(np.diag(axis_outer)))
    axis = axis_outer[:, column] / np.linalg.norm(axis_outer[:, column])
    if float(axis @ w) < 0.0:
        axis = -axis
    return angle * axis


def log(T: Matrix4) -> Twist:
    """The twist [6] = (rho m, phi rad) of a motion [4,4]; the inverse of :func:`exp`."""
    phi = rotation_log(T[:3, :3])
    angle = float(np.linalg.norm(phi))
    k = hat(phi)
    if angle < 1e-3:
        d = 1.0 / 12.0 + angle * angle / 720.0
    else:
        d = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / (angle * angle)
    rho = T[:3, 3] - 0.5 * (k @ T[:3, 3]) + d * (k @ (k @ T[:3, 3]))
    return np.concatenate([rho, phi])


def inverse(T: Matrix4) -> Matrix4:
    """The inverse motion [4,4]."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def adjoint(T: Matrix4) -> npt.NDArray[np.float64]:
    """The adjoint [6,6]: ``T @ exp(xi) @ inverse(T) == exp(adjoint(T) @ xi)``."""
    rotation = T[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    out[:3, 3:] = hat(T[:3, 3]) @ rotation
    return out


def orthonormalized(T: Matrix4) -> Matrix4:
    """The rigid motion nearest to ``T`` [4,4] (rotation by SVD); removes rounding gathered over many products."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    out = np.eye(4)
    out[:3, :3] = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    out[:3, 3] = T[:3, 3]
    return out


def is_rigid(T: Matrix4, *, tolerance: float = 1e-3) -> bool:
    """Whether ``T`` is a finite 4x4 rigid motion within ``tolerance`` (element of R R^T - I)."""
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], (0, 0, 0, 1), atol=1e-9):
        return False
    rotation = T[:3, :3]
    return bool(np.abs(rotation @ rotation.T - np.eye(3)).max() <= tolerance and np.linalg.det(rotation) > 0)


def angle_rad(T: Matrix4) -> float:
    """The rotation angle of ``T`` in radians, 0 to pi."""
    return float(np.linalg.norm(rotation_log(T[:3, :3])))


def quaternion_xyzw(T: Matrix4) -> npt.NDArray[np.float64]:
    """The unit quaternion (x, y, z, w) of the rotation of ``T``, with w >= 0."""
    phi = rotation_log(T[:3, :3])
    angle = float(np.linalg.norm(phi))
    scale = 0.5 * _series(0.5 * angle)[0]
    return np.array([*(scale * phi), np.cos(0.5 * angle)])


def from_quaternion_xyzw(translation: npt.ArrayLike, quaternion: npt.ArrayLike) -> Matrix4:
    """The motion [4,4] of a translation [3] (m) and a quaternion (x, y, z, w), normalised here.

    Raises:
        ValueError: The quaternion is zero or not finite.
    """
    q = np.asarray(quaternion, np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError(f"a quaternion must be finite and not zero, got {q.tolist()}")
    x, y, z, w = q / norm
    out = np.eye(4)
    out[:3, :3] += 2.0 * (w * hat(np.array([x, y, z])) + hat(np.array([x, y, z])) @ hat(np.array([x, y, z])))
    out[:3, 3] = np.asarray(translation, np.float64)
    return out

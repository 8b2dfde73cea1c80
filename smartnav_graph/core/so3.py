"""Rotations row by row: products, exponential map, quaternions, the Jacobians of SO(3); the best rotation.

Source: Forster, Carlone, Dellaert, Scaramuzza (2017), On-manifold preintegration, IEEE T-RO 33(1), III; Umeyama (1991),
Least-squares estimation of transformation parameters between two point patterns, IEEE PAMI 13(4), for `best_rotation`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.timebase import seconds_since

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


def _rotations() -> type[Rotation]:
    """The class of scipy, whose module takes 0.2 s to load: help and lists do without."""
    from scipy.spatial import transform

    found: type[Rotation] = transform.Rotation
    return found


def skew(v: Floats) -> Floats:
    """Cross-product matrices (m, 3, 3) of vectors (m, 3): skew(a) b = a x b."""
    zero = np.zeros(len(v))
    rows = [zero, -v[:, 2], v[:, 1], v[:, 2], zero, -v[:, 0], -v[:, 1], v[:, 0], zero]
    return np.stack(rows, axis=-1).reshape(-1, 3, 3)


def exp(w: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) rad."""
    return np.asarray(_rotations().from_rotvec(w.reshape(-1, 3)).as_matrix()).reshape(*w.shape, 3)


def log(R: Floats) -> Floats:
    """Rotation vectors (..., 3) rad, not longer than pi, of rotation matrices (..., 3, 3)."""
    return np.asarray(_rotations().from_matrix(R.reshape(-1, 3, 3)).as_rotvec()).reshape(R.shape[:-1])


def chained(turns: Floats) -> Rotation:
    """Products Exp(turns[0]) ... Exp(turns[k]), each k (n,), of rotation vectors (n, 3) rad."""
    q = _rotations().from_rotvec(turns).as_quat().T.copy()
    count = 1
    while count < q.shape[1]:  # each holds the product of `count` turns
        (a, b, c, d), (x, y, z, w) = q[:, :-count], q[:, count:]
        q[:, count:] = np.stack(
            [
                d * x + a * w + b * z - c * y,
                d * y - a * z + b * w + c * x,
                d * z + a * y - b * x + c * w,
                d * w - a * x - b * y - c * z,
            ]
        )
        count *= 2
    return _rotations().from_quat(q.T)


def rotate(R: Floats, v: Floats) -> Floats:
    """R v, row by row: (m, 3, 3), (m, 3) -> (m, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", R, v))


def rotate_back(R: Floats, v: Floats) -> Floats:
    """R^T v, row by row: (m, 3, 3), (m, 3) -> (m, 3)."""
    return np.asarray(np.einsum("nji,nj->ni", R, v))


def quaternion(R: Floats) -> Floats:
    """Unit quaternions (m, 4) w x y z, w >= 0, of rotation matrices (m, 3, 3)."""
    return np.asarray(_rotations().from_matrix(R).as_quat(canonical=True)[:, [3, 0, 1, 2]])


def from_quaternion(q: Floats) -> Floats:
    """Rotation matrices (m, 3, 3) of quaternions (m, 4) w x y z of any norm but zero."""
    return np.asarray(_rotations().from_quat(q[:, [1, 2, 3, 0]]).as_matrix())


def slerp(t_ns: Times, at_ns: Times, R: Floats) -> Floats:
    """Rotation matrices (n, 3, 3) at `t_ns` (n,), interpolated between R (m, 3, 3) at `at_ns` (m,).

    Outside the span the end values hold.
    """
    if len(R) == 1:
        return np.repeat(R, len(t_ns), axis=0)
    from scipy.spatial.transform import Slerp

    inside = np.clip(t_ns, at_ns[0], at_ns[-1])
    t0 = int(at_ns[0])
    turn = Slerp(seconds_since(at_ns, t0), _rotations().from_matrix(R))
    return np.asarray(turn(seconds_since(inside, t0)).as_matrix())


def left_jacobian_inverse(theta: Floats) -> Floats:
    """(m, 3, 3): Log(Exp(d) Exp(theta)) = theta + J d, for rotation vectors theta (m, 3) below a full turn."""
    square = (theta**2).sum(axis=1)
    angle = np.sqrt(np.maximum(square, 1e-16))
    # (1 - angle / 2 cot(angle / 2)) / angle^2, by its series where the angle is small
    factor = np.where(square < 1e-6, 1.0 / 12.0, (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2)
    cross = skew(theta)
    return np.asarray(np.eye(3) - 0.5 * cross + factor[:, None, None] * cross @ cross)


def right_jacobian(theta: Floats) -> Floats:
    """(m, 3, 3): Exp(theta + d) = Exp(theta) Exp(J d), for rotation vectors theta (m, 3)."""
    square = (theta**2).sum(axis=1)
    angle = np.sqrt(np.maximum(square, 1e-16))
    one = np.where(square < 1e-6, 0.5, (1.0 - np.cos(angle)) / angle**2)
    two = np.where(square < 1e-6, 1.0 / 6.0, (angle - np.sin(angle)) / angle**3)
    cross = skew(theta)
    return np.asarray(np.eye(3) - one[:, None, None] * cross + two[:, None, None] * cross @ cross)


def is_rotation(R: Floats, atol: float = 1e-6) -> bool:
    """Whether R (3, 3) is a rotation matrix."""
    return bool(np.allclose(R @ R.T, np.eye(3), atol=atol) and np.linalg.det(R) > 0)


def across(directions: Floats) -> Floats:
    """Two unit vectors (m, 3, 2) perpendicular to each direction (m, 3) and to each other."""
    return np.swapaxes(np.linalg.svd(directions[:, None, :])[2][:, 1:], 1, 2)


def best_rotation(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """The rotation R (3, 3) that minimises sum |y - R x|^2 over points x, y (n, 3), each minus its mean.

    Also returned: the singular values (3,) of sum y x^T, the last with the sign of det; the least squares scale of
    R x is their sum over sum |x|^2. Where the second is zero, the points lie on a line and R is not determined.
    """
    u, d, vt = np.linalg.svd((y - y.mean(axis=0)).T @ (x - x.mean(axis=0)))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])  # no reflection
    return np.asarray(u @ np.diag(sign) @ vt), np.asarray(d * sign)

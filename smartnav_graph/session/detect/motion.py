"""The motion that the inertial data show by themselves: heading and horizontal displacement, in a frame of unknown yaw.

Rates turn the body into a frame that does not turn. There specific force is gravity, which stays, plus accelerations,
which average out: its mean over a minute, forward and backward so that nothing is delayed, is the vertical. A constant
gyro bias makes that mean turn; it is found by least squares. About the vertical, bias is the median rate.

Source: Mahony, Hamel, Pflimlin (2008), Nonlinear complementary filters on SO(3), IEEE TAC 53(5), for the principle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import chained
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import Imu

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Complexes = NDArray[np.complex128]
_Number = TypeVar("_Number", np.float64, np.complex128)

STEP_S = 0.05
_LEVEL_S, _BIAS_S = 60.0, 15.0  # standard deviations of the means that give the vertical, and its turn
_PER_SECOND = round(1.0 / STEP_S)
_MOST_BIAS = 0.15  # rad/s about the vertical; a larger median rate is a motion
_LENGTH_S = (10.0, 1e5)


@dataclass(frozen=True)
class InertialMotion:
    """Samples in the middle of steps of `STEP_S` seconds, the first of which begins at `start_ns`.

    heading (n,) rad of the body about the vertical, from an unknown zero; displacement (n,) m, complex: east + i north
    turned by an unknown yaw, up to a polynomial of start, velocity and what tilt and biases leave; height (n,) m
    """

    start_ns: int
    heading: Floats
    displacement: Complexes
    height: Floats

    @property
    def length_s(self) -> float:
        """Length, s."""
        return len(self.heading) * STEP_S


def levelled_motion(imu: Imu) -> InertialMotion | None:
    """Motion by the inertial data; None for less than 10 s or more than a day."""
    return motion_of(int(imu.t_ns[0]), *step_means(imu)) if covered(imu) else None


def covered(imu: Imu) -> bool:
    """Whether the inertial data last more than 10 s and less than a day."""
    return bool(_LENGTH_S[0] < (int(imu.t_ns[-1]) - int(imu.t_ns[0])) / NS < _LENGTH_S[1])


def motion_of(start_ns: int, gyro: Floats, accel: Floats) -> InertialMotion:
    """Motion by the means of gyro and accel (n, 3) over steps, see `step_means`."""
    gyro = gyro - _constant_bias(gyro, accel)
    R = _attitude(gyro)
    force = R.apply(accel)
    up = _vertical(force, _LEVEL_S)
    upright = _to_vertical(up.mean(axis=0)[None])
    level = _to_vertical(upright.apply(up)).apply(upright.apply(force))
    acceleration: Complexes = level[:, 0] + 1j * level[:, 1]
    rate = np.einsum("ij,ij->i", R.apply(gyro), up)
    velocity = _integral(acceleration - acceleration.mean())
    climb = _integral(level[:, 2] - level[:, 2].mean())
    return InertialMotion(start_ns, _integral(rate), _integral(velocity), _integral(climb))


def _integral(values: NDArray[_Number]) -> NDArray[_Number]:
    """Integral (n,) of means over steps, in the middle of each step."""
    return np.asarray((np.cumsum(values) - 0.5 * values) * STEP_S, dtype=values.dtype)


def step_means(imu: Imu) -> tuple[Floats, Floats]:
    """Means (n, 3) of gyro and accel over every `STEP_S` seconds, linearly interpolated where there are no samples."""
    of = (imu.t_ns - imu.t_ns[0]) // round(STEP_S * NS)
    used, first, count = np.unique(of, return_index=True, return_counts=True)
    steps = np.arange(used[-1] + 1)

    def mean(rows: Floats) -> Floats:
        known = np.add.reduceat(rows, first) / count[:, None]
        return np.stack([np.interp(steps, used, column) for column in known.T], axis=1)

    return mean(imu.gyro), mean(imu.accel)


def _attitude(gyro: Floats) -> Rotation:
    """Attitude (n,) in the middle of each step, in a frame that does not turn."""
    from scipy.spatial.transform import Rotation

    return chained(STEP_S * gyro) * Rotation.from_rotvec(-0.5 * STEP_S * gyro)


def _vertical(force: Floats, width_s: float) -> Floats:
    """Unit vectors (n, 3) along the mean of specific force (n, 3) in a frame that does not turn."""
    from scipy.ndimage import gaussian_filter1d

    seconds = np.arange(0, len(force), _PER_SECOND)
    mean = np.add.reduceat(force, seconds) / np.diff(np.append(seconds, len(force)))[:, None]
    up = gaussian_filter1d(mean, width_s, axis=0, mode="nearest", truncate=3.0)
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    at, steps = seconds + 0.5 * (_PER_SECOND - 1), np.arange(len(force))
    return np.stack([np.interp(steps, at, column) for column in up.T], axis=1)


def _to_vertical(up: Floats) -> Rotation:
    """The smallest rotations that turn vectors (n, 3) to the third axis."""
    from scipy.spatial.transform import Rotation

    axis = np.stack([up[:, 1], -up[:, 0], np.zeros(len(up))], axis=1)
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    return Rotation.from_rotvec(axis / np.maximum(sine, 1e-12) * np.arctan2(sine, up[:, 2:]))


def _constant_bias(gyro: Floats, accel: Floats) -> Floats:
    """Gyro bias (3,) rad/s: what makes the vertical u turn, du/dt = (R b) x u, and the median rate about it."""
    bias = np.zeros(3)
    for _ in range(3):
        R = _attitude(gyro - bias)
        up = _vertical(R.apply(accel), _BIAS_S)
        in_body = R.inv().apply(up)
        rate = float(np.median(np.einsum("ij,ij->i", gyro - bias, in_body)))
        if abs(rate) < _MOST_BIAS:
            bias += rate * in_body.mean(axis=0)
        up, axes = up[::_PER_SECOND], R.as_matrix()[::_PER_SECOND].transpose(0, 2, 1)
        A = np.cross(axes, up[:, None, :]).transpose(0, 2, 1).reshape(-1, 3)
        turn = np.gradient(up, axis=0).reshape(-1)
        # what lies along the vertical does not turn it: held
        bias += np.linalg.solve(A.T @ A + 0.1 * len(up) * np.eye(3), A.T @ turn)
    return bias

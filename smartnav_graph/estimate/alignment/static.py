"""What the first seconds say by geometry alone: a rest, and the attitude that lays the inertial curve on the fixes.

Source of `kabsch_attitude`: Wahba's problem (1965), solved as by Kabsch (1976).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS, seconds_since
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.streams import Imu

# Specific force (m/s^2) that a rest may differ from gravity by: the bias. Sigma of a mean rate, rad/s, at least.
LEVEL, LEAST_RATE_SIGMA = 0.6, 3e-4


@dataclass(frozen=True)
class Rest:
    """A rest at the start: mean specific force (3,) and rate (3,), their scatter, and how long it lasted."""

    accel: Floats
    gyro: Floats
    gyro_sigma: float
    length_s: float


def find_rest(imu: Imu, start_ns: int, gravity: float, shortest_s: float, longest_s: float = 30.0) -> Rest | None:
    """The rest that begins at `start_ns`, or None.

    Half-second pieces are at rest while rate and specific force scatter little, and their means stay with those of
    the first piece. Steady travel looks alike: fixes must be asked too.
    """
    first = int(np.searchsorted(imu.t_ns, start_ns))
    t = seconds_since(imu.t_ns[first:], start_ns)
    t = t[t <= longest_s]
    if len(t) < 4 or t[-1] < shortest_s:
        return None
    accel, gyro = imu.accel[first : first + len(t)], imu.gyro[first : first + len(t)]
    edges = np.searchsorted(t, np.arange(0.0, t[-1], 0.5))
    last = 0
    for i, j in pairwise(edges):
        if j - i < 3:
            break
        quiet = gyro[i:j].std(axis=0).max() < 0.01 and accel[i:j].std(axis=0).max() < 0.12
        steady = np.abs(accel[i:j].mean(axis=0) - accel[: edges[1]].mean(axis=0)).max() < 0.08
        level = abs(np.linalg.norm(accel[i:j].mean(axis=0)) - gravity) < LEVEL
        still = np.abs(gyro[i:j].mean(axis=0) - gyro[: edges[1]].mean(axis=0)).max() < 0.005
        if not (quiet and steady and level and still):
            break
        last = int(j)
    if last == 0 or t[last - 1] < shortest_s:
        return None
    return _rest(accel[:last], gyro[:last], float(t[last - 1]))


def rest_over(imu: Imu, start_ns: int, end_ns: int, gravity: float) -> Rest | None:
    """The rest that is known to last from `start_ns` to `end_ns`, however much a motor shakes it; None where the mean
    specific force is not gravity."""
    inside = slice(np.searchsorted(imu.t_ns, start_ns), np.searchsorted(imu.t_ns, end_ns, side="right"))
    accel, gyro = imu.accel[inside], imu.gyro[inside]
    if len(accel) < 4 or abs(np.linalg.norm(accel.mean(axis=0)) - gravity) > LEVEL:
        return None
    return _rest(accel, gyro, (end_ns - start_ns) / NS)


def _rest(accel: Floats, gyro: Floats, length_s: float) -> Rest:
    sigma = max(float(gyro.std(axis=0).max()) / np.sqrt(len(gyro)), LEAST_RATE_SIGMA)
    return Rest(accel.mean(axis=0), gyro.mean(axis=0), sigma, length_s)


def kabsch_attitude(curve: Floats, fixes: Floats, t: Floats, gravity: float) -> tuple[Floats, Floats, Floats]:
    """Attitude, position and velocity at t = 0 from an inertial curve and fixes.

    fix_k = p0 + v0 t_k - g t_k^2 / 2 + R curve_k; position and velocity are projected out, R solves what is left.

    Parameters
    ----------
    curve : (n, 3) doubly integrated specific force in the first body frame; fixes : (n, 3) nav m; t : (n,) s, n >= 4
    """
    fall, design = np.zeros_like(fixes), np.stack([np.ones_like(t), t], axis=-1)
    fall[:, 2] = -0.5 * gravity * t**2
    basis, _ = np.linalg.qr(design)
    target, source = fixes - fall, curve

    def project(rows: Floats) -> Floats:
        return rows - basis @ (basis.T @ rows)

    u, _, vt = np.linalg.svd(project(target).T @ project(source))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    position, velocity = np.linalg.lstsq(design, target - source @ R.T, rcond=None)[0]
    return R, position, velocity


def inertial_motion(windows: Sequence[Window], bias: gtsam.imuBias.ConstantBias) -> tuple[Floats, Floats]:
    """Specific force integrated twice and once, (n, 3) each, at the end of each window, in the first body frame."""
    pim = gtsam.PreintegratedImuMeasurements(gtsam.PreintegrationParams.MakeSharedU(0.0), bias)
    integrate, place, speed = pim.integrateMeasurement, [], []
    for window in windows:
        for accel, gyro, dt in zip(window.accel, window.gyro, window.dt.tolist(), strict=True):
            integrate(accel, gyro, dt)
        place.append(pim.deltaPij())
        speed.append(pim.deltaVij())
    return np.array(place).reshape(-1, 3), np.array(speed).reshape(-1, 3)


def inertial_curve(windows: Sequence[Window], bias: gtsam.imuBias.ConstantBias) -> Floats:
    """Doubly integrated specific force (n, 3) at the end of each window, in the first body frame."""
    return inertial_motion(windows, bias)[0]

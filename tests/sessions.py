"""Simulated sessions and comparisons with their truth, for tests of the whole estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.graph.solution import Solution
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import ControlPoint
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.fixes import GnssModel
from smartnav_graph.simulation.scenarios import Scenario
from smartnav_graph.simulation.trajectory import Trajectory


def recorded(
    motion: Callable[[float], Trajectory] = motions.figure_eight,
    seconds: float = 60.0,
    seed: int = 0,
    profile: str = "galaxy-s2",
    **gnss: Any,
) -> Session:
    """A phone on `motion`, fixes at 1 Hz with a white sigma of 1 m unless told otherwise; the noise is calibrated."""
    model = GnssModel(**({"white_m": 1.0} | gnss))
    return Scenario("test", seconds, lambda s, rng: motion(s), profile=profile, gnss=model)(seed)


def with_imu(session: Session, **changes: Any) -> Session:
    return session.replace(imu=replace(session.imu, **changes))


def with_gnss(session: Session, **changes: Any) -> Session:
    return session.replace(gnss=replace(session.gnss, **changes))


def shifted(session: Session, seconds: float) -> Session:
    """The fixes on another clock."""
    return with_gnss(session, t_ns=session.gnss.t_ns + round(seconds * NS))


def on_control(session: Session, rows: Any, sigma_m: float, seed: int) -> ControlPoint:
    """Control points under the device at the epochs of these fixes."""
    t_ns = session.gnss.t_ns[rows]
    enu = truth(session, t_ns)[1] + np.random.default_rng(seed).normal(0.0, sigma_m, (len(t_ns), 3))
    names = np.array([f"P{i}" for i in range(len(t_ns))], dtype=object)
    return ControlPoint(
        t_ns=t_ns, lla=session.frame.lla_from_nav(enu), point_id=names, sigma=np.full((len(t_ns), 3), sigma_m)
    )


def truth(session: Session, t_ns: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True nav_R_body, nav_t_body, nav_v_body and bias (accelerometer, gyroscope) at stamps the reference holds."""
    reference = session.reference
    rows = np.searchsorted(reference.t_ns, t_ns)
    assert np.array_equal(reference.t_ns[rows], t_ns)
    R = Rotation.from_quat(reference.quat[rows][:, [1, 2, 3, 0]]).as_matrix()
    bias = np.concatenate([reference.accel_bias[rows], reference.gyro_bias[rows]], axis=1)
    return R, reference.enu[rows], reference.velocity[rows], bias


def positions(session: Session, t_ns: Any) -> np.ndarray:
    """True positions (n, 3), between the stamps of a 10 Hz reference good to millimetres."""
    return interpolate(t_ns, session.reference.t_ns, session.reference.enu)


def turned_deg(one: Any, other: Any) -> np.ndarray:
    """Angles (n,) between two stacks of rotations, degrees."""
    return np.degrees(Rotation.from_matrix(np.swapaxes(one, 1, 2) @ other).magnitude())


def rms(session: Session, solution: Solution) -> tuple[float, float]:
    """Root mean square of the position error (m) and of the heading error (deg), at all stamps of the truth that the
    solution has."""
    known = np.isin(solution.t_ns, session.reference.t_ns)
    R, p, _, _ = truth(session, solution.t_ns[known])
    off = p - solution.nav_t_body[known]
    yaw = Rotation.from_matrix(R @ solution.nav_R_body[known].transpose(0, 2, 1)).as_rotvec()[:, 2]
    return float(np.sqrt((off**2).sum(axis=1).mean())), float(np.degrees(np.sqrt((yaw**2).mean())))

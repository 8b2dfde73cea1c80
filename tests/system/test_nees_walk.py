"""Is the covariance of a walk consistent with steps alone, and with a barometer alone, beside a few points?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_nees import average_nees, outside

from smartnav_graph.core.timebase import interpolate
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import ControlPoint
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.scenarios import Scenario
from smartnav_graph.simulation.sensors import BarometerModel

SEEDS = 15


def walk(seed: int, every_s: float, sigma: tuple[float, float, float], baro: BarometerModel | None = None) -> Session:
    """40 s on foot; a point every so often, as good as `sigma` (m)."""
    session = Scenario("walk", 40.0, motions.walk, "foot", "galaxy-s2", barometer=baro)(seed)
    t_ns = session.imu.t_ns[np.arange(100, len(session.imu) - 1, round(100 * every_s))]
    sigmas = np.tile(sigma, (len(t_ns), 1))
    off = np.random.default_rng((seed, 98)).standard_normal(sigmas.shape) * sigmas
    place = interpolate(t_ns, session.reference.t_ns, session.reference.enu) + off
    names = np.array([f"P{k}" for k in range(len(t_ns))], dtype=object)
    return session.replace(static=None, control=ControlPoint(t_ns=t_ns, enu=place, sigma=sigmas, point_id=names))


def with_steps(seed: int) -> Session:
    """Labels good to 0.7 m. Simulated paces are steadier than people's."""
    session = walk(seed, 8.0, (0.7, 0.7, 0.2))
    steady = replace(session.calibration.step_noise, step_sigma=0.12)
    return session.replace(calibration=replace(session.calibration, step_noise=steady))


def with_barometer(seed: int) -> Session:
    """Good points that say little of the height; pressure that walks by 2.5 cm/sqrt(s)."""
    return walk(seed, 5.0, (0.1, 0.1, 5.0), BarometerModel(walk_hpa=0.003))


def test_steps_alone():
    assert outside(average_nees(with_steps, SEEDS), SEEDS) == {}


def test_barometer_alone():
    assert outside(average_nees(with_barometer, SEEDS), SEEDS) == {}


def test_pressure_that_walks_more_than_stated_is_caught():
    def bold(seed: int) -> Session:
        session = walk(seed, 5.0, (0.1, 0.1, 5.0), BarometerModel(walk_hpa=0.03))
        reported = replace(session.calibration.barometer_noise, pressure_walk=0.001, pressure_sigma=0.01)
        return session.replace(calibration=replace(session.calibration, barometer_noise=reported))

    bad = outside(average_nees(bold, 6), 6)
    assert min(bad["velocity", fraction] for fraction in (0.1, 0.5, 0.9)) > 4.0

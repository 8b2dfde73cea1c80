"""Consistency of the covariance: average NEES over fixed seeds, against 99.8 % bounds (Bar-Shalom 2001, 5.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from differences import average_nees_bounds
from scipy.spatial.transform import Rotation
from sessions import on_control, positions, recorded, truth, with_gnss

import smartnav_graph as sn
from smartnav_graph.estimate import preparation
from smartnav_graph.estimate.reweight import update
from smartnav_graph.evaluation.metrics import nees
from smartnav_graph.factors import imu
from smartnav_graph.session.session import Session
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.fixes import GnssModel, PoseFixModel
from smartnav_graph.simulation.scenarios import Scenario
from smartnav_graph.simulation.sensors import BarometerModel, MagnetometerModel, SpeedModel

PARTS = {
    "rotation": slice(0, 3),
    "yaw": slice(2, 3),
    "position": slice(3, 6),
    "velocity": slice(6, 9),
    "accel bias": slice(9, 12),
    "gyro bias": slice(12, 15),
}
FRACTIONS = (0.1, 0.5, 0.9)


def errors(session: Session, solution: sn.Solution, row: int) -> np.ndarray:
    """True minus estimated state (15,) at one keyframe, in the order and axes of the covariance."""
    R, p, v, bias = (part[0] for part in truth(session, solution.t_ns[row : row + 1]))
    return np.concatenate(
        [
            Rotation.from_matrix(R @ solution.nav_R_body[row].T).as_rotvec(),
            p - solution.nav_t_body[row],
            v - solution.nav_v_body[row],
            bias - np.r_[solution.accel_bias[row], solution.gyro_bias[row]],
        ]
    )


def average_nees(make: Callable[[int], Session], seeds: int = 30) -> dict[tuple[str, float], float]:
    """Mean NEES over the seeds, divided by its dimension, by part and fraction of the session."""
    found: dict[tuple[str, float], list[float]] = {}
    for seed in range(seeds):
        session = make(seed)
        solution = sn.smooth(session)
        for fraction in FRACTIONS:
            known = np.flatnonzero(np.isin(solution.t_ns, session.reference.t_ns))
            row = int(known[round(fraction * (len(known) - 1))])
            e, P = errors(session, solution, row), solution.covariance[row]
            for name, part in PARTS.items():
                one = nees(e[None, part], P[None, part, part])[0] / (part.stop - part.start)
                found.setdefault((name, fraction), []).append(float(one))
    return {which: float(np.mean(values)) for which, values in found.items()}


def outside(averages: dict[tuple[str, float], float], seeds: int = 30) -> dict[tuple[str, float], float]:
    """The averages that a consistent covariance would not give."""
    bad = {}
    for (name, fraction), value in averages.items():
        dof = PARTS[name].stop - PARTS[name].start
        low, high = (bound / dof for bound in average_nees_bounds(dof, seeds, 0.998))
        if not low <= value <= high:
            bad[name, fraction] = value
    return bad


# --- every sensor alone, with what it minimally needs (vehicles on wheels: test_nees_car) -----------------------------

SPARSE = GnssModel(rate_hz=0.1, white_m=1.0)
# Where only fixes tell the heading: under those of a metre it stays open by 8 deg, and a velocity that is known to 3 %
# along and across the body then lies on an arc, which no linear covariance in nav axes describes.
SHARP = GnssModel(rate_hz=0.1, white_m=0.3)


def in_hand(**sensors: Any) -> Scenario:
    """A phone carried round a figure eight that is under way too soon to have a rest."""
    return Scenario("test", 60.0, lambda s, rng: motions.figure_eight(s, rest=0.3), profile="galaxy-s2", **sensors)


def on_foot(**sensors: Any) -> Scenario:
    """A walk at a steady pace."""
    motion = partial(motions.walk, paces=(1.35, 1.35))
    return Scenario("test", 90.0, motion, "foot", "galaxy-s2", **sensors)


def on_wheels(**sensors: Any) -> Scenario:
    """A trolley that stops on a surveyed point in the middle of every side; nobody says that it is one."""
    return Scenario("test", 160.0, lambda s, rng: motions.trolley(1, rest=8.0), profile="galaxy-s2", **sensors)


ALONE: dict[str, Callable[[int], Session]] = {
    "pose fixes": in_hand(pose_fixes=PoseFixModel(every_s=2.0)),
    "position fixes": in_hand(pose_fixes=PoseFixModel(every_s=2.0, sigma_rad=0.0)),
    "standstills": on_wheels(control=True),
    "magnetometer": in_hand(gnss=SPARSE, magnetometer=MagnetometerModel(hard_iron_sigma_ut=30.0, sigma_ut=3.0)),
    "barometer": in_hand(gnss=SPARSE, barometer=BarometerModel(walk_hpa=0.01)),
    "velocity": in_hand(gnss=SHARP, velocity=SpeedModel(sigma_m_s=0.1)),
    "gnss velocity": in_hand(gnss=GnssModel(white_m=3.0, velocity_m_s=0.1)),
    "gnss clock": in_hand(gnss=GnssModel(white_m=0.3, offset_s=0.1)),
    "correlated gnss error": in_hand(gnss=GnssModel(white_m=1.0, markov_m=3.0, markov_s=30.0)),
    "steps": on_foot(gnss=SPARSE),
    "all in a car": partial(sn.simulate, "car-all-2min"),
    "all on foot": partial(sn.simulate, "walk-all-2min"),
}


# A rest in a simulation is better than the sigma of a real one: these may be less sure than they could be.
RESTING = ("standstills", "steps")


def too_sure(bad: dict[tuple[str, float], float]) -> dict[tuple[str, float], float]:
    """The averages above their bound."""
    return {which: value for which, value in bad.items() if value > 1.0}


def bold(session: Session) -> Session:
    """The same recording whose sensors claim half of their sigma."""
    changes: dict[str, Any] = {}
    for name, column in (
        ("pose_fixes", "sigma"),
        ("pose_fixes", "sigma_rot"),
        ("velocity", "sigma"),
        ("wheel", "sigma"),
    ):
        stream = changes.get(name, getattr(session, name))
        if stream is not None and getattr(stream, column) is not None:
            changes[name] = replace(stream, **{column: getattr(stream, column) / 2})
    if session.gnss is not None and session.gnss.velocity is not None:
        changes["gnss"] = replace(session.gnss, sigma_velocity=session.gnss.sigma_velocity / 2)
    noise = session.calibration.magnetometer_noise
    mag = replace(noise, sigma_ut=noise.sigma_ut / 2)
    return session.replace(calibration=replace(session.calibration, magnetometer_noise=mag), **changes)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ALONE)
def test_a_sensor_alone_and_all_together(sensor):
    bad = outside(average_nees(ALONE[sensor]))
    assert (too_sure(bad) if sensor in RESTING else bad) == {}


def test_ten_recordings_with_a_magnetometer():
    """The quick one of the tests above: heading by a magnetometer with 30 uT of hard iron."""
    assert outside(average_nees(ALONE["magnetometer"], 10), 10) == {}


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["pose fixes", "magnetometer", "velocity", "gnss velocity", "all on foot"])
def test_a_sensor_that_claims_half_its_sigma_is_caught(sensor):
    assert too_sure(outside(average_nees(lambda seed: bold(ALONE[sensor](seed)), 15), 15))


def control_only(seed: int) -> Session:
    """No fixes, a surveyed point of 5 cm every five seconds."""
    session = sn.simulate("figure-eight-60s", seed)
    points = on_control(session, slice(0, None, 5), 0.05, seed)
    return session.replace(gnss=None, sensors={}, control=points)


def test_bounds_are_those_of_thirty_samples():
    assert np.array(average_nees_bounds(3, 30, 0.998)) / 3 == pytest.approx([0.60, 1.52], abs=0.01)


def test_fixes_alone():
    """The covariance of rotations holds scale errors of the class, which the simulated device does not have."""
    bad = outside(average_nees(lambda seed: sn.simulate("figure-eight-60s", seed)))
    assert too_sure(bad) == {}
    assert all(part == "rotation" and value > 0.5 for (part, _), value in bad.items())


def test_control_points_alone():
    bad = outside(average_nees(control_only))
    # a rest claims a centimetre a second, and this device at rest has none at all
    assert {which for which, value in bad.items() if which[0] != "velocity" or value > 1.0} == set()


def test_halved_sigmas_are_caught(monkeypatch):
    """Fixes that claim half their noise, and are believed: the position is then four times as wrong as its covariance
    says."""
    monkeypatch.setattr(preparation, "CLAIM", np.inf)
    monkeypatch.setattr(update, "TAILS", 0.0)

    def bold(seed: int) -> Session:
        session = recorded(seed=seed)
        return with_gnss(session, sigma=session.gnss.sigma / 2)

    bad = outside(average_nees(bold, 10), 10)
    assert {("position", fraction) for fraction in FRACTIONS} <= set(bad)
    assert min(bad["position", fraction] for fraction in FRACTIONS) > 2.0


def test_halved_inertial_noise_is_caught(monkeypatch):
    """Where the samples were not looked at: they show it before anything is estimated."""
    monkeypatch.setattr(imu, "NOISIER", np.inf)

    def bold(seed: int) -> Session:
        session = control_only(seed)
        noise = session.calibration.imu_noise
        less = replace(noise, **{name: getattr(noise, name) / 2 for name in noise.__dataclass_fields__})
        return session.replace(calibration=replace(session.calibration, imu_noise=less))

    assert len(outside(average_nees(bold, 10), 10)) >= 6


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["phone-car-5min", "car-10min"])
def test_long_drives(scenario):
    """Positions are as consistent with correlated GNSS errors (4 m, 60 s) as with white ones. Velocities are better
    than their sigmas where a car slips less than its constraint allows for."""
    bad = outside(average_nees(lambda seed: sn.simulate(scenario, seed)))
    assert {which for which, value in bad.items() if which[0] != "velocity" or value > 1.0} == set()


def test_dead_reckoning_grows_as_its_errors_do():
    """30 recordings from a rest without any fix: RMS error over RMS sigma, horizontal and vertical.

    A levelled start is off by its accelerometer bias, and both errors cancel until the device turns: zero velocity
    over the rest ties the one to the other.
    """
    at_s, squares, variances = (10.0, 25.0, 50.0), [], []
    for seed in range(30):
        session = recorded(seed=seed).replace(gnss=None)
        solution = sn.smooth(session)
        rows = np.searchsorted(solution.seconds, at_s)
        off = solution.nav_t_body[rows] - positions(session, solution.t_ns[rows])
        squares.append(off**2)
        variances.append(solution.sigmas[rows, 3:6] ** 2)
    ratio = np.sqrt(np.mean(squares, axis=0) / np.mean(variances, axis=0))  # (3 times, 3 axes)
    low, high = (np.sqrt(bound) for bound in average_nees_bounds(1, 30, 0.998))
    assert ratio.max() < high
    assert ratio.min() > low
    growth = np.sqrt(np.mean(variances, axis=0))
    assert (growth[1] > 3 * growth[0]).all() and (growth[2] > 3 * growth[1]).all()

"""Attitude without any fix: gyro, gravity and the Earth's field, with iron and biases that nobody knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import smartnav_graph as sn
from smartnav_graph.session.streams import Reference
from smartnav_graph.simulation.scenarios import Scenario, motions
from smartnav_graph.simulation.sensors import MagnetometerModel

OPEN = "0,0,0,0,1,180"  # somewhere, heading anywhere


def error_deg(reference: Reference, solution: sn.Solution, *, turn_out: bool) -> np.ndarray:
    """Rotation angles (n,) between solution and reference, after the best turn about the vertical where asked."""
    t, at = (reference.t_ns - solution.t0_ns) / 1e9, solution.seconds
    inside = (t >= at[0]) & (t <= at[-1])
    truth = Rotation.from_quat(reference.quat[inside][:, [1, 2, 3, 0]])
    found = Slerp(at, Rotation.from_matrix(solution.nav_R_body))(t[inside])
    if turn_out:
        apart = (truth * found.inv()).as_matrix().sum(axis=0)
        found = Rotation.from_euler("z", np.arctan2(apart[1, 0] - apart[0, 1], apart[0, 0] + apart[1, 1])) * found
    return np.degrees((truth * found.inv()).magnitude())


# The prototype had 2.05 and 1.37 to 2.68 deg, the phones themselves 3.0 and 6.7.
@pytest.mark.parametrize(
    ("recording", "mean_deg"),
    [("android/Jakob_Nexus5_NoDist_Texting", 2.2), ("ios/Guillaume_iPhone5_NoDist_Texting", 1.9)],
)
def test_phones_under_motion_capture(dataset, recording, mean_deg):
    session = sn.load(dataset("phone_mocap_tyrex") / recording)
    run = sn.run(session, initial=OPEN, rate="20")
    assert error_deg(session.reference, run.solution, turn_out=True).mean() < mean_deg
    assert run.summary["converged"]
    field = run.summary["states"]["magnetometer_field_ut"]["value"]
    assert field[0] == pytest.approx(22.5, abs=1.5)  # uT, horizontal field near Grenoble


def walk(seed: int) -> sn.Session:
    """A minute of a walk through iron, its magnetometer with 100 uT of its own."""
    iron = ((15.0, 4.0, 20.0), (35.0, 5.0, 20.0))
    scenario = Scenario(
        "test", 60.0, motions.walk, "foot", "galaxy-s2", magnetometer=MagnetometerModel(10.0, 0.5, 100.0, iron)
    )
    session = scenario(seed, calibrated=False)
    return session.replace(static=None)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_walk_through_iron(seed):
    """True north, without any offset taken out."""
    session = walk(seed)
    run = sn.run(session, initial=OPEN, rate="20")
    error = error_deg(session.reference, run.solution, turn_out=False)
    sigma = run.solution.sigma_heading_deg
    assert error.mean() < 6.0 and error.max() < 12.0
    assert sigma.max() < 8.0 and error.mean() < 3.0 * sigma.mean()


def test_without_the_magnetometer_north_stays_open():
    run = sn.run(walk(0), initial=OPEN, sensors=("-magnetometer",))
    assert run.solution.sigma_heading_deg.min() > 45.0


def test_a_magnetometer_turned_over_is_not_believed_blindly():
    """Readings with two axes of the wrong sign fit no field: the rows are far outside of their sigma, and reported."""
    session = walk(1)
    wrong = session.magnetometer.field_ut * [1.0, -1.0, -1.0]
    run = sn.run(session.replace(magnetometer=replace(session.magnetometer, field_ut=wrong)), initial=OPEN)
    residuals = run.solution.residuals
    rows = residuals.of("magnetometer")
    consistent = sn.run(session, initial=OPEN).solution.residuals
    there = consistent.of("magnetometer")
    assert np.square(residuals.whitened[rows]).mean() > 3.0 * np.square(consistent.whitened[there]).mean()

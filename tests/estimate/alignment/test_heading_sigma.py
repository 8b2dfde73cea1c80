"""The sigma of the first heading covers its error where the errors of the fixes are correlated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.core import frames
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.simulation.scenarios import simulate


def error_and_sigma(session, start_s):
    """Of the first heading, deg."""
    problem = prepare(session, Config(run=RunConfig(start_s=start_s)))
    initial = initialise(problem)
    row = int(np.searchsorted(session.reference.t_ns, problem.windows[0].t1_ns))
    full = Rotation.from_quat(session.reference.quat[row, [1, 2, 3, 0]]).as_matrix()
    true = frames.heading_pitch_roll_deg(full, session.device.forward, session.device.up)[0, 0]
    assert f"+- {initial.sigma_heading_deg:.1f} deg" in initial.sentence
    return float((initial.heading_deg - true + 180.0) % 360.0 - 180.0), initial.sigma_heading_deg


@pytest.mark.slow
def test_the_first_heading_in_motion_with_the_fixes_of_a_phone():
    """Fixes of 3 m whose errors of 4 m last for a minute, without their sigma and calibration."""
    found = []
    for seed in range(3):
        session = simulate("phone-car-5min", seed)
        bare = session.replace(gnss=replace(session.gnss, sigma=None), magnetometer=None, static=None)
        found += [error_and_sigma(bare, start_s) for start_s in np.linspace(20.0, 200.0, 7)]
    error, sigma = np.array(found).T
    assert (np.abs(error) < 2.2 * sigma).mean() >= 0.9
    assert np.median(sigma) < 45.0  # deg: something is known


def test_the_heading_of_good_fixes_is_known():
    session = simulate("phone-car-5min", 0)
    reference = session.reference
    exact = np.searchsorted(reference.t_ns, session.gnss.t_ns)
    fixes = replace(
        session.gnss, lla=session.frame.lla_from_nav(reference.enu[exact]), sigma=np.full((len(exact), 3), 0.1)
    )
    error, sigma = error_and_sigma(session.replace(gnss=fixes, magnetometer=None, static=None), 60.0)
    assert sigma < 10.0 and abs(error) < 2.2 * sigma

"""The recordings of the thesis and of the study: what is known of them is so in the simulated ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smartnav_graph.core.timebase import NS
from smartnav_graph.simulation import thesis
from smartnav_graph.simulation.scenarios import SCENARIOS
from smartnav_graph.simulation.sensors import TemperatureModel
from smartnav_graph.simulation.town import Streets, TownDrive

DRIVE = TownDrive()


@pytest.fixture(scope="module")
def drive():
    """Half an hour and more of the drive at 10 Hz."""
    way = DRIVE(2220.0, np.random.default_rng((0, 0)))
    return way, way.sample(np.arange(0.0, 2220.0, 0.1))


def turned_deg(truth):
    """Angle of the way about up since the start, to the left."""
    ahead = truth.nav_R_body[:, :2, 1]
    psi = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return np.degrees(psi - psi[0])


def test_the_drive_starts_at_85_deg_and_turns_by_320_deg_in_the_roundabout(drive):
    _, truth = drive
    ahead = truth.nav_R_body[0, :2, 1]
    assert np.degrees(np.arctan2(*ahead)) == pytest.approx(85.0 - DRIVE.held_deg[0], abs=0.1)
    turned = turned_deg(truth)
    after = (truth.t > 74.0) & (truth.t < 77.9)
    np.testing.assert_allclose(turned[after], 320.0, atol=2.0)


def test_the_drive_stays_on_the_streets_of_the_town(drive):
    way, truth = drive
    place = truth.nav_t_body[truth.t > 110.0, :2] - DRIVE.entrance
    half = DRIVE.spacing_m / 2
    from_line = np.abs((place + half) % DRIVE.spacing_m - half).min(axis=1)
    assert from_line.max() < Streets(DRIVE).width_m / 2
    assert np.linalg.norm(truth.nav_a_body, axis=1).max() < 6.0
    assert len(way.rests) > 10


def test_the_streets_are_open_to_the_sky_and_hide_what_is_behind_them():
    small = TownDrive(nodes=(3, 3))
    scene = Streets(small, per_m2=0.1)(np.random.default_rng(0))
    assert scene.points[:, 2].max() < 10.6 and (scene.normal[:, 2] > -0.5).all()
    centre = np.append(small.entrance, 0.0)
    seen = scene.points[scene.seen_from(centre, np.arange(len(scene.points)))] - centre
    street = np.abs(seen[:, :2]).min(axis=1) < 9.0 * 159.0 / 141.0 + 0.01  # past the corners of the farthest crossing
    walls = seen[:, 2] > -1.4
    assert street[walls].all()
    assert len(seen) > 100


def test_temperature_turns_the_gyro_bias_linearly():
    model = TemperatureModel()
    short = replace(SCENARIOS["thesis-static"], seconds=600.0)
    s = short(1)
    warm = np.interp(s.reference.t_ns, s.temperature.t_ns, model.temperature((s.temperature.t_ns - s.imu.t_ns[0]) / NS))
    without = replace(short, temperature=None)(1)
    slope = np.polyfit(warm - model.zero_c, s.reference.gyro_bias - without.reference.gyro_bias, 1)
    np.testing.assert_allclose(slope, [model.gyro_rad_s_k, [0.0] * 3], atol=2e-7)
    assert s.temperature.temperature_c[:60].mean() == pytest.approx(33.1, abs=0.1)
    assert model.temperature(np.array([6 * 3600.0]))[0] == pytest.approx(48.0, abs=0.2)


def test_the_trolley_stops_on_surveyed_points_under_a_lever_arm():
    s = replace(SCENARIOS["thesis-indoor"], camera=None)(0)
    assert len(s.control) == 11  # of the start and of ten stops
    rows = np.searchsorted(s.reference.t_ns, s.control.t_ns)
    under = s.nav_position(s.control)[:, 2] - s.reference.enu[rows, 2]
    assert np.abs(under + 1.0).max() < 0.15
    assert s.mount("control").body_t == thesis.SCENARIOS[2].control_arm


def test_moving_objects_move_together():
    pair = replace(SCENARIOS["thesis-outdoor"], seconds=130.0)(0)
    assert pair.matches is not None
    share = 1.0 - pair.matches.extra["truth_inlier"].mean()
    assert 0.2 < share < 0.4  # wrong ones 0.1 to 0.3, moving ones 0 to 0.2

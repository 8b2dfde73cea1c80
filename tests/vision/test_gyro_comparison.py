"""Clock and boresight of a camera from turns: a camera in a hand shows both, one that does not turn shows neither."""

from dataclasses import replace

import numpy as np
import pytest

from smartnav_graph.factors.coplanarity import CoplanarityConfig, pairs_of
from smartnav_graph.simulation.scenarios import SCENARIOS
from smartnav_graph.vision.gyro_comparison import compare_with_gyro, contradictions

ROOM = SCENARIOS["room-30s"]


def compared(boresight_deg=(0.0, 0.0, 0.0), clock_s=0.0, gyro_bias=0.0):
    camera = replace(ROOM.camera, boresight_deg=boresight_deg, clock_s=clock_s)
    session = replace(ROOM, camera=camera)(0)
    name = next(iter(session.calibration.cameras))
    calibrated = session.calibration.cameras[name]
    imu = replace(session.imu, gyro=session.imu.gyro + gyro_bias)
    found = compare_with_gyro(pairs_of(session, CoplanarityConfig()), imu, calibrated, session.mount(name))
    return found, list(contradictions(found, calibrated))


@pytest.mark.parametrize("clock_s", [-0.06, 0.4])
def test_clock_and_boresight_are_found_beside_a_gyro_bias(clock_s):
    found, findings = compared((0.5, -2.0, 1.0), clock_s, gyro_bias=0.05)
    assert found.known and found.sound > 0.9
    assert abs(found.offset_s - clock_s) < max(3.0 * found.sigma_s, 1e-3) and found.sigma_s < 0.01  # s
    assert np.abs(np.degrees(found.boresight) - [0.5, -2.0, 1.0]).max() < 0.2  # deg
    assert [f"{1e3 * clock_s:.0f} +-" in finding.text for finding in findings] == [True, False]
    assert "turned by" in findings[1].text and findings[1].size == pytest.approx(np.radians(2.0), rel=0.1)


def test_a_calibrated_camera_contradicts_nothing():
    found, findings = compared()
    assert found.known and abs(found.offset_s) < 1e-3 and found.turned_by == 0.0 and not findings


def test_a_camera_that_does_not_turn_shows_no_clock():
    session = ROOM(0)
    imu = replace(session.imu, gyro=np.zeros_like(session.imu.gyro))
    name = next(iter(session.calibration.cameras))
    camera, pairs = session.calibration.cameras[name], pairs_of(session, CoplanarityConfig())
    found = compare_with_gyro(pairs, imu, camera, session.mount(name))
    assert found is None or (not found.known and not list(contradictions(found, camera)))
    few = pairs.of(np.arange(5))
    assert compare_with_gyro(few, session.imu, camera, session.mount(name)) is None

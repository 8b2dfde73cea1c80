"""What a session knows: time zero, date, gravity, positions, mounts."""

import dataclasses

import numpy as np
import pytest
from filled import example

from smartnav_graph.core import frames
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.session import Mount, Session
from smartnav_graph.session.streams import GnssFix, Imu

ORIGIN = Origin(52.0, 11.0, 100.0)


def test_time_zero_is_the_first_inertial_sample():
    fix = dataclasses.replace(example(GnssFix), t_ns=example(Imu).t_ns - 5_000_000_000)
    assert Session(imu=example(Imu), gnss=fix).t0_ns == example(Imu).t_ns[0]
    assert Session(gnss=fix).t0_ns == fix.t_ns[0]
    assert Session().t0_ns == 0
    np.testing.assert_allclose(Session(imu=example(Imu), gnss=fix).seconds(fix.t_ns[:2]), [-5.0, -4.989999999])


def test_gravity_is_the_sessions_own_then_that_of_the_place_then_standard():
    assert Session().gravity == frames.STANDARD_GRAVITY
    assert Session(origin=ORIGIN).gravity == frames.normal_gravity(52.0, 100.0)
    assert Session(origin=ORIGIN, gravity_m_s2=9.81).gravity == 9.81


# Decimal years of known clock readings: 2011-09-14 01:46:25 UTC is GPS second 1 000 000 000 and Unix second 1315964785.
@pytest.mark.parametrize(
    ("epoch", "second", "year"),
    [
        ("gps", 1_000_000_000, 2011.70),
        ("unix", 1_315_964_785, 2011.70),
        ("gps", 0, 1980.01),  # 6 January
        ("unix", 0, 1970.0),
        ("boot", 1_000_000_000, 2025.0),
        ("unknown", 1_000_000_000, 2025.0),
    ],
)
def test_the_date_of_a_clock(epoch, second, year):
    imu = dataclasses.replace(example(Imu), t_ns=example(Imu).t_ns - example(Imu).t_ns[0] + second * NS)
    session = Session(imu=imu, clock_epoch=epoch, origin=ORIGIN)
    assert session.year == pytest.approx(year, abs=0.005)
    np.testing.assert_allclose(session.magnetic_field_ut, frames.magnetic_field_ut(ORIGIN, year), atol=1e-3)  # uT


def test_declination_is_that_of_the_published_test_values():
    # WMM2025 test values (NOAA): 2025.0, height 0 km; 80 N 0 E: D = 1.28 deg; 0 N 120 E: D = -0.16 deg
    assert Session(origin=Origin(80.0, 0.0, 0.0)).declination_deg == pytest.approx(1.28, abs=0.01)
    assert Session(origin=Origin(0.0, 120.0, 0.0)).declination_deg == pytest.approx(-0.16, abs=0.01)
    assert Session().declination_deg == 0.0


def test_positions_in_local_metres():
    whole = Session(origin=ORIGIN)
    local, geodetic = example(GnssFix), example(GnssFix, geodetic=True)
    np.testing.assert_array_equal(whole.nav_position(local), local.enu)
    np.testing.assert_allclose(whole.nav_position(geodetic), LocalFrame(ORIGIN).nav_from_lla(geodetic.lla))


def test_an_unnamed_sensor_sits_at_the_origin_of_the_body():
    placed = Session(sensors={"gnss": Mount((0.1, -0.6, 0.9))})
    assert placed.mount("gnss").body_t == (0.1, -0.6, 0.9)
    assert placed.mount("control") == Mount()


@pytest.mark.parametrize("rows", [0, 1])
def test_without_inertial_data_nothing_goes(rows):
    imu = None if rows == 0 else example(Imu, 1)
    with pytest.raises(SessionError, match=r"at least two rows; record the IMU too"):
        Session(imu=imu).require_imu()

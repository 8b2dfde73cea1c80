"""Readings of single sensors put together: order, gaps, carried stamps; fixes, units, and the axes of a device."""

from pathlib import Path

import numpy as np
import pytest

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.axes import find_body_axes
from smartnav_graph.readers.fixes import RADIUS_68, LoggedFixes, fix_table
from smartnav_graph.readers.samples import carried, clock_offset, in_time_order, inertial_table, summed
from smartnav_graph.readers.units import ACCELERATION, FLUX_DENSITY, quantity_in, unit_in

FILE = Path("log.csv")
MS = NS // 1000


def samples(t_ms, values, repairs=()):
    return in_time_order(FILE, np.array(t_ms) * MS, np.array(values, dtype=float), repairs)


def test_rows_come_in_order_once_each_with_a_value():
    found = samples([0, 20, 10, 20, 30], [0.0, 2, 1, 2, np.nan])
    assert found.t_ns.tolist() == [0, 10 * MS, 20 * MS] and found.values[:, 0].tolist() == [0, 1, 2]
    assert sorted(found.counts.values()) == [1, 1, 1]
    with pytest.raises(SessionError, match=r"log.csv: has no row with a value among 2"):
        samples([0, 1], [np.nan, np.nan])


def test_a_clock_set_back_is_refused_or_continued():
    t_ms = [*range(0, 5000, 10), *range(0, 5000, 10)]
    values = np.random.default_rng(0).normal(size=(len(t_ms), 3))
    with pytest.raises(SessionError, match=r"log.csv: .*the clock was set back"):
        samples(t_ms, values)
    assert samples(t_ms, values, ("clock",)).t_ns[-1] > 9.9 * NS


def test_readings_are_interpolated_but_not_across_gaps_or_beyond_the_ends():
    t_ms = [*range(0, 100, 10), *range(500, 600, 10)]
    rows, known = carried(np.array([-5, 0, 15, 90, 300, 505, 595]) * MS, samples(t_ms, np.array(t_ms) * 2.0))
    assert known.tolist() == [False, True, True, True, False, True, False]
    np.testing.assert_allclose(rows[known, 0], [0, 30, 180, 1010])
    assert np.isnan(rows[~known]).all()


def test_a_slow_sensor_is_interpolated_between_its_own_periods():
    assert carried(np.array([250]) * MS, samples([0, 500, 1000], [0.0, 1, 2]))[0][0, 0] == pytest.approx(0.5)


def test_inertial_columns_are_on_the_stamps_of_the_gyro():
    gyro = samples([5, 15, 25], [[1.0, 2, 3]] * 3)
    accel = samples([0, 10, 20], [[0.0, 0, 9], [0, 0, 10], [0, 0, 11]])
    table, counts = inertial_table(gyro, accel)
    assert table["t_ns"].tolist() == [5 * MS, 15 * MS] and table["accel_z_m_s2"].tolist() == [9.5, 10.5]
    assert table["gyro_y_rad_s"].tolist() == [2, 2]
    assert counts["of the gyro outside the accelerometer's span dropped"] == 1
    with pytest.raises(SessionError, match="has no time in common"):
        inertial_table(gyro, samples([1000, 1010], [[0.0, 0, 9]] * 2))


def test_gravity_and_linear_acceleration_make_specific_force():
    total = summed(samples([0, 10], [[0.0, 0, 1]] * 2), samples([0, 10], [[0.0, 0, 9.8]] * 2))
    assert total.values[0].tolist() == [0, 0, 10.8]


def test_clocks_are_tied_by_most_stamps():
    boot = np.arange(10) * NS
    late = np.array([0, 0, 0, 5, 0, 0, 0, 0, 0, 0]) * NS
    assert clock_offset(boot, boot + 100 * NS + late) == 100 * NS


def fixes(**changes):
    values = {
        "t_ns": np.arange(4) * NS,
        "lat": np.array([48.0, 48.1, 48.2, 48.3]),
        "lon": np.array([11.0, 11.0, 11.0, 11.0]),
        "height": np.array([500.0, 500, 500, 500]),
    }
    return LoggedFixes(**(values | {name: np.asarray(value, dtype=float) for name, value in changes.items()}))


def test_accuracy_is_a_radius_of_68_percent():
    errors = np.random.default_rng(1).normal(size=(100_000, 2))
    assert (np.hypot(*errors.T) < RADIUS_68).mean() == pytest.approx(0.68, abs=0.005)  # 3 sigma of the share
    table, counts = fix_table(fixes(horizontal=[3, 6, 3, 3], vertical=[5, 0, 5, 5]))
    np.testing.assert_allclose(table["sigma_e_m"][:2], [1.987, 3.975], atol=0.001)
    assert table["sigma_u_m"][0] == 5 and np.isnan(table["sigma_u_m"][1]) and not counts


@pytest.mark.parametrize("mark", [(0, 0), (-1, -1), (-9999, -9999), (np.nan, 11), (91, 11), (48.0, 999)])
def test_marks_are_no_positions(mark):
    table, counts = fix_table(fixes(lat=[48, mark[0], 48.2, 48.3], lon=[11, mark[1], 11, 11]))
    assert len(table["t_ns"]) == 3 and counts == {"without a position left out": 1}


def test_a_negative_accuracy_marks_an_invalid_fix_and_repeats_are_left_out():
    table, counts = fix_table(
        fixes(horizontal=[3, -1, 3, 3], lat=[48, 48, 48.2, 48.2], height=[500, 500, -9999, -9999])
    )
    assert table["lat_deg"].tolist() == [48, 48.2] and np.isnan(table["height_m"][1])
    assert counts == {"without a position left out": 1, "that repeat the fix before left out": 1}


def test_speed_and_course_become_velocity_with_sigma():
    course = [0, 90, -1, 45]
    table, _ = fix_table(fixes(speed=[10, 10, 10, -1], course=course, speed_sigma=[1] * 4, course_sigma=[1, 1, 1, 1]))
    velocity = np.stack([table["ve_m_s"], table["vn_m_s"]], axis=-1)
    np.testing.assert_allclose(velocity[:2], [[0, 10], [10, 0]], atol=1e-12)
    assert np.isnan(velocity[2:]).all()
    assert table["sigma_vn_m_s"][0] == pytest.approx(1.0) and table["sigma_ve_m_s"][0] >= np.radians(1) * 10


@pytest.mark.parametrize(
    ("heading", "quantity", "unit"),
    [
        ("ACCELEROMETER X (m/s²)", "accelerometerx", "m/s2"),
        ("accelerometerAccelerationX(G)", "accelerometeraccelerationx", "g"),
        ("LOCATION Speed ( Kmh)", "locationspeed", "kmh"),
        ("MAGNETIC FIELD X (μT)", "magneticfieldx", "ut"),
        ("Time [s]", "time", "s"),
        ("gFx", "gfx", ""),
    ],
)
def test_units_are_read_from_headings(heading, quantity, unit):
    assert (quantity_in(heading), unit_in(heading)) == (quantity, unit)
    assert ACCELERATION["g"] == 9.80665 and FLUX_DENSITY["gauss"] == 100.0


def drive(forward, up):
    """A drive of two minutes: columns of imu and gnss of a device whose body axes point as given."""
    t = np.arange(0, 120, 0.02)
    speed, turn = 10 + 4 * np.sin(t / 5), 0.25 * np.sin(t / 7)
    heading = np.cumsum(turn) * 0.02
    left = np.cross(up, forward)
    accel = np.gradient(speed, t)[:, None] * forward + (speed * turn)[:, None] * left + 9.81 * np.asarray(up)
    gyro = turn[:, None] * np.asarray(up)
    position = np.cumsum(speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0) * 0.02
    noise = np.random.default_rng(0).normal(size=accel.shape)
    imu = {"t_ns": np.round(t * NS).astype(np.int64)}
    imu |= {f"accel_{a}_m_s2": c for a, c in zip("xyz", (accel + 0.1 * noise).T, strict=True)}
    imu |= {f"gyro_{a}_rad_s": c for a, c in zip("xyz", gyro.T, strict=True)}
    lla = LocalFrame(Origin(48, 11, 500)).lla_from_nav(np.column_stack([position[::50], np.zeros(len(t) // 50)]))
    gnss = {"t_ns": imu["t_ns"][::50], "lat_deg": lla[:, 0], "lon_deg": lla[:, 1], "height_m": lla[:, 2]}
    return imu, gnss


@pytest.mark.parametrize(
    ("forward", "up"), [("+y", "+z"), ("-z", "-x"), ("+x", "+y"), ("-y", "-z"), ("+z", "+y"), ("-x", "+z")]
)
def test_forward_and_up_are_found_by_gravity_and_course(forward, up):
    from smartnav_graph.core.frames import axis_vector

    imu, gnss = drive(axis_vector(forward), axis_vector(up))
    found = find_body_axes(imu, gnss)
    assert (found.forward, found.up, found.forward_found) == (forward, up, True)


def test_forward_is_not_found_where_nothing_moves():
    imu, gnss = drive(np.array([0.0, 1, 0]), np.array([0.0, 0, 1]))
    rest = gnss | {"lat_deg": np.full(len(gnss["t_ns"]), 48.0), "lon_deg": np.full(len(gnss["t_ns"]), 11.0)}
    found = find_body_axes(imu, rest)
    assert (found.up, found.up_found, found.forward_found) == ("+z", True, False)
    assert not find_body_axes(imu).forward_found

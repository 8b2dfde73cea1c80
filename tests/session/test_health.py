"""Each rule with a session that breaks it, and with sessions that look odd but are sound."""

from __future__ import annotations

import csv
import gzip
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import Origin
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.session.health import Health, inspect, tilt_errors
from smartnav_graph.session.session import Device, Mount, Session
from smartnav_graph.session.streams import (
    Barometer,
    ControlPoint,
    GnssFix,
    Images,
    Imu,
    Magnetometer,
    StaticPeriod,
    Tracks,
)
from smartnav_graph.simulation.scenarios import simulate

T0 = 1_748_772_000 * NS
G = 9.81


def make_imu(seconds: float = 30.0, rate: float = 100.0, seed: int = 0) -> Imu:
    """A car: rolls, pitches and yaws a little, with noise."""
    t = np.arange(round(seconds * rate)) / rate
    rng = np.random.default_rng(seed)
    gyro = np.stack([0.05 * np.sin(3 * t), 0.05 * np.cos(2 * t), 0.2 * np.sin(0.3 * t)], axis=-1)
    accel = np.array([0.0, 0.0, G]) + np.stack([np.sin(0.5 * t), np.cos(0.4 * t), 0.1 * np.sin(9 * t)], axis=-1)
    noise = rng.normal(size=(2, len(t), 3))
    return Imu(t_ns=T0 + ns_from_seconds(t), gyro=gyro + 0.003 * noise[0], accel=accel + 0.05 * noise[1])


def make_fixes(first_s: float = 0.0, last_s: float = 29.0) -> GnssFix:
    t = np.arange(first_s, last_s)
    enu = np.stack([10 * t, np.sin(t), 0 * t], axis=-1)
    return GnssFix(t_ns=T0 + ns_from_seconds(t), enu=enu, sigma=np.full((len(t), 3), 3.0))


def make_session(**changes) -> Session:
    start = {
        "imu": make_imu(),
        "gnss": make_fixes(),
        "clock_epoch": "unix",
        "gravity_m_s2": G,
        "origin": Origin(52, 11, 0),
    }
    return Session(**(start | changes))


def scaled(imu: Imu, *, gyro: float = 1.0, accel: float = 1.0) -> Imu:
    return replace(imu, gyro=imu.gyro * gyro, accel=imu.accel * accel)


def only(health: Health, level: str) -> str:
    found = [str(finding) for finding in health.findings if finding.level == level]
    assert len(found) == 1, found
    return found[0]


def test_sound_session_has_no_findings():
    health = inspect(make_session())
    assert health.findings == ()
    health.raise_errors()
    imu, gnss = health.streams
    assert (imu.name, imu.rows, imu.start_s, imu.length_s) == ("imu", 3000, 0.0, 29.99)
    assert imu.rate_hz == pytest.approx(100.0)
    assert (gnss.rows, gnss.rate_hz) == (29, 1.0)
    assert health.missing == ("calibration", "reference")


@pytest.mark.parametrize("name", ["walk-60s", "static-60s", "figure-eight-60s", "phone-car-5min"])
def test_simulated_sessions_have_no_warnings(name):
    assert inspect(simulate(name, seed=1)).warnings() == []


def test_accelerometer_in_g_and_scaled_twice():
    warning = only(inspect(make_session(imu=scaled(make_imu(), accel=1 / G))), "warning")
    assert "units of g" in warning and "multiply accel by 9.80665" in warning
    warning = only(inspect(make_session(imu=scaled(make_imu(), accel=G))), "warning")
    assert "scaled by 9.81 twice" in warning and "divide accel by 9.80665" in warning


def test_gravity_removed_and_other_factors():
    imu = make_imu()
    assert "gravity seems removed" in only(
        inspect(make_session(imu=replace(imu, accel=imu.accel - [0.0, 0.0, G - 2.0]))), "warning"
    )
    assert "times too large" in only(inspect(make_session(imu=scaled(imu, accel=3.28))), "warning")


def test_gravity_at_rest():
    rng, n = np.random.default_rng(0), 1000
    rest = replace(make_imu(10.0), gyro=0.005 * rng.normal(size=(n, 3)))
    accel = np.array([0.0, 0.0, 1.2 * G]) + 0.05 * rng.normal(size=(n, 3))
    health = inspect(make_session(imu=replace(rest, accel=accel), gnss=make_fixes(0.0, 9.0)))
    assert health.quiet_accel_m_s2 == pytest.approx(1.2 * G, rel=1e-3)
    assert "+20.0 % off gravity" in only(health, "warning")
    shaken = replace(rest, accel=accel + rng.normal(size=(n, 3)))
    assert inspect(make_session(imu=shaken)).quiet_accel_m_s2 is None


@pytest.mark.parametrize("name", ["walk-60s", "figure-eight-60s", "phone-car-5min"])
def test_gyro_in_degrees(name):
    session = simulate(name)
    wrong = session.replace(imu=scaled(session.imu, gyro=180 / np.pi))
    assert "looks like deg/s; multiply gyro by pi/180" in only(inspect(wrong), "warning")


def test_gyro_of_a_car_in_degrees_is_reported_from_gravity():
    wrong = scaled(make_imu(), gyro=180 / np.pi)
    assert np.quantile(np.linalg.norm(wrong.gyro, axis=1), 0.999) < 35.0  # the peaks alone are not enough
    assert "away from accel within 2 s" in only(inspect(make_session(imu=wrong)), "warning")


def test_fast_hand_tells_degrees_by_rms():
    t = np.arange(0, 30, 0.01)
    gyro = np.stack([0 * t, 0 * t, 20 * np.sin(9 * t)], axis=-1)  # about the vertical: no tilt to compare
    noise = 1e-3 * np.random.default_rng(0).normal(size=gyro.shape)
    assert "RMS |gyro|" in only(inspect(make_session(imu=replace(make_imu(), gyro=gyro + noise))), "warning")


def test_foot_mounted_peaks_are_no_degrees():
    """A foot swings at 10 rad/s about the lateral axis, and stands in between."""
    rate = 200.0
    t = np.arange(0, 20, 1 / rate)
    phase = t % 1.0
    swing = np.where(phase < 0.5, np.sin(4 * np.pi * phase), 0.0)
    pitch = -10.0 / (4 * np.pi) * np.where(phase < 0.5, np.cos(4 * np.pi * phase) - 1, 0.0)
    accel = G * np.stack([-np.sin(pitch), 0 * t, np.cos(pitch)], axis=-1)
    accel[:, 0] += 15 * swing
    rng = np.random.default_rng(0)
    gyro = np.stack([0 * t, 10.0 * swing, 0 * t], axis=-1) + 0.01 * rng.normal(size=(len(t), 3))
    imu = Imu(t_ns=T0 + ns_from_seconds(t), gyro=gyro, accel=accel + 0.05 * rng.normal(size=(len(t), 3)))
    assert np.abs(gyro).max() > 9.9
    fixes = GnssFix(t_ns=T0 + ns_from_seconds([1.0, 5.0]), enu=np.zeros((2, 3)), sigma=np.ones((2, 3)))
    assert inspect(make_session(imu=imu, gnss=fixes)).warnings() == []


def test_gyro_converted_twice():
    turning = np.arange(0, 30, 0.01)
    angle = 1.2 * np.sin(1.3 * turning)  # rad of pitch
    gyro = np.stack([0 * angle, 1.2 * 1.3 * np.cos(1.3 * turning), 0 * angle], axis=-1)
    accel = G * np.stack([-np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    rng = np.random.default_rng(0)
    imu = Imu(
        t_ns=T0 + ns_from_seconds(turning),
        gyro=gyro + 1e-3 * rng.normal(size=gyro.shape),
        accel=accel + 0.05 * rng.normal(size=accel.shape),
    )
    assert tilt_errors(imu)[1.0] < 1.0  # degrees: the analytic motion agrees with itself
    assert inspect(make_session(imu=imu)).warnings() == []
    wrong = make_session(imu=scaled(imu, gyro=np.pi / 180))
    assert "multiply gyro by 180/pi" in only(inspect(wrong), "warning")


def test_specific_force_must_point_up():
    imu = scaled(make_imu(), accel=-1.0)
    assert "flip the sign of accel" in only(inspect(make_session(imu=imu)), "warning")
    assert inspect(make_session(imu=imu, device=Device(up="-z"))).warnings() == []
    sideways = replace(make_imu(), accel=make_imu().accel[:, [2, 0, 1]])
    assert "90 deg away from the up axis +z" in only(inspect(make_session(imu=sideways)), "warning")


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_constant_inertial_sensor_is_an_error(sensor):
    imu = make_imu()
    health = inspect(make_session(imu=replace(imu, **{sensor: np.zeros_like(imu.gyro)})))
    with pytest.raises(SessionError, match=f"imu: {sensor} is 0 0 0 in all 3000 rows; if the sensor did not record"):
        health.raise_errors()


def test_constant_aiding():
    t = T0 + ns_from_seconds(np.arange(20.0))
    magnetometer = Magnetometer(t_ns=t, field_ut=np.zeros((20, 3)))
    assert "magnetometer: field is 0 0 0" in only(inspect(make_session(magnetometer=magnetometer)), "error")
    still = replace(make_fixes(), enu=np.ones((29, 3)))
    assert "gnss: position is 1 1 1 in all 29 rows" in only(inspect(make_session(gnss=still)), "warning")
    barometer = Barometer(t_ns=t, pressure_hpa=np.full(20, 1013.0))
    assert "barometer: pressure is 1013" in only(inspect(make_session(barometer=barometer)), "warning")


def test_missing_empty_and_short_streams():
    with pytest.raises(SessionError, match="no inertial data"):
        inspect(make_session(imu=None, gnss=None)).raise_errors()
    positions_only = inspect(Session(gnss=make_fixes()))
    positions_only.raise_errors()
    assert "imu: there are no inertial data: positions are smoothed" in only(positions_only, "warning")
    with pytest.raises(SessionError, match="gnss: has no rows"):
        inspect(make_session(gnss=make_fixes(0.0, 0.0))).raise_errors()
    with pytest.raises(SessionError, match="one row only"):
        inspect(make_session(imu=make_imu().take(slice(0, 1)))).raise_errors()
    assert "lasts 0.490 s only" in inspect(make_session(imu=make_imu(0.5))).warnings()[0]


def test_no_absolute_sensor():
    health = inspect(make_session(gnss=None))
    assert "no absolute sensor (gnss, control, ranges, pose_fixes)" in only(health, "warning")
    assert "absolute sensor (gnss, control, ranges, pose_fixes)" in health.missing


def test_fixes_outside_the_span_are_counted():
    health = inspect(make_session(gnss=make_fixes(-3.0, 32.0)))
    assert "5 of 35 rows lie outside the imu's span 0 to 29.990 s (the stream spans -3.000 to 31.000 s)" in only(
        health, "warning"
    )


def test_no_overlap_at_all_is_an_error_unless_another_sensor_has_some():
    late = make_fixes(100.0, 110.0)
    with pytest.raises(SessionError, match=r"no row of gnss lies inside the imu's span 0 to 29\.990 s; bring"):
        inspect(make_session(gnss=late)).raise_errors()
    point = ControlPoint(
        t_ns=[T0 + NS], enu=np.zeros((1, 3)), sigma=np.ones((1, 3)), point_id=np.array(["A"], dtype=object)
    )
    health = inspect(make_session(gnss=late, control=point))
    health.raise_errors()
    assert "10 of 10 rows lie outside" in only(health, "warning")


def test_standstills_count_by_their_span():
    static = StaticPeriod(t_ns=[T0 - NS], t_end_ns=[T0 + NS])
    assert inspect(make_session(static=static)).warnings() == []


def test_jumping_fixes():
    fixes = make_fixes()
    enu = np.array(fixes.enu)
    enu[12] += [0.0, 150.0, 0.0]
    assert "2 jumps faster than 100 m/s, the first at 12.000 s" in only(
        inspect(make_session(gnss=replace(fixes, enu=enu))), "warning"
    )


def test_a_fix_out_of_reach_of_the_others():
    fixes = make_fixes()
    enu = np.array(fixes.enu)
    enu[12] += [0.0, 4e5, 0.0]
    assert "1 of 29 positions lie up to 400 km from the others" in only(
        inspect(make_session(gnss=replace(fixes, enu=enu))), "warning"
    )


def test_noise_of_fast_fixes_is_no_jump():
    t = np.arange(0.0, 29.0, 0.1)
    enu = 3.0 * np.random.default_rng(0).normal(size=(len(t), 3))
    fixes = GnssFix(t_ns=T0 + ns_from_seconds(t), enu=enu, sigma=np.full((len(t), 3), 3.0))
    assert np.linalg.norm(np.diff(enu, axis=0), axis=1).max() > 10.0  # more than 100 m/s
    assert inspect(make_session(gnss=fixes)).warnings() == []


def test_stamps_too_far_apart():
    imu = make_imu()
    t_ns = T0 + (imu.t_ns - T0) * 1000
    warnings = inspect(make_session(imu=replace(imu, t_ns=t_ns))).warnings()
    assert any("median rate 0.1 Hz is outside" in warning for warning in warnings)


@pytest.mark.parametrize(("unit_ns", "name", "power"), [(1000, "microseconds", "1e3"), (10**6, "milliseconds", "1e6")])
def test_stamps_in_another_unit_are_an_error(unit_ns, name, power):
    imu, fixes = make_imu(), make_fixes()
    small = make_session(imu=replace(imu, t_ns=imu.t_ns // unit_ns), gnss=replace(fixes, t_ns=fixes.t_ns // unit_ns))
    with pytest.raises(SessionError, match=f"they look like {name}; multiply t_ns of every stream by {power}"):
        inspect(small).raise_errors()


def test_stamps_of_arrival_in_bursts_are_an_error():
    imu = make_imu()
    t_ns = imu.t_ns // 10**8 * 10**8 + np.arange(len(imu)) % 10 * 1000
    with pytest.raises(SessionError, match=r"arrive in bursts: the median step is 1 us, the mean 9.97 ms.*--repair"):
        inspect(make_session(imu=replace(imu, t_ns=t_ns))).raise_errors()


def test_a_slow_imu_is_reported():
    assert "10 Hz is too low to follow the motion" in only(
        inspect(make_session(imu=make_imu().take(slice(None, None, 10)))), "warning"
    )


@pytest.mark.parametrize(("name", "size"), [("accel", 1000.0), ("gyro", -500.0)])
def test_a_single_reading_far_from_its_neighbours_is_found_by_row_and_time(name, size):
    imu = make_imu()
    values = getattr(imu, name).copy()
    values[512, 1] = size
    found = only(inspect(make_session(imu=replace(imu, **{name: values}))), "warning")
    assert f"1 single reading of {name}" in found and "at row 512, 5.120 s" in found


def test_scatter_of_fixes_against_their_sigma():
    rng = np.random.default_rng(0)
    fixes = make_fixes(0.0, 60.0)
    enu = 3.0 * rng.normal(size=(len(fixes), 3))
    for sigma, count in ((0.001, 2), (2.0, 0), (5.0, 0)):
        stream = GnssFix(t_ns=fixes.t_ns, enu=enu, sigma=np.full(enu.shape, sigma))
        warnings = [
            text for text in inspect(make_session(imu=make_imu(70.0), gnss=stream)).warnings() if "scatter" in text
        ]
        assert len(warnings) == count, warnings


def test_unix_clock_in_milliseconds():
    imu, fixes = make_imu(), make_fixes()
    shift = T0 - T0 // 1_000_000
    early = make_session(imu=replace(imu, t_ns=imu.t_ns - shift), gnss=replace(fixes, t_ns=fixes.t_ns - shift))
    assert "outside 1990 to 2100" in only(inspect(early), "warning")
    assert inspect(early.replace(clock_epoch="boot")).warnings() == []


def test_gaps_are_reported_by_kind():
    imu = make_imu()
    kept = np.r_[0:1000, 1200:3000]
    accel, gyro = np.array(imu.accel), np.array(imu.gyro)
    for row in range(2001, 2050):  # a straight line
        f = (row - 2000) / 50
        accel[row], gyro[row] = (1 - f) * accel[2000] + f * accel[2050], (1 - f) * gyro[2000] + f * gyro[2050]
    health = inspect(make_session(imu=replace(imu, accel=accel, gyro=gyro).take(kept)))
    missing, bridged = health.warnings()
    assert "1 data gap without samples, 2.01 s in all, longest 2.01 s at 9.99 s" in missing
    assert "1 data gap linearly interpolated, 0.50 s in all, longest 0.50 s at 20.00 s" in bridged
    assert [gap.kind for gap in health.gaps] == ["missing", "bridged"]


def test_sigmas_heights_and_repairs_are_reported():
    fixes = replace(make_fixes(), sigma=None)
    session = make_session(gnss=fixes, sensors={"gnss": Mount(frame="msl")}, dropped={"imu": {"rows sorted": 3}})
    findings = [str(finding) for finding in inspect(session).findings]
    assert {finding.level for finding in inspect(session).findings} == {"info"}
    assert findings == [
        "gnss: has no sigma columns; the default of the device class will be used",
        "gnss: heights are above mean sea level, not above the ellipsoid",
        "imu: 3 rows sorted",
    ]
    sigma = np.array(make_fixes().sigma)
    sigma[3] = np.nan
    partly = inspect(make_session(gnss=replace(fixes, sigma=sigma)))
    assert "1 of 29 rows have no sigma" in only(partly, "info")


def test_velocities_without_a_vertical_part_are_reported():
    fixes = make_fixes()
    level = replace(fixes, velocity=np.tile([1.0, 0.0, np.nan], (len(fixes), 1)))
    text = "gnss: 29 velocities have no vertical part, as those of speed and course; not used in the estimate"
    assert text in [str(finding) for finding in inspect(make_session(gnss=level)).findings if finding.level == "info"]
    whole = replace(fixes, velocity=np.tile([1.0, 0.0, 0.0], (len(fixes), 1)))
    assert not any("vertical part" in str(finding) for finding in inspect(make_session(gnss=whole)).findings)


def test_pictures_that_are_missing(tmp_path):
    """A warning before matching, an information after it, nothing where all are there or none is named."""
    (tmp_path / "a.png").touch()
    t_ns = make_imu().t_ns[:2]
    images = Images(t_ns=t_ns, image_id=[0, 1], file=["a.png", "b.png"], camera=["cam", "cam"])
    session = make_session(images=images, pictures=tmp_path)
    assert only(inspect(session), "warning") == (
        "images: 1 of 2 pictures are missing, the first is b.png; copy them, or import the whole folder"
    )
    tracks = Tracks(t_ns=t_ns[:1], image_id=[0], track_id=[0], xy_n=np.zeros((1, 2)))
    done = [str(finding) for finding in inspect(session.replace(tracks=tracks)).findings]
    assert any("1 of 2 pictures are missing" in finding and "not needed" in finding for finding in done)
    (tmp_path / "b.png").touch()
    assert not any("pictures" in str(finding) for finding in inspect(session).findings)
    unnamed = replace(images, file=np.array(["", ""], dtype=object))
    assert not any("pictures" in str(finding) for finding in inspect(session.replace(images=unnamed)).findings)


DATASETS = Path(os.environ.get("SMARTNAV_DATASETS", Path(__file__).parents[3] / "shared" / "datasets"))
real = pytest.mark.skipif(not DATASETS.is_dir(), reason=f"no real recordings at {DATASETS} (SMARTNAV_DATASETS)")


def unit_alarms(t: np.ndarray, gyro: np.ndarray, accel: np.ndarray, up: str = "+z") -> list[str]:
    rows = np.r_[True, np.diff(t) > 0]
    imu = Imu(t_ns=ns_from_seconds(t - t[0])[rows], gyro=gyro[rows], accel=accel[rows])
    warnings = inspect(Session(imu=imu, gravity_m_s2=G, device=Device(up=up))).warnings()
    return [warning for warning in warnings if "data gap" not in warning and "absolute" not in warning]


@real
@pytest.mark.parametrize(("side", "up"), [("Left", "+z"), ("Right", "+z")])
def test_real_foot_raises_no_alarm(side, up):
    rows = np.loadtxt(DATASETS / f"foot_dual_zupt/measData/imuMeas{side}.csv", delimiter=",", skiprows=1)
    assert unit_alarms(np.arange(len(rows)) / 60.0, rows[:, 4:7], rows[:, 1:4], up) == []


@real
@pytest.mark.parametrize("trial", ["2017-12-15-18-01-51", "SensorConnectData_31"])
def test_real_fast_foot_raises_no_alarm(trial):
    from scipy.io import loadmat

    data = loadmat(DATASETS / f"foot_pyshoe_vicon/{trial}_LLIO.mat")
    t = data["timestamps_all" if "timestamps_all" in data else "timestamps"].ravel()
    rows = data["imu_data"]
    assert unit_alarms(t, rows[:, 3:6], rows[:, :3], up="-z") == []


@real
@pytest.mark.parametrize("session", ["Jakob_Nexus5_NoDist_Texting", "calib_acc_Nexus5_d1", "calib_mag_Nexus5_d1"])
def test_real_phone_raises_no_alarm_and_tells_degrees(session):
    folder = DATASETS / "phone_mocap_tyrex/android" / session

    def table(name: str) -> np.ndarray:
        with gzip.open(next(folder.glob(f"{name}.txt*")), "rt") as file:
            return np.loadtxt(file)

    accel, gyro = table("accelerometer"), table("gyroscope")
    t = gyro[:, 0]
    force = np.stack([np.interp(t, accel[:, 0], accel[:, i]) for i in (1, 2, 3)], axis=-1)
    assert unit_alarms(t, gyro[:, 1:4], force) == []
    assert "deg/s" in unit_alarms(t, np.degrees(gyro[:, 1:4]), force)[0]


@real
def test_real_motorway_raises_no_alarm_and_tells_degrees():
    folder = DATASETS / "car_comma2k19/processed_log/IMU"
    t, gyro = np.load(folder / "gyro/t"), np.load(folder / "gyro/value")
    at, accel = np.load(folder / "accelerometer/t"), np.load(folder / "accelerometer/value")
    force = np.stack([np.interp(t, at, column) for column in accel.T], axis=-1)
    assert unit_alarms(t, gyro, force, up="-z") == []
    assert "deg/s" in unit_alarms(t, np.degrees(gyro), force, up="-z")[0]


@real
def test_real_car_log_in_degrees_is_found():
    with open(DATASETS / "phone_sensorlog_balzer/2014-02-14-002-Data.csv") as file:
        rows = list(csv.DictReader(file))
    names = ("millis", "rollrate", "pitchrate", "yawrate", "ax", "ay", "az")
    values = np.array([[float(row[name]) for name in names] for row in rows])
    found = unit_alarms(values[:, 0] / 1e3, values[:, 1:4], values[:, 4:7], up="-z")
    assert len(found) == 1 and "looks like deg/s" in found[0]

"""Gross faults of whole streams, planted one at a time into sound sessions: each is named, and nothing else is."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import Origin, axis_vector
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.health import inspect
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import ControlPoint, StaticPeriod, Temperature, Velocity
from smartnav_graph.simulation.scenarios import simulate

sound = cache(simulate)


def warnings_of(session: Session) -> list[str]:
    return [str(finding) for finding in inspect(session).findings if finding.level != "info"]


def changed(session: Session, stream: str, **values) -> Session:
    return session.replace(**{stream: replace(getattr(session, stream), **values)})


def scaled(stream: str, column: str, factor: float):
    def fault(session: Session) -> Session:
        return changed(session, stream, **{column: factor * getattr(getattr(session, stream), column)})

    return fault


def level_velocity(factor: float):
    """Velocities as of speed and course, without a vertical part."""
    return lambda session: changed(session, "gnss", velocity=session.gnss.velocity * [factor, factor, np.nan])


def turned_velocity(session: Session) -> Session:
    return changed(session, "gnss", velocity=session.gnss.velocity[:, [1, 0, 2]])


def exchanged(session: Session) -> Session:
    lla = session.gnss.lla
    return changed(session, "gnss", lla=np.column_stack([lla[:, 1], lla[:, 0], lla[:, 2]]))


def radians(session: Session) -> Session:
    lla = session.gnss.lla
    origin = Origin(*np.radians([session.origin.lat_deg, session.origin.lon_deg]), session.origin.height_m)
    bare = session.replace(origin=origin, control=None, pose_fixes=None, magnetometer=None)
    return changed(bare, "gnss", lla=lla * [np.pi / 180, np.pi / 180, 1.0])


def no_fixes(session: Session) -> Session:
    bare = session.replace(control=None, pose_fixes=None, magnetometer=None)
    return changed(bare, "gnss", lla=session.gnss.lla * [0.0, 0.0, 1.0])


def frozen_receiver(session: Session) -> Session:
    lla = np.array(session.gnss.lla)
    lla[20:50] = lla[20]
    return changed(session, "gnss", lla=lla)


def no_heights(session: Session) -> Session:
    return changed(session, "gnss", lla=session.gnss.lla * [1.0, 1.0, 0.0])


def sea_level(session: Session) -> Session:
    lla, rows = session.reference, slice(0, None, 10)
    frame = session.frame
    assert frame is not None
    points = frame.lla_from_nav(lla.enu[rows]) - [0.0, 0.0, 46.0]
    t_ns = lla.t_ns[rows]
    names = np.array([f"P{i}" for i in range(len(t_ns))], dtype=object)
    return session.replace(control=ControlPoint(t_ns=t_ns, lla=points, point_id=names, sigma=np.ones((len(t_ns), 3))))


def quaternion_last(session: Session) -> Session:
    return changed(session, "pose_fixes", quat=session.pose_fixes.quat[:, [1, 2, 3, 0]])


def inverse_quaternion(session: Session) -> Session:
    return changed(session, "pose_fixes", quat=session.pose_fixes.quat * [1, -1, -1, -1])


def north_east_down(session: Session) -> Session:
    from scipy.spatial.transform import Rotation

    nav = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    turned = nav * Rotation.from_quat(session.pose_fixes.quat[:, [1, 2, 3, 0]])
    return changed(session, "pose_fixes", quat=turned.as_quat()[:, [3, 0, 1, 2]])


def mirrored_field(session: Session) -> Session:
    return changed(session, "magnetometer", field_ut=session.magnetometer.field_ut * [1.0, -1.0, 1.0])


def frozen_field(session: Session) -> Session:
    field = np.array(session.magnetometer.field_ut)
    field[500:700] = field[500]
    return changed(session, "magnetometer", field_ut=field)


def frozen_imu(session: Session) -> Session:
    gyro, accel = np.array(session.imu.gyro), np.array(session.imu.accel)
    gyro[3000:3300], accel[3000:3300] = gyro[3000], accel[3000]
    return changed(session, "imu", gyro=gyro, accel=accel)


def dead_axis(session: Session) -> Session:
    return changed(session, "imu", gyro=session.imu.gyro * [1.0, 0.0, 1.0])


def clipped(session: Session) -> Session:
    top = 2.0 * 9.80665
    accel = session.imu.accel + [0.0, 0.0, 11.0] * (np.arange(len(session.imu)) % 100 < 30)[:, None]
    return changed(session, "imu", accel=np.clip(accel, -top, top))


def measured_velocity(factor: float):
    """The wheel's speed along the forward axis, as a velocity in body axes."""

    def fault(session: Session) -> Session:
        forward = axis_vector(session.device.forward)
        rows = Velocity(t_ns=session.wheel.t_ns, velocity=factor * session.wheel.speed[:, None] * forward)
        return session.replace(velocity=rows)

    return fault


def moving_standstill(session: Session) -> Session:
    begin = session.t0_ns + 40 * NS
    return session.replace(static=StaticPeriod(t_ns=[begin], t_end_ns=[begin + 10 * NS]))


def kelvin(session: Session) -> Session:
    t_ns = session.imu.t_ns[::100]
    return session.replace(temperature=Temperature(t_ns=t_ns, temperature_c=np.linspace(300.0, 310.0, len(t_ns))))


def repeated_fixes(session: Session) -> Session:
    """Every row of the log holds the fix of the last five seconds."""
    return session.replace(gnss=replace(session.gnss, lla=session.gnss.lla[np.arange(len(session.gnss)) // 5 * 5]))


def spike(stream: str, column: str, reading: float):
    """One reading that is another, those before and after are not."""

    def fault(session: Session) -> Session:
        values = np.array(getattr(getattr(session, stream), column))
        values[300] = reading
        return changed(session, stream, **{column: values})

    return fault


CAR, WALK = "car-all-2min", "walk-all-2min"
FAULTS = [
    ("car-10min", scaled("imu", "gyro", -1.0), "imu: gyro turns against", "flip the sign of gyro"),
    (WALK, scaled("imu", "gyro", -1.0), "or the sign of gyro is wrong", "right-handed"),
    (CAR, scaled("imu", "gyro", np.pi / 180), "converted from deg to rad twice", "multiply gyro by 180/pi"),
    (WALK, scaled("imu", "gyro", np.pi / 180), "converted from deg to rad twice", "multiply gyro by 180/pi"),
    (CAR, scaled("imu", "gyro", 180 / np.pi), "it looks like deg/s", "multiply gyro by pi/180"),
    (CAR, scaled("imu", "accel", 1 / 9.80665), "units of g", "multiply accel by 9.80665"),
    (CAR, scaled("imu", "accel", -1.0), "specific force points 17", "flip the sign of accel"),
    (CAR, frozen_imu, "imu: repeats one row of readings for 3.0 s in 1 stretch", "count as a gap"),
    (CAR, dead_axis, "imu: gyro y is 0 in all", "import the log again"),
    (CAR, clipped, "|accel| is 19.61 in", "larger range"),
    (CAR, exchanged, "and near it with latitude and longitude exchanged", "exchange lat_deg and lon_deg"),
    (CAR, radians, "they look like radians", "give degrees"),
    (CAR, no_fixes, "gnss: latitude and longitude are 0 in all rows", "it has no positions"),
    (CAR, repeated_fixes, "rows repeat the fix before, at", "remove the rows without a new fix"),
    (CAR, no_heights, "gnss: height_m is zero in all rows", "holds no heights"),
    (
        CAR,
        scaled("gnss", "velocity", 3.6),
        "times the speed of the fixes: it looks like km/h",
        "m/s",
    ),
    (CAR, level_velocity(3.6), "times the speed of the fixes: it looks like km/h", "give m/s"),
    (CAR, scaled("gnss", "velocity", -1.0), "gnss: velocity points against the motion", "flip its sign"),
    (CAR, turned_velocity, "gnss: velocity fits the fixes with east and north exchanged", "exchange ve and vn"),
    (CAR, frozen_receiver, "gnss: repeats one position for 29 s", "receiver output frozen"),
    (CAR, sea_level, "gnss: heights lie +46", 'frame = "msl"'),
    (CAR, scaled("wheel", "speed", 3.6), "wheel: speed is 3.6", "give m/s"),
    (CAR, scaled("wheel", "speed", 1.944), "it looks like knots", "give m/s"),
    (CAR, scaled("wheel", "speed", -1.0), "wheel: speed is backwards", "flip its sign"),
    (CAR, scaled("wheel", "speed", 0.0), "wheel: speed is 0 in all", "remove wheel"),
    (CAR, measured_velocity(3.6), "velocity: velocity is 3.6", "give m/s"),
    (CAR, measured_velocity(-1.0), "velocity: velocity is backwards", "flip its sign"),
    (CAR, scaled("barometer", "pressure_hpa", 100.0), "barometer: median pressure", "give hPa"),
    (CAR, scaled("barometer", "pressure_hpa", 0.1), "it looks like kPa", "give hPa"),
    (CAR, scaled("barometer", "pressure_hpa", 0.02953), "it looks like inHg", "give hPa"),
    (CAR, scaled("magnetometer", "field_ut", 0.01), "it looks like gauss", "give uT"),
    (CAR, scaled("magnetometer", "field_ut", 0.001), "it looks like millitesla", "give uT"),
    (CAR, scaled("magnetometer", "field_ut", 1e-6), "it looks like tesla", "give uT"),
    (CAR, scaled("magnetometer", "field_ut", 1000.0), "it looks like nanotesla", "give uT"),
    (CAR, scaled("magnetometer", "field_ut", -1.0), "magnetometer: field points", "flip the sign of all axes"),
    (CAR, frozen_field, "magnetometer: repeats one reading for 20 s", "sensor output frozen"),
    (CAR, mirrored_field, "magnetometer: field turns against gyro", "right-handed"),
    (WALK, quaternion_last, "pose_fixes: attitudes turn", "give qw, qx, qy, qz"),
    (WALK, inverse_quaternion, "if read inverted", "give qw, qx, qy, qz"),
    (WALK, north_east_down, "they look like north, east, down", "east, north, up"),
    (CAR, moving_standstill, "static: the device moves in 1 listed standstill of 1", "check their stamps"),
    (CAR, spike("barometer", "pressure_hpa", 700.0), "barometer: 1 single reading of", "leave the row out"),
    (CAR, spike("magnetometer", "field_ut", 90.0), "first 90 90 90 at row 300", "leave the row out"),
    (CAR, spike("wheel", "speed", 80.0), "wheel: 1 single reading of speed", "leave the row out"),
    (CAR, kelvin, "it looks like kelvin", "degrees Celsius"),
]


@pytest.mark.parametrize("scenario", [CAR, WALK, "car-10min"])
def test_sound_sessions_of_all_sensors_raise_no_alarm(scenario):
    assert warnings_of(sound(scenario, seed=1)) == []


@pytest.mark.parametrize(
    ("scenario", "fault", "found", "remedy"), FAULTS, ids=lambda v: v if isinstance(v, str) else ""
)
def test_a_planted_fault_is_named(scenario, fault, found, remedy):
    warnings = warnings_of(fault(sound(scenario, seed=1)))
    assert any(found in text and remedy in text for text in warnings), warnings
    stream = found.split(":")[0]
    if stream in ("imu", "gnss", "wheel", "velocity", "barometer", "magnetometer", "pose_fixes", "static"):
        assert {text.split(":")[0] for text in warnings} == {stream}


@pytest.mark.parametrize(("lat", "lon"), [(-33.9, 151.2), (64.1, -21.9), (0.3, 32.6)])
def test_sound_sessions_elsewhere_raise_no_alarm(lat, lon):
    """The same drive in other hemispheres, without a magnetometer, whose field is that of home."""
    session = sound(CAR, seed=1)
    origin = Origin(lat, lon, session.origin.height_m)
    enu = {
        name: session.nav_position(getattr(session, name))
        for name in ("gnss", "pose_fixes", "control")
        if getattr(session, name) is not None
    }
    moved = session.replace(origin=origin, magnetometer=None)
    for name, places in enu.items():
        moved = changed(moved, name, lla=moved.frame.lla_from_nav(places))
    assert warnings_of(moved) == []


def test_stamps_of_another_unit_in_one_stream_cost_no_memory():
    """Magnetometer rows 1 ns apart, fixes over years: checked at once, whatever span their stamps have."""
    session = sound(CAR, seed=1)
    near = session.t0_ns + 60 * NS + np.arange(len(session.magnetometer))
    far = session.t0_ns + np.arange(len(session.gnss)) * 86_400 * NS
    begin = time.perf_counter()
    inspect(changed(changed(session, "magnetometer", t_ns=near), "gnss", t_ns=far))
    assert time.perf_counter() - begin < 20.0  # s


def test_inertial_rows_over_years_are_no_recording():
    session = sound(CAR, seed=1)
    rows = session.imu.take(slice(0, 60))
    found = warnings_of(Session(imu=replace(rows, t_ns=np.arange(60) * 29 * 86_400 * NS)))
    assert any("60 rows in 1740 days" in text for text in found)


@pytest.mark.parametrize(("begin", "end"), [(5, 4), (0, 31 * 86_400)])
def test_a_standstill_ends_after_it_begins_and_within_the_recording(begin, end):
    StaticPeriod(t_ns=[begin * NS], t_end_ns=[begin * NS])
    with pytest.raises(SessionError, match=r"t_end_ns lies .* at row 0 .*; expected 0 to 30 days; correct the stamps"):
        StaticPeriod(t_ns=[begin * NS], t_end_ns=[end * NS])

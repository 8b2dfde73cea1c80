"""Magnetometer, barometer, thermometer, speeds of the body, standstills: units, signs, impossible values."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.files import file_inside
from smartnav_graph.core.so3 import exp, rotate, skew
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.session.health.facts import (
    LEAST_ROWS,
    Facts,
    Finding,
    count_of,
    in_another_unit,
    odd_speed,
    over_chords,
    period,
    repeats,
    spike_rows,
)

_EARTH_UT = (22.0, 67.0)  # of the geomagnetic field at the ground
_FIELD_UNITS = {1e-6: "tesla", 1e-3: "millitesla", 1e-2: "gauss", 1e1: "milligauss", 1e3: "nanotesla"}
_PRESSURE_UNITS = {100.0: "Pa", 0.1: "kPa", 0.02953: "inHg", 0.750: "mmHg", 0.0145: "psi", 0.000987: "atm"}
_PRESSURE_HPA = (300.0, 1100.0)
_WEATHER = 0.06  # share of the pressure
_SPIKES = (  # what a reading may differ from its neighbours, for one row
    ("magnetometer", "field_ut", 20.0),
    ("barometer", "pressure_hpa", 2.0),
    ("temperature", "temperature_c", 5.0),
    ("wheel", "speed", 5.0),
)
_MAX_SPEED = 100.0  # m/s
_FROZEN_FIELD_S = 10.0
_TURN_S = 0.5
_CLEAR_TURNS = 0.3  # rad: root of the sum of the squared turns about the axis with the fewest
_CORRELATED = 0.4  # correlation beyond chance
_TURNS = 0.3  # rad/s, scatter of the rate of a device in motion


def _field(facts: Facts) -> Iterator[Finding]:
    stream = facts.session.magnetometer
    if stream is None or len(stream) < LEAST_ROWS or (stream.field_ut == stream.field_ut[0]).all():
        return
    size = float(np.median(np.linalg.norm(stream.field_ut, axis=1)))
    expected = facts.session.magnetic_field_ut
    low, high = _EARTH_UT
    near = f"{np.linalg.norm(expected):.0f} uT here" if expected is not None else f"{low:.0f} to {high:.0f} uT on Earth"
    turning = _turning_field(facts)
    for factor, unit in _FIELD_UNITS.items():
        looks = low <= size / factor <= high
        if unit == "milligauss" and turning is not None:  # the hard iron of a phone may be as large
            looks = high < turning <= factor * high
        if looks:
            text = f"median |field| {size:.3g} uT, expected {near}: it looks like {unit}"
            yield in_another_unit("magnetometer", text, "give uT", "field_ut", 1.0 / factor)
            return
    if not 0.3 * low < size < 3.0 * high:
        text = f"median |field| {size:.4g} uT, expected {near}"
        iron = turning is not None and 0.3 * low < turning < 3.0 * high  # the offset is estimated
        verdict = "good" if iron else "doubtful"
        yield Finding("magnetometer", text, "calibrate its hard iron, or check the unit", verdict=verdict)
    yield from _field_direction(facts, size)
    for first, last in repeats(stream.field_ut):
        seconds = (stream.t_ns[last] - stream.t_ns[first]) / NS
        if seconds >= _FROZEN_FIELD_S and last - first >= LEAST_ROWS:
            at = float(facts.session.seconds(stream.t_ns[first]))
            yield Finding(
                "magnetometer", f"repeats one reading for {seconds:.0f} s from {at:.1f} s on", "sensor output frozen"
            )
            return


def _turning_field(facts: Facts) -> float | None:
    """Size (uT) of the field that turns in the body: of B - h, with dB = -dtheta x (B - h), about the axes that the
    device turns about. None where it does not turn enough to find the offset h."""
    from scipy.ndimage import uniform_filter1d

    stream, imu = facts.session.magnetometer, facts.imu
    if stream is None or imu is None:
        return None
    stream = stream.take((stream.t_ns >= imu.t_ns[0]) & (stream.t_ns <= imu.t_ns[-1]))
    if len(stream) < LEAST_ROWS:
        return None
    every = min(max(1, round(_TURN_S / period(stream))), len(stream))
    field, t_ns = uniform_filter1d(stream.field_ut, every, axis=0)[::every], stream.t_ns[::every]
    angle = np.cumsum(imu.gyro * np.diff(imu.t_ns, prepend=imu.t_ns[0])[:, None] / NS, axis=0)
    half = round(0.5 * every * period(stream) * NS)
    angle = interpolate(t_ns + half, imu.t_ns, angle) + interpolate(t_ns - half, imu.t_ns, angle)
    turn, change, middle = 0.5 * np.diff(angle, axis=0), np.diff(field, axis=0), 0.5 * (field[1:] + field[:-1])
    A, b = skew(turn).reshape(-1, 3), (change + np.cross(turn, middle)).ravel()
    _, singular, axes = np.linalg.svd(A, full_matrices=False)
    turned = singular > _CLEAR_TURNS
    axes = axes[turned]
    if len(axes) < 2:
        return None
    h = np.linalg.lstsq(A @ axes.T, b, rcond=None)[0]
    left = b - A @ axes.T @ h
    size = float(np.median(np.linalg.norm(field @ axes.T - h, axis=1)))
    sigma = float(np.sqrt(left @ left / len(left)) / singular[turned].min())
    return size if sigma < 0.2 * size else None


def _field_direction(facts: Facts, size: float) -> Iterator[Finding]:
    """The sign by the dip of the field under gravity, the axes by how it turns in the body as gyro does."""
    stream, imu, expected = facts.session.magnetometer, facts.imu, facts.session.magnetic_field_ut
    if stream is None or imu is None:
        return
    inside = (stream.t_ns >= imu.t_ns[0]) & (stream.t_ns <= imu.t_ns[-1])
    field, t_ns = stream.field_ut[inside], stream.t_ns[inside]
    if len(field) < LEAST_ROWS:
        return
    up = interpolate(t_ns, imu.t_ns, imu.accel)
    sizes = np.linalg.norm(field, axis=1) * np.linalg.norm(up, axis=1)
    sine = np.median((field * up).sum(axis=1) / np.maximum(sizes, 1e-9))
    if expected is not None and abs(size / np.linalg.norm(expected) - 1.0) < 0.3:
        wanted = float(expected[2] / np.linalg.norm(expected))
        if abs(wanted) > 0.5 and abs(sine + wanted) < 0.2:
            found, dip = np.degrees(np.arcsin(sine)), np.degrees(np.arcsin(wanted))
            text = f"field points {found:+.0f} deg from the horizon, expected {dip:+.0f}"
            yield Finding("magnetometer", f"{text}: its sign is wrong", "flip the sign of all axes")
            return
    yield from _field_turns(facts, t_ns, field)


def _field_turns(facts: Facts, t_ns: Times, field: Floats) -> Iterator[Finding]:
    """Changes of the field over a second against those predicted from gyro, B(t + dt) = Exp(-w dt) B(t)."""
    from scipy.ndimage import uniform_filter1d

    imu = facts.imu
    assert imu is not None
    every = min(max(1, round(NS / float(np.median(np.diff(t_ns))))), len(t_ns))
    field, t_ns = uniform_filter1d(field, every, axis=0)[::every], t_ns[::every]
    length = (t_ns[1:] - t_ns[:-1]) / NS
    whole = length < 2.0
    if whole.sum() < LEAST_ROWS:
        return
    angle = np.cumsum(imu.gyro * np.diff(imu.t_ns, prepend=imu.t_ns[0])[:, None] / NS, axis=0)
    turn = np.diff(interpolate(t_ns, imu.t_ns, angle), axis=0)[whole]
    change = np.diff(field, axis=0)[whole]
    predicted = rotate(exp(-turn), field[:-1][whole]) - field[:-1][whole]
    power = float((predicted**2).sum())
    slope = float((change * predicted).sum()) / max(power, 1e-12)
    correlation = slope * np.sqrt(power / max(float((change**2).sum()), 1e-12))
    if correlation < -_CORRELATED:
        text = "field turns against gyro: its axes are mirrored or exchanged, or the sign of gyro is wrong"
        yield Finding("magnetometer", text, "give the field in body axes, right-handed", verdict="contradictory")
    elif correlation > _CORRELATED and 30.0 < slope < 90.0:
        text = f"the field turns {slope:.0f} times as fast as gyro: it looks converted from deg to rad twice"
        yield in_another_unit("imu", text, "multiply gyro by 180/pi", "gyro", 180.0 / np.pi)


def _pressure(facts: Facts) -> Iterator[Finding]:
    stream = facts.session.barometer
    if stream is None or len(stream) < LEAST_ROWS:
        return
    median, low, high = float(np.median(stream.pressure_hpa)), *_PRESSURE_HPA
    height = facts.session.origin.height_m if facts.session.origin is not None else None
    # standard atmosphere (ISO 2533)
    expected = 1013.25 * (1.0 - 2.25577e-5 * height) ** 5.25588 if height is not None and height < 11_000 else None
    wanted = f"about {expected:.0f} hPa at {height:.0f} m" if expected is not None else f"{low:.0f} to {high:.0f} hPa"
    right = low <= median <= high and (expected is None or abs(median / expected - 1.0) < _WEATHER)
    if not right:
        centre = expected if expected is not None else 980.0
        share = _WEATHER if expected is not None else 0.25
        text = f"median pressure {median:.5g} hPa, expected {wanted}"
        for factor, unit in _PRESSURE_UNITS.items():
            if abs(median / factor / centre - 1.0) < share:
                text = f"{text}: it looks like {unit}"
                yield in_another_unit("barometer", text, "give hPa", "pressure_hpa", 1.0 / factor)
                return
        yield Finding("barometer", text, "check unit and [origin] height_m")


def _temperature(facts: Facts) -> Iterator[Finding]:
    stream = facts.session.temperature
    if stream is None or not len(stream):
        return
    median = float(np.median(stream.temperature_c))
    if not -60.0 < median < 110.0:
        looks = ": it looks like kelvin" if 230.0 < median < 370.0 else ""
        yield Finding("temperature", f"median {median:.4g} deg C{looks}", "give degrees Celsius")


def _spikes(facts: Facts) -> Iterator[Finding]:
    """Single readings far from those before and after, which no motion and no weather leaves as they are."""
    for name, field, least in _SPIKES:
        stream = getattr(facts.session, name)
        if stream is None:
            continue
        values = getattr(stream, field).reshape(len(stream), -1)
        rows = spike_rows(values, least)
        if len(rows):
            row, count = int(rows[0]), count_of(len(rows), "single reading")
            at, reading = float(facts.session.seconds(stream.t_ns[row])), " ".join(f"{x:.6g}" for x in values[row])
            text = f"{count} of {field} far from its neighbours, the first {reading} at row {row}, {at:.3f} s"
            yield Finding(name, text, "correct it, or leave the row out", verdict="good")


def _speeds(facts: Facts) -> Iterator[Finding]:
    """Wheel speed and body velocity against the motion of the fixes."""
    forward = frames.axis_vector(facts.session.device.forward)
    wheel, velocity = facts.session.wheel, facts.session.velocity
    rolls = facts.session.device.vehicle in ("car", "trolley")
    if wheel is not None and len(wheel) >= LEAST_ROWS:
        yield from _speed(facts, "wheel", "speed", wheel.t_ns, wheel.speed, wheel.speed)
    if velocity is not None and len(velocity) >= LEAST_ROWS:
        along = velocity.velocity @ forward
        size = np.linalg.norm(velocity.velocity, axis=1)
        yield from _speed(facts, "velocity", "velocity", velocity.t_ns, size, along if rolls else size)


def _speed(facts: Facts, where: str, what: str, t_ns: Times, size: Floats, along: Floats) -> Iterator[Finding]:
    chords = facts.chords
    fastest = float(np.quantile(np.abs(size), 0.99))
    inside = None if chords is None else chords.clear & (chords.t_ns >= t_ns[0]) & (chords.t_ns <= t_ns[-1])
    if chords is None or inside is None or inside.sum() < LEAST_ROWS:
        if fastest > _MAX_SPEED:
            yield Finding(where, f"99 % quantile of {what} is {fastest:.4g} m/s, faster than any car", "give m/s")
        return
    mean, way = (over_chords(chords, t_ns, values)[inside] for values in (np.abs(size), along))
    known = chords.speed[inside]
    yield from odd_speed(where, what, mean, known)
    if float(np.median(way / known)) < -0.3:
        yield Finding(where, f"{what} is backwards while the fixes move", "flip its sign, or correct [device] forward")
    elif float(np.median(mean / known)) < 0.05:
        yield Finding(where, f"{what} is zero while the fixes move", f"remove {where}, or import it again")


def _standstills(facts: Facts) -> Iterator[Finding]:
    """Listed standstills in which the device or the fixes move."""
    stream, imu, chords = facts.session.static, facts.imu, facts.chords
    if stream is None or imu is None:
        return
    moving = 0
    for begin, end in zip(stream.t_ns, stream.t_end_ns, strict=True):
        inside = (imu.t_ns >= begin) & (imu.t_ns <= end)
        turned = inside.sum() >= LEAST_ROWS and float(imu.gyro[inside].std(axis=0).max()) > _TURNS
        within = (
            np.zeros(0, dtype=bool) if chords is None else (chords.t_ns > begin + 2 * NS) & (chords.t_ns < end - 2 * NS)
        )
        went = chords is not None and within.any() and bool(np.median(chords.clear[within]) > 0.5)
        moving += bool(turned or went)
    if moving:
        text = f"the device moves in {count_of(moving, 'listed standstill')} of {len(stream)}"
        yield Finding("static", text, "check their stamps; a false standstill bends the trajectory")


def _pictures(facts: Facts) -> Iterator[Finding]:
    """Images without their picture; matches and tracks do not need it any more."""
    images, folder = facts.session.images, facts.session.pictures
    if images is None:
        return
    files = [file for file in map(str, images.file) if file]
    lost = [file for file in files if folder is None or file_inside(folder, file) is None]
    if lost:
        done = facts.session.matches is not None or facts.session.tracks is not None
        text = f"{len(lost)} of {len(files)} pictures are missing, the first is {lost[0]}"
        remedy = "not needed, as there are matches or tracks" if done else "copy them, or import the whole folder"
        yield Finding("images", text, remedy, "info" if done else "warning", verdict="good")


RULES = (_field, _pressure, _temperature, _spikes, _speeds, _standstills, _pictures)

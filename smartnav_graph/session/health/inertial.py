"""The inertial stream: units and signs of both triads, gravity at rest, data gaps, frozen and clipped readings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Mask
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.timebase import NS, nearest
from smartnav_graph.session.health.facts import (
    CHORD_S,
    LEAST_ROWS,
    Facts,
    Finding,
    count_of,
    decimated,
    in_another_unit,
    over_chords,
    period,
    repeats,
    spike_rows,
)
from smartnav_graph.session.streams import Imu

_DEG = np.pi / 180
_UNITS = (1.0, _DEG, 1.0 / _DEG, -1.0)  # of gyro as recorded
_TILTED = 5.0  # deg that gravity may end off within 2 s
_MAX_RATE = 35.0  # rad/s = 2000 deg/s, where consumer gyroscopes saturate
_MAX_RMS_RATE = 10.0  # rad/s; a phone shaken by hand reaches 5
_SPIKES = {"accel": 80.0, "gyro": 20.0}  # m/s^2, rad/s
_FROZEN_S = 1.0  # six axes never repeat for so long
_CLEAR_TURN = 0.4  # rad in some seconds
_CORRELATED = 0.7  # correlation beyond chance


def quiet_accel(imu: Imu) -> float | None:
    """Median |accel| (m/s^2) of the quiet half seconds; None when the device is never quiet.

    Quiet: on every axis accel varies by less than 0.4 m/s^2 and gyro by less than 0.05 rad/s (standard deviations),
    several times the noise of a phone at rest and less than any step or engine under load.
    """
    from scipy.ndimage import uniform_filter1d

    imu = decimated(imu)
    if len(imu) < 6:
        return None
    width = max(3, round(0.5 / period(imu)))
    if len(imu) < 2 * width:
        return None

    def spread(values: Floats) -> Floats:
        centred = values - values.mean(axis=0)
        mean = uniform_filter1d(centred, width, axis=0)
        return np.asarray(np.sqrt(np.maximum(uniform_filter1d(centred**2, width, axis=0) - mean**2, 0.0)).max(axis=1))

    quiet = (spread(imu.accel) < 0.4) & (spread(imu.gyro) < 0.05)
    return float(np.median(np.linalg.norm(imu.accel[quiet], axis=1))) if quiet.sum() >= width else None


def _gaps(facts: Facts) -> Iterator[Finding]:
    for kind, what in (("missing", "without samples"), ("bridged", "linearly interpolated")):
        gaps = [gap for gap in facts.gaps if gap.kind == kind]
        if gaps:
            total, longest = sum(gap.length_s for gap in gaps), max(gaps, key=lambda gap: gap.length_s)
            at, count = float(facts.session.seconds(longest.start_ns)), count_of(len(gaps), "data gap")
            text = f"{count} {what}, {total:.2f} s in all, longest {longest.length_s:.2f} s at {at:.2f} s"
            yield Finding("imu", text, "the uncertainty grows there; fixes around them help", verdict="good")


def _accel_unit(facts: Facts) -> Iterator[Finding]:
    if facts.imu is None:
        return
    median = float(np.median(np.linalg.norm(facts.imu.accel, axis=1)))
    g, found = facts.session.gravity, f"median |accel| {median:.3g} m/s^2, expected about {facts.session.gravity:.4g}"
    if abs(median - 1.0) < 0.2:
        text = f"{found}: it looks like units of g"
        yield in_another_unit("imu", text, "multiply accel by 9.80665", "accel", STANDARD_GRAVITY)
    elif abs(median - g * g) < 0.2 * g * g:
        text = f"{found}: it looks scaled by 9.81 twice"
        yield in_another_unit("imu", text, "divide accel by 9.80665", "accel", 1.0 / STANDARD_GRAVITY)
    elif median < 0.5 * g:
        yield Finding("imu", f"{found}: gravity seems removed", "import specific force, gravity included")
    elif median > 2.0 * g:
        yield Finding("imu", f"{found}: {median / g:.3g} times too large", "import accel in m/s^2")
    elif facts.quiet_accel is not None and abs(facts.quiet_accel - g) > 0.1 * g:
        text = f"|accel| at rest {facts.quiet_accel:.3f} m/s^2, {100 * (facts.quiet_accel / g - 1):+.1f} % off gravity"
        yield Finding("imu", text, "calibrate the accelerometer, or check gravity_m_s2 of the session")


def _gyro_unit(facts: Facts) -> Iterator[Finding]:
    if facts.imu is None:
        return
    rate = np.linalg.norm(facts.imu.gyro, axis=1)
    high, rms = float(np.quantile(rate, 0.999)), float(np.sqrt((rate**2).mean()))
    errors = tilt_errors(facts.imu, (1.0,))
    if errors is not None and errors[1.0] > _TILTED:
        errors = tilt_errors(facts.imu)
    if high > _MAX_RATE:
        text = f"99.9 % quantile of |gyro| is {high:.3g} rad/s, beyond 2000 deg/s: it looks like deg/s"
        yield in_another_unit("imu", text, "multiply gyro by pi/180", "gyro", _DEG)
    elif rms > _MAX_RMS_RATE:
        text = f"RMS |gyro| is {rms:.3g} rad/s: it looks like deg/s"
        yield in_another_unit("imu", text, "multiply gyro by pi/180", "gyro", _DEG)
    elif errors is not None and errors[1.0] > 20.0 and errors[_DEG] < errors[1.0] / 4:
        text = f"integrated gyro turns gravity {errors[1.0]:.0f} deg away from accel within 2 s: it looks like deg/s"
        yield in_another_unit("imu", text, "multiply gyro by pi/180", "gyro", _DEG)
    elif errors is not None and errors[1.0] > _TILTED and errors[-1.0] < errors[1.0] / 4:
        text = "gyro turns against the tilt that accel shows: its sign is wrong"
        yield Finding("imu", text, "flip the sign of gyro", verdict="contradictory")
    elif errors is not None and errors[1.0] > _TILTED and errors[1.0 / _DEG] < errors[1.0] / 4:
        text = "accel tilts 57.3 times faster than gyro turns: gyro looks converted from deg to rad twice"
        yield in_another_unit("imu", text, "multiply gyro by 180/pi", "gyro", 1.0 / _DEG)


def tilt_errors(
    imu: Imu, scales: Sequence[float] = _UNITS, *, window_s: float = 2.0, windows: int = 300
) -> dict[float, float] | None:
    """How far gravity turned by the gyro ends from the accelerometer's, for three units and the opposite sign.

    For windows at whose ends |accel| is near its median, the up direction a_0 (body axes) is carried through the
    window, a_1 = (prod Exp(s omega dt))^T a_0, with s = 1, pi/180, 180/pi and -1. With the right unit the angle to the
    measured a_1 stays at a few degrees whatever the device does; a constant bias of 0.1 rad/s adds 11 degrees. It
    needs no change of tilt: rates of some deg/s read as rad/s carry the up direction all over the sphere.

    Returns
    -------
    Median angle in degrees by s; None when fewer than ten windows qualify.
    """
    from scipy.ndimage import uniform_filter1d

    imu = decimated(imu)
    step = period(imu)
    n = round(window_s / step)
    if n < 8 or len(imu) < 2 * n:
        return None
    accel = uniform_filter1d(imu.accel, max(1, round(0.1 / step)), axis=0)
    norm = np.linalg.norm(accel, axis=1)
    calm = np.abs(norm - np.median(norm)) < 0.1 * np.median(norm)
    start = np.arange(len(imu) - n)
    whole = imu.t_ns[start + n] - imu.t_ns[start] < 1.2 * window_s * NS
    start = start[whole & calm[start] & calm[start + n]]
    if len(start) < 10:
        return None
    start = start[np.linspace(0, len(start) - 1, min(windows, len(start))).astype(int)]
    up_0, up_1 = (accel[rows] / norm[rows, None] for rows in (start, start + n))
    return {s: _median_angle_deg(imu, start, n, s, up_0, up_1) for s in scales}


def _median_angle_deg(imu: Imu, start: Indices, n: int, s: float, up_0: Floats, up_1: Floats) -> float:
    from scipy.spatial.transform import Rotation

    turn = Rotation.identity(len(start))
    for row in (start + i for i in range(n)):
        dt = (imu.t_ns[row + 1] - imu.t_ns[row])[:, None] / NS
        turn = turn * Rotation.from_rotvec(s * 0.5 * (imu.gyro[row] + imu.gyro[row + 1]) * dt)
    cosine = (turn.inv().apply(up_0) * up_1).sum(axis=1)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


def _gyro_course(facts: Facts) -> Iterator[Finding]:
    """Size of the turns of the course of the fixes against those of the gyro about the vertical."""
    turns = _turns(facts)
    if turns is None:
        return
    course, gyro = turns
    correlation, slope = _fit(course, gyro, np.abs(course) > _CLEAR_TURN)
    if correlation > _CORRELATED and 30.0 < slope < 90.0:
        text = f"the fixes turn {slope:.0f} times as fast as gyro: it looks converted from deg to rad twice"
        yield in_another_unit("imu", text, "multiply gyro by 180/pi", "gyro", 1.0 / _DEG)


def _fit(course: Floats, gyro: Floats, clear: Mask) -> tuple[float, float]:
    """Correlation of the clear turns, and how many times the course turns as fast; zeros where they are few."""
    c, g = course[clear], gyro[clear]
    power = float(g @ g)
    if len(c) < LEAST_ROWS or not power > 0:
        return 0.0, 0.0
    return float(c @ g) / float(np.sqrt(power * (c @ c))), float(c @ g) / power


def _turns(facts: Facts) -> tuple[Floats, Floats] | None:
    """Turn (m,) rad of the course over some seconds, and of the gyro about the vertical; None without clear turns."""
    imu, chords = facts.imu, facts.chords
    if imu is None or chords is None or chords.clear.sum() < LEAST_ROWS:
        return None
    up = over_chords(chords, imu.t_ns, imu.accel)
    rate = over_chords(chords, imu.t_ns, imu.gyro)
    yaw = (rate * up).sum(axis=1) / np.maximum(np.linalg.norm(up, axis=1), 1e-9)
    half = round(0.5 * CHORD_S * NS)
    before, after = (nearest(chords.t_ns + shift, chords.t_ns) for shift in (-half, half))
    length = (chords.t_ns[after] - chords.t_ns[before]) / NS
    good = chords.clear & chords.clear[before] & chords.clear[after] & (np.abs(length - CHORD_S) < 0.3 * CHORD_S)
    course = np.arctan2(chords.velocity[:, 1], chords.velocity[:, 0])
    turn = np.asarray((course[after] - course[before] + np.pi) % (2 * np.pi) - np.pi)[good]
    return turn, yaw[good] * length[good]


def _frozen(facts: Facts) -> Iterator[Finding]:
    """Stretches in which all six axes repeat one row, and axes that never change."""
    imu = facts.imu
    if imu is None:
        return
    signal = np.hstack([imu.gyro, imu.accel])
    names = [f"{sensor} {axis}" for sensor in ("gyro", "accel") for axis in "xyz"]
    for name, column in zip(names, signal.T, strict=True):
        triad = imu.gyro if name.startswith("gyro") else imu.accel
        if (column == column[0]).all() and not (triad == triad[0]).all():
            yield Finding("imu", f"{name} is {column[0]:g} in all {len(imu)} rows", "import the log again")
    frozen = [run for run in repeats(signal) if (imu.t_ns[run[1]] - imu.t_ns[run[0]]) / NS > _FROZEN_S]
    if frozen and frozen[0] != (0, len(imu) - 1):
        at = float(facts.session.seconds(imu.t_ns[frozen[0][0]]))
        seconds = sum(float(imu.t_ns[last] - imu.t_ns[first]) for first, last in frozen) / NS
        where = f"{count_of(len(frozen), 'stretch', 'es')}, first at {at:.1f} s"
        text = f"repeats one row of readings for {seconds:.1f} s in {where}"
        yield Finding("imu", text, "sensor output frozen; remove the rows so that they count as a gap")


def _spikes(facts: Facts) -> Iterator[Finding]:
    """Single readings far from those before and after, which no motion leaves as they are."""
    imu = facts.imu
    if imu is None:
        return
    for name, rows in spikes(imu).items():
        row = int(rows[0])
        reading = np.abs(getattr(imu, name)[row]).max()
        at, count = float(facts.session.seconds(imu.t_ns[row])), count_of(len(rows), "single reading")
        text = f"{count} of {name} far from its neighbours, the first {reading:.4g} at row {row}, {at:.3f} s"
        yield Finding("imu", text, "not used; interpolated between its neighbours")


def spikes(imu: Imu) -> dict[str, Indices]:
    """Rows of single readings of accel and gyro that are spikes (`spike_rows`)."""
    found = {name: spike_rows(getattr(imu, name), least) for name, least in _SPIKES.items()}
    return {name: rows for name, rows in found.items() if len(rows)}


def _clipped(facts: Facts) -> Iterator[Finding]:
    """Readings that repeat the largest value: the end of the range."""
    if facts.imu is None:
        return
    for name, values, least in (("accel", facts.imu.accel, 1.5 * facts.session.gravity), ("gyro", facts.imu.gyro, 4.0)):
        size = np.abs(values).max(axis=1)
        top = float(size.max())
        at_top = size >= top * (1 - 1e-6)
        if top > least and at_top.sum() >= LEAST_ROWS and (at_top[1:] & at_top[:-1]).sum() >= LEAST_ROWS // 2:
            text = f"|{name}| is {top:.4g} in {int(at_top.sum())} rows: the end of its range"
            yield Finding("imu", text, "choose a larger range when recording; the motion there is lost")


RULES = (_accel_unit, _gyro_unit, _gyro_course, _frozen, _spikes, _clipped, _gaps)

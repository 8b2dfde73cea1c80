"""Every stream: rows, clock, overlap with the inertial stream, values that never change."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.health.facts import AIDING, LEAST_ROWS, Facts, Finding, period
from smartnav_graph.session.repair import arrives_in_bursts
from smartnav_graph.session.streams import ABSOLUTE, StaticPeriod

_MOST_RATE_HZ = 8000.0  # of an IMU that people have
_UNITS = {"microseconds": 3, "milliseconds": 6, "seconds": 9}
_SLOW_HZ = 20.0
_LONGEST_DAYS = 2.0  # of a recording with less than one inertial sample a second
_UNIX_FROM, _UNIX_TO = 631_152_000 * NS, 4_102_444_800 * NS  # 1990 to 2100


def _rows(facts: Facts) -> Iterator[Finding]:
    session = facts.session
    for name, stream in session.streams().items():
        if not len(stream):
            yield Finding(name, "has no rows", "remove the stream, or import the log again", "error")
    if session.imu is None:
        text, remedy = "there are no inertial data", "record accelerometer and gyroscope at 20 Hz or more"
        if counts := session.dropped.get("imu"):
            text += f" ({', '.join(f'{count} rows {reason}' for reason, count in counts.items())})"
        if session.positions():
            text += ": positions are smoothed with constant velocity between them, attitude is not estimated"
        yield Finding("imu", text, remedy, "warning" if session.positions() else "error")
    elif 0 < len(session.imu) < 2:
        yield Finding("imu", "has one row only", "import at least two", "error")
    elif len(session.imu) and (length := (session.imu.t_ns[-1] - session.imu.t_ns[0]) / NS) < 1.0:
        yield Finding("imu", f"lasts {length:.3f} s only", "check the unit of its time stamps")
    if not session.absolute():
        text = f"no absolute sensor ({', '.join(ABSOLUTE)})"
        yield Finding("session", text, "start from a standstill or with --initial for dead reckoning", verdict="good")


def dropped(facts: Facts) -> Iterator[Finding]:
    """Rows that were left out, by stream and reason."""
    for name, counts in facts.session.dropped.items():
        yield Finding(name, ", ".join(f"{count} {reason}" for reason, count in counts.items()), level="info")


def stamps(facts: Facts) -> Iterator[Finding]:
    """Inertial stamps that are no nanoseconds, or no times of samples: nothing else can be checked then."""
    imu = facts.session.imu
    if imu is None or len(imu) < LEAST_ROWS:
        return
    step = float(imu.t_ns[-1] - imu.t_ns[0]) / (len(imu) - 1)
    if step < NS / _MOST_RATE_HZ:
        fits = [(unit, power) for unit, power in _UNITS.items() if NS / _MOST_RATE_HZ <= step * 10**power <= NS]
        looks = f": they look like {fits[0][0]}" if fits else ""
        remedy = f"multiply t_ns of every stream by 1e{fits[0][1]}" if fits else "give t_ns in nanoseconds"
        text = f"{len(imu)} stamps of t_ns lie {step:.4g} ns apart on the mean{looks}"
        yield Finding("imu", text, remedy, "error")
    elif step > NS and (days := step * len(imu) / NS / 86400) > _LONGEST_DAYS:
        text = f"{len(imu)} rows in {days:.4g} days: {step / NS:.4g} s from one to the next on the mean"
        yield Finding("imu", text, "check the unit of t_ns, or cut the recording where it has long gaps", "error")
    elif arrives_in_bursts(imu.t_ns):
        short = float(np.median(np.diff(imu.t_ns)))
        text = f"rows arrive in bursts: the median step is {short / 1e3:.3g} us, the mean {step / 1e6:.4g} ms"
        yield Finding("imu", text, "give the times of the samples, or add --repair clock to spread them", "error")


def _clock(facts: Facts) -> Iterator[Finding]:
    session = facts.session
    if session.clock_epoch == "unix" and not _UNIX_FROM <= session.t0_ns <= _UNIX_TO:
        text = f"epoch is unix, but time zero is {session.t0_ns} ns, outside 1990 to 2100"
        yield Finding("session.toml [clock]", text, "check the unit of t_ns, or set another epoch")
    if facts.imu is None:
        return
    rate = 1.0 / period(facts.imu)
    if not 1.0 <= rate <= 20_000.0:
        text = f"median rate {rate:.4g} Hz is outside 1 Hz to 20 kHz"
        yield Finding("imu", text, "t_ns counts nanoseconds; check the unit of the time stamps")
    elif rate < _SLOW_HZ:
        text = f"median rate {rate:.3g} Hz is too low to follow the motion between samples"
        remedy = f"record at {_SLOW_HZ:g} Hz at least; attitude and speed are uncertain"
        yield Finding("imu", text, remedy, verdict="good")


def _constant(facts: Facts) -> Iterator[Finding]:
    s = facts.session
    # a phone at rest may repeat one fix, and pressure is quantised: possible, therefore a warning only
    columns: list[tuple[str, str, str, Floats | None]] = [
        ("error", "imu", "gyro", s.imu.gyro if s.imu else None),
        ("error", "imu", "accel", s.imu.accel if s.imu else None),
        ("error", "magnetometer", "field", s.magnetometer.field_ut if s.magnetometer else None),
        ("warning", "gnss", "position", s.nav_position(s.gnss) if s.gnss else None),
        ("warning", "pose_fixes", "position", s.nav_position(s.pose_fixes) if s.pose_fixes else None),
        ("warning", "barometer", "pressure", s.barometer.pressure_hpa if s.barometer else None),
        ("warning", "velocity", "velocity", s.velocity.velocity if s.velocity else None),
        ("warning", "wheel", "speed", s.wheel.speed if s.wheel else None),
        ("warning", "temperature", "temperature", s.temperature.temperature_c if s.temperature else None),
    ]
    for level, stream, what, values in columns:
        if (
            values is not None
            and len(values) >= LEAST_ROWS
            and (values == values[0]).all()
            and not _resting(facts, stream)
        ):
            text = f"{what} is {' '.join(f'{x:g}' for x in np.atleast_1d(values[0]))} in all {len(values)} rows"
            yield Finding(stream, text, f"if the sensor did not record, remove {stream} or import it again", level)


def _resting(facts: Facts, stream: str) -> bool:
    """Whether a speed that is always zero may be true: the fixes do not move either."""
    if stream not in ("velocity", "wheel"):
        return False
    values = getattr(facts.session, stream)
    zero = not np.any(values.velocity if stream == "velocity" else values.speed)
    return zero and (facts.chords is None or not facts.chords.clear.any())


def _overlap(facts: Facts) -> Iterator[Finding]:
    imu = facts.session.imu
    if imu is None or len(imu) < 2:
        return
    first, last = int(imu.t_ns[0]), int(imu.t_ns[-1])
    inside: dict[str, int] = {}
    for name in AIDING:
        stream = getattr(facts.session, name)
        if stream is None or not len(stream):
            continue
        ends = stream.t_end_ns if isinstance(stream, StaticPeriod) else stream.t_ns
        count = inside[name] = int(((ends >= first) & (stream.t_ns <= last)).sum())
        if count < len(stream):
            begin, end = facts.session.seconds([stream.t_ns[0], ends[-1]])
            text = (
                f"{len(stream) - count} of {len(stream)} rows lie outside the imu's span "
                f"0 to {(last - first) / NS:.3f} s (the stream spans {begin:.3f} to {end:.3f} s)"
            )
            yield Finding(name, text, "they are not used; check that both use one clock", verdict="good")
    absolute = [name for name in inside if name in ABSOLUTE]
    if absolute and not any(inside[name] for name in absolute):
        text = f"no row of {', '.join(absolute)} lies inside the imu's span 0 to {(last - first) / NS:.3f} s"
        yield Finding("session", text, "bring the stamps of both to one clock", "error")


RULES = (_rows, _clock, _constant, _overlap)

"""Is a recorded session what it says? Rates, gaps, units, signs, overlaps: looked at before anything is estimated.

Nothing is repaired here. Every rule is a small generator of findings; `RULES` is the list of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from smartnav_graph import frames
from smartnav_graph.errors import SessionError
from smartnav_graph.session import Session
from smartnav_graph.streams import Imu, Positioned, StaticPeriod, Stream
from smartnav_graph.timebase import NS, Gap, find_gaps, seconds_since

Floats = NDArray[np.float64]

ABSOLUTE = ("gnss", "control", "pose_fixes")  # sensors that tell a position
AIDING = (*ABSOLUTE, "static", "magnetometer", "barometer", "velocity", "wheel")

_MAX_FIX_SPEED = 100.0  # m/s; faster than any car
_MAX_RATE = 35.0  # rad/s = 2000 deg/s, where consumer gyroscopes saturate
_MAX_RMS_RATE = 10.0  # rad/s; a phone shaken by hand reaches 5
_UNIX_FROM, _UNIX_TO = 631_152_000 * NS, 4_102_444_800 * NS  # 1990 to 2100


@dataclass(frozen=True)
class Finding:
    """One thing noticed. level is ``error`` (cannot be estimated from), ``warning`` (looks wrong) or ``info``."""

    level: str
    where: str
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.where}: {self.text}" + (f"; {self.remedy}" if self.remedy else "")


@dataclass(frozen=True)
class StreamHealth:
    """Rows of one stream; start in seconds since time zero, length in seconds, mean rate in Hz (NaN for one row)."""

    name: str
    rows: int
    start_s: float
    length_s: float
    rate_hz: float


@dataclass(frozen=True, kw_only=True)
class Health:
    """What a session holds and what was noticed. Accelerations m/s^2; gaps are those of the inertial stream."""

    streams: tuple[StreamHealth, ...]
    gaps: tuple[Gap, ...]
    clock_epoch: str
    gravity_m_s2: float
    quiet_accel_m_s2: float | None
    missing: tuple[str, ...]
    findings: tuple[Finding, ...]
    t0_ns: int

    def warnings(self) -> list[str]:
        """The warnings, each ``<where>: <found>; <remedy>``."""
        return [str(finding) for finding in self.findings if finding.level == "warning"]

    def raise_errors(self) -> None:
        """Raise the first finding of level error.

        Raises
        ------
        SessionError
            The session cannot be estimated from.
        """
        for finding in self.findings:
            if finding.level == "error":
                raise SessionError(finding.where, finding.text, remedy=finding.remedy)

    def to_text(self) -> str:
        """Plain lines for a terminal."""
        lines = [f"{'stream':<14}{'rows':>9}{'start s':>12}{'length s':>12}{'rate Hz':>10}"]
        lines += [
            f"{s.name:<14}{s.rows:>9}{s.start_s:>12.3f}{s.length_s:>12.3f}{s.rate_hz:>10.2f}" for s in self.streams
        ]
        quiet = "no quiet stretch" if self.quiet_accel_m_s2 is None else f"{self.quiet_accel_m_s2:.4f} m/s^2 at rest"
        lines += [
            f"clock: {self.clock_epoch}, time zero {self.t0_ns} ns",
            f"gravity: {self.gravity_m_s2:.5f} m/s^2 expected, accelerometer {quiet}",
            f"gaps: {len(self.gaps)}",
        ]
        lines += [f"  {g.kind} {g.length_s:.3f} s at {seconds_since(g.start_ns, self.t0_ns):.3f} s" for g in self.gaps]
        lines.append(f"missing: {', '.join(self.missing) or 'nothing'}")
        return "\n".join(lines + [f"{finding.level}: {finding}" for finding in self.findings])


@dataclass(frozen=True)
class Facts:
    """What several rules need of one session."""

    session: Session
    gaps: tuple[Gap, ...]
    quiet_accel: float | None

    @property
    def imu(self) -> Imu | None:
        """The inertial stream when it is long enough to be judged."""
        imu = self.session.imu
        return imu if imu is not None and len(imu) >= 10 else None


def inspect(session: Session, gaps: Sequence[Gap] | None = None) -> Health:
    """Look a session over; `gaps` of the inertial stream, where they are known already.

    Streams that will not be used can be left out first: ``inspect(session.replace(magnetometer=None))``.
    """
    imu = session.imu
    usable = imu is not None and len(imu) >= 2
    if gaps is None:
        gaps = find_gaps(imu.t_ns, np.hstack([imu.gyro, imu.accel])) if usable and imu is not None else ()
    facts = Facts(session, tuple(gaps), quiet_accel(imu) if usable and imu is not None else None)
    findings = [finding for rule in RULES for finding in rule(facts)]
    order = {"error": 0, "warning": 1, "info": 2}
    return Health(
        streams=tuple(_stream_health(session, name, stream) for name, stream in session.streams().items()),
        gaps=facts.gaps,
        clock_epoch=session.clock_epoch,
        gravity_m_s2=session.gravity,
        quiet_accel_m_s2=facts.quiet_accel,
        missing=_missing(session),
        findings=tuple(sorted(findings, key=lambda finding: order[finding.level])),
        t0_ns=session.t0_ns,
    )


def _stream_health(session: Session, name: str, stream: Stream) -> StreamHealth:
    if not len(stream):
        return StreamHealth(name, 0, np.nan, 0.0, np.nan)
    start, end = session.seconds(stream.t_ns[[0, -1]])
    length = float(end - start)
    return StreamHealth(name, len(stream), float(start), length, (len(stream) - 1) / length if length else np.nan)


def _missing(session: Session) -> tuple[str, ...]:
    there = session.streams()
    out = [] if "imu" in there else ["imu"]
    out += [] if any(name in there for name in ABSOLUTE) else [f"absolute sensor ({', '.join(ABSOLUTE)})"]
    out += ["origin"] if session.origin is None else []
    out += ["calibration"] if session.calibration is None else []
    return (*out, *([] if "reference" in there else ["reference"]))


def quiet_accel(imu: Imu) -> float | None:
    """Median |accel| (m/s^2) of the quiet half seconds; None when the device is never quiet.

    Quiet: on every axis accel varies by less than 0.4 m/s^2 and gyro by less than 0.05 rad/s (standard deviations),
    several times the noise of a phone at rest and less than any step or engine under load.
    """
    imu = _thinned(imu)
    if len(imu) < 6:
        return None
    width = max(3, round(0.5 / _period(imu)))
    if len(imu) < 2 * width:
        return None

    def spread(values: Floats) -> Floats:
        centred = values - values.mean(axis=0)
        mean = uniform_filter1d(centred, width, axis=0)
        return np.asarray(np.sqrt(np.maximum(uniform_filter1d(centred**2, width, axis=0) - mean**2, 0.0)).max(axis=1))

    quiet = (spread(imu.accel) < 0.4) & (spread(imu.gyro) < 0.05)
    return float(np.median(np.linalg.norm(imu.accel[quiet], axis=1))) if quiet.sum() >= width else None


def _thinned(imu: Imu) -> Imu:
    """Every n-th row, to 50 Hz: enough to see a step or a turn."""
    every = max(1, round(0.02 / _period(imu)))
    return imu.take(slice(None, None, every)) if every > 1 else imu


def _period(imu: Imu) -> float:
    return float(np.median(np.diff(imu.t_ns))) / NS


def _rows(facts: Facts) -> Iterator[Finding]:
    session = facts.session
    for name, stream in session.streams().items():
        if not len(stream):
            yield Finding("error", name, "has no rows", "remove the stream, or import the log again")
    if session.imu is None:
        yield Finding("error", "imu", "there is no inertial stream", "import one; everything else hangs on it")
    elif 0 < len(session.imu) < 2:
        yield Finding("error", "imu", "has one row only", "import at least two")
    elif len(session.imu) and (length := (session.imu.t_ns[-1] - session.imu.t_ns[0]) / NS) < 1.0:
        yield Finding("warning", "imu", f"lasts {length:.3f} s only", "check the unit of its time stamps")
    if not any(getattr(session, name) is not None for name in ABSOLUTE):
        text = f"no absolute sensor ({', '.join(ABSOLUTE)})"
        yield Finding("warning", "session", text, "start from a standstill or with --initial for dead reckoning")


def _dropped(facts: Facts) -> Iterator[Finding]:
    for name, counts in facts.session.dropped.items():
        yield Finding("info", name, ", ".join(f"{count} {reason}" for reason, count in counts.items()))


def _clock(facts: Facts) -> Iterator[Finding]:
    session = facts.session
    if session.clock_epoch == "unix" and not _UNIX_FROM <= session.t0_ns <= _UNIX_TO:
        text = f"epoch is unix, but time zero is {session.t0_ns} ns, outside 1990 to 2100"
        yield Finding("warning", "session.toml [clock]", text, "check the unit of t_ns, or set another epoch")
    if facts.imu is not None and not 1.0 <= (rate := 1.0 / _period(facts.imu)) <= 20_000.0:
        text = f"median rate {rate:.4g} Hz is outside 1 Hz to 20 kHz"
        yield Finding("warning", "imu", text, "t_ns counts nanoseconds; check the unit of the time stamps")


def _gaps(facts: Facts) -> Iterator[Finding]:
    told = {"missing": "without samples", "bridged": "filled by straight lines"}
    for kind, what in told.items():
        gaps = [gap for gap in facts.gaps if gap.kind == kind]
        if gaps:
            total, longest = sum(gap.length_s for gap in gaps), max(gaps, key=lambda gap: gap.length_s)
            at, count = float(facts.session.seconds(longest.start_ns)), _count(len(gaps), "stretch", "es")
            text = f"{count} {what}, {total:.2f} s in all, longest {longest.length_s:.2f} s at {at:.2f} s"
            yield Finding("warning", "imu", text, "the uncertainty grows there; fixes around them help")


def _count(n: int, noun: str, plural: str = "s") -> str:
    return f"{n} {noun}{'' if n == 1 else plural}"


def _constant(facts: Facts) -> Iterator[Finding]:
    s = facts.session
    columns: list[tuple[str, str, str, Floats | None]] = [
        ("error", "imu", "gyro", s.imu.gyro if s.imu else None),
        ("error", "imu", "accel", s.imu.accel if s.imu else None),
        ("error", "magnetometer", "field", s.magnetometer.field_ut if s.magnetometer else None),
        # a phone at rest may repeat one fix, and pressure is quantised: possible, but worth a word
        ("warning", "gnss", "position", s.nav_position(s.gnss) if s.gnss else None),
        ("warning", "barometer", "pressure", s.barometer.pressure_hpa if s.barometer else None),
    ]
    for level, stream, what, values in columns:
        if values is not None and len(values) >= 10 and (values == values[0]).all():
            text = f"{what} is {' '.join(f'{x:g}' for x in np.atleast_1d(values[0]))} in all {len(values)} rows"
            yield Finding(level, stream, text, f"if the sensor did not record, remove {stream} or import it again")


def _accel_unit(facts: Facts) -> Iterator[Finding]:
    if facts.imu is None:
        return
    median = float(np.median(np.linalg.norm(facts.imu.accel, axis=1)))
    g, said = facts.session.gravity, f"median |accel| {median:.3g} m/s^2, expected about {facts.session.gravity:.4g}"
    if abs(median - 1.0) < 0.2:
        yield Finding("warning", "imu", f"{said}: it looks like units of g", "multiply accel by 9.80665")
    elif abs(median - g * g) < 0.2 * g * g:
        yield Finding("warning", "imu", f"{said}: it looks scaled by 9.81 once too often", "divide accel by 9.80665")
    elif median < 0.5 * g:
        yield Finding("warning", "imu", f"{said}: gravity seems removed", "import specific force, gravity included")
    elif median > 2.0 * g:
        yield Finding("warning", "imu", f"{said}: {median / g:.3g} times too large", "import accel in m/s^2")
    elif facts.quiet_accel is not None and abs(facts.quiet_accel - g) > 0.1 * g:
        text = f"|accel| at rest {facts.quiet_accel:.3f} m/s^2, {100 * (facts.quiet_accel / g - 1):+.1f} % off gravity"
        yield Finding("warning", "imu", text, "calibrate the accelerometer, or check gravity_m_s2 of the session")


def _accel_sign(facts: Facts) -> Iterator[Finding]:
    if facts.imu is None:
        return
    norm, up = float(np.median(np.linalg.norm(facts.imu.accel, axis=1))), facts.session.device.up
    along = float((facts.imu.accel @ frames.axis_vector(up)).mean())
    if along < -0.5 * norm:
        text = f"accel along the up axis {up} averages {along:.3g} m/s^2, but specific force points up"
        yield Finding("warning", "imu", text, "flip the sign of accel, or correct [device] up in session.toml")


def _gyro_unit(facts: Facts) -> Iterator[Finding]:
    if facts.imu is None:
        return
    rate = np.linalg.norm(facts.imu.gyro, axis=1)
    high, rms = float(np.quantile(rate, 0.999)), float(np.sqrt((rate**2).mean()))
    errors = tilt_errors(facts.imu)
    degrees = "multiply gyro by pi/180"
    if high > _MAX_RATE:
        text = f"99.9 % quantile of |gyro| is {high:.3g} rad/s, beyond 2000 deg/s: it looks like deg/s"
        yield Finding("warning", "imu", text, degrees)
    elif rms > _MAX_RMS_RATE:
        yield Finding("warning", "imu", f"RMS |gyro| is {rms:.3g} rad/s: it looks like deg/s", degrees)
    elif errors is not None and errors[1.0] > 20.0 and errors[np.pi / 180] < errors[1.0] / 4:
        text = f"integrated gyro turns gravity {errors[1.0]:.0f} deg away from accel within 2 s: it looks like deg/s"
        yield Finding("warning", "imu", text, degrees)
    elif errors is not None and errors[1.0] > 5.0 and errors[180 / np.pi] < errors[1.0] / 4:
        text = "accel tilts 57.3 times faster than gyro turns: gyro looks converted from deg to rad twice"
        yield Finding("warning", "imu", text, "multiply gyro by 180/pi")


def tilt_errors(imu: Imu, *, window_s: float = 2.0, windows: int = 300) -> dict[float, float] | None:
    """How far gravity turned by the gyro ends from the accelerometer's, for three units of the gyro.

    For windows at whose ends |accel| is near its median, the up direction a_0 (body axes) is carried through the
    window, a_1 = (prod Exp(s omega dt))^T a_0, with s = 1, pi/180 and 180/pi. With the right unit the angle to the
    measured a_1 stays at a few degrees whatever the device does; a constant bias of 0.1 rad/s adds 11 degrees. It
    needs no change of tilt: rates of some deg/s read as rad/s carry the up direction all over the sphere.

    Returns
    -------
    Median angle in degrees by s; None when fewer than ten windows qualify.
    """
    imu = _thinned(imu)
    period = _period(imu)
    n = round(window_s / period)
    if n < 8 or len(imu) < 2 * n:
        return None
    accel = uniform_filter1d(imu.accel, max(1, round(0.1 / period)), axis=0)
    norm = np.linalg.norm(accel, axis=1)
    calm = np.abs(norm - np.median(norm)) < 0.1 * np.median(norm)
    start = np.arange(len(imu) - n)
    whole = imu.t_ns[start + n] - imu.t_ns[start] < 1.2 * window_s * NS
    start = start[whole & calm[start] & calm[start + n]]
    if len(start) < 10:
        return None
    start = start[np.linspace(0, len(start) - 1, min(windows, len(start))).astype(int)]
    up_0, up_1 = (accel[rows] / norm[rows, None] for rows in (start, start + n))
    return {s: _median_angle_deg(imu, start, n, s, up_0, up_1) for s in (1.0, np.pi / 180, 180 / np.pi)}


def _median_angle_deg(imu: Imu, start: NDArray[np.intp], n: int, s: float, up_0: Floats, up_1: Floats) -> float:
    turn = Rotation.identity(len(start))
    for row in (start + i for i in range(n)):
        dt = (imu.t_ns[row + 1] - imu.t_ns[row])[:, None] / NS
        turn = turn * Rotation.from_rotvec(s * 0.5 * (imu.gyro[row] + imu.gyro[row + 1]) * dt)
    cosine = (turn.inv().apply(up_0) * up_1).sum(axis=1)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


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
            yield Finding("warning", name, text, "they are not used; check that both use one clock")
    absolute = [name for name in inside if name in ABSOLUTE]
    if absolute and not any(inside[name] for name in absolute):
        text = f"no row of {', '.join(absolute)} lies inside the imu's span 0 to {(last - first) / NS:.3f} s"
        yield Finding("error", "session", text, "bring the stamps of both to one clock")


def _jumps(facts: Facts) -> Iterator[Finding]:
    for name in ("gnss", "pose_fixes"):
        stream = getattr(facts.session, name)
        if stream is None or len(stream) < 2:
            continue
        position = facts.session.nav_position(stream)
        # a jump must stand out of the noise of both fixes, or 10 Hz fixes would always jump
        sigma = np.linalg.norm(np.nan_to_num(stream.sigma, nan=5.0), axis=1) if stream.sigma is not None else 5.0
        noise = 4.0 * np.broadcast_to(sigma, len(position))
        allowed = _MAX_FIX_SPEED * np.diff(stream.t_ns) / NS + np.hypot(noise[1:], noise[:-1])
        jump = np.linalg.norm(np.diff(position, axis=0), axis=1) > allowed
        if jump.any():
            at = float(facts.session.seconds(stream.t_ns[1:][jump][0]))
            text = f"{_count(int(jump.sum()), 'jump')} faster than {_MAX_FIX_SPEED:g} m/s, the first at {at:.3f} s"
            yield Finding("warning", name, text, "keep a robust loss on, or remove the outliers")


def _sigmas_and_heights(facts: Facts) -> Iterator[Finding]:
    for name, stream in facts.session.streams().items():
        if not isinstance(stream, Positioned):
            continue
        if stream.sigma is None:
            yield Finding("info", name, "has no sigma columns", "the default of the device class will be used")
        elif bad := int(np.isnan(stream.sigma).any(axis=1).sum()):
            text = f"{bad} of {len(stream)} rows have no sigma"
            yield Finding("info", name, text, "the default of the device class will be used there")
        if facts.session.mount(name).frame == "msl":
            yield Finding("info", name, "heights count from mean sea level, not from the ellipsoid")


RULES: tuple[Callable[[Facts], Iterator[Finding]], ...] = (
    _rows,
    _clock,
    _constant,
    _accel_unit,
    _accel_sign,
    _gyro_unit,
    _overlap,
    _gaps,
    _jumps,
    _sigmas_and_heights,
    _dropped,
)

"""Axes of the sensors of a device against those of a reference: permutation, signs and small angles.

    y = A x + b,    A = R_small H P

x, y : readings of device and reference on one rigid body; P : signed permutation; R_small = Exp(angles); H symmetric,
near the identity (scale). Two sources of y:

- A reference IMU that is mounted with the device (the plate of the 2016 study). The lag of the clocks follows from the
  length of the rates, which no permutation changes; lag, drift, bias and the lever arm r between the accelerometers are
  estimated with A. The specific forces differ by (skew(alpha) + skew(omega)^2) r.
- Known turns about the axes of a box, in one recording: turns between rests by the gyro, gravity at the rests.

A sensor whose readings vary in a direction by less than `LEAST_SIGNAL` times what the fit leaves is refused: its noise
would be taken for a motion. Covariance by the scatter between blocks of time. Source: Titterton, Weston (2004),
Strapdown Inertial Navigation Technology, 8.3, for the lever arm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from smartnav_graph.calibrate.least_squares import derivatives_of
from smartnav_graph.calibrate.rests import check_readings, find_rests, interval_s
from smartnav_graph.calibrate.result import CalibrationResult
from smartnav_graph.calibrate.static import one_session
from smartnav_graph.core import chi_square, so3
from smartnav_graph.core.arrays import Floats, Indices, Times
from smartnav_graph.core.clustered import clustered_covariance
from smartnav_graph.core.errors import CalibrationError, ConfigError
from smartnav_graph.core.frames import axis_vector
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.session.session import Session

WHERE = "calibrate axes"
STEP_S, BLOCK_S = 0.02, 1.0
OVERLAP_S = 10.0
FEWEST = 30  # readings of each while both recorded, for up to 17 unknowns
ALIKE, UNIQUE, APART_S = 0.7, 0.95, 1.0  # correlation of the lengths of rates; that of another lag over it; s between
LEAST_SIGNAL = 5.0
OPEN_DEG = 1.0  # sigma of an angle from which it is refused
LARGEST_SCALE = 0.25
FAR_DEG = 20.0  # of a small angle
RIDGE = 1e-12  # of the information: a parameter that nothing determines has a large sigma
ROUNDS, CONVERGED_S = 8, 1e-6
LONGEST_TURN_S = 60.0
UNITS = {"gyro": "rad/s", "accel": "m/s^2", "magnetometer": "uT"}
MOVING = "turn both together about all three axes, back and forth, for half a minute"
TURNING = "turn it by 90 deg about each axis, both ways, with rests of two seconds between"


@dataclass(frozen=True)
class AxesOptions:
    """Axes of the sensors of a device (first recording) against a reference IMU that is mounted with it (second
    recording), or against known turns of a box (one recording and --turns): permutation, signs and small angles.
    """

    turns: str = ""
    """Turns about the axes of the box between rests, in order, deg, as "x:90,y:90,z:90,x:-90"."""
    up: str = "+z"
    """With --turns: the axis of the box that points up at the first rest."""


@dataclass(frozen=True)
class SensorAxes:
    """A sensor against the reference.

    permutation (3, 3) : P; angles (3,) rad about the axes of the reference, with covariance (3, 3); scale : mean
    diagonal of H; left (n, 3) : residuals; lag_s, lag_sigma_s, drift : of the clock of the reference
    weakest : axis of the sensor that the motion determines least; signal : scatter there over that of the residuals
    """

    permutation: Floats
    angles: Floats
    covariance: Floats
    scale: float
    left: Floats
    lag_s: float
    lag_sigma_s: float
    drift: float
    weakest: str
    signal: float


def fit(sources: Sequence[Session], options: AxesOptions) -> CalibrationResult:
    """Find the axes of the sensors of one device.

    Raises
    ------
    CalibrationError
        Recordings that do not move together, a motion that leaves an axis of the gyro open, or readings in other units.
    """
    if options.turns:
        return _result(by_turns(one_session(sources), options), check_readings(one_session(sources)), {})
    if len(sources) != 2:
        found = f"{len(sources)} recordings"
        expected = "two: the device, then the reference IMU; or one, with --turns"
        raise CalibrationError(WHERE, found, expected, "record both at once, or turn the device in a box")
    device, reference = sources
    aligned, refused = by_reference(device, reference)
    return _result(aligned, check_readings(device), refused)


def by_reference(device: Session, reference: Session) -> tuple[dict[str, SensorAxes], dict[str, str]]:
    """Of gyro, accelerometer and, where both have one, magnetometer; and why a magnetometer is refused."""
    one, two = device.require_imu(), reference.require_imu()
    step = max(STEP_S, interval_s(one.t_ns), interval_s(two.t_ns))
    lag = _first_lag(_lengths(one.t_ns, one.gyro, step), _lengths(two.t_ns, two.gyro, step), step)
    streams = {"gyro": (one.t_ns, one.gyro, two.t_ns, two.gyro), "accel": (one.t_ns, one.accel, two.t_ns, two.accel)}
    if device.magnetometer is not None and reference.magnetometer is not None:
        mine, theirs = device.magnetometer, reference.magnetometer
        streams["magnetometer"] = (mine.t_ns, mine.field_ut, theirs.t_ns, theirs.field_ut)
    starts = (int(one.t_ns[0]), int(two.t_ns[0]))
    found, refused = dict[str, SensorAxes](), dict[str, str]()
    drift, rates = 0.0, (two.t_ns, two.gyro)
    for sensor, parts in streams.items():
        few = _too_few(sensor, parts, starts, lag)
        if few and sensor == "magnetometer":
            refused[sensor] = f"{few}; {MOVING}"
            continue
        if few:
            raise CalibrationError(WHERE, few, f"at least {FEWEST}", MOVING)
        found[sensor] = _aligned(parts, starts, (lag, drift), step, rates if sensor == "accel" else None)
        if sensor == "gyro":
            lag, drift = found[sensor].lag_s, found[sensor].drift
    return found, refused


def _too_few(sensor: str, parts: tuple[Times, Floats, Times, Floats], starts: tuple[int, int], lag: float) -> str:
    """How many readings there are while both recorded, where they are too few or cover too short a time."""
    t, u = (parts[0] - starts[0]) / NS, (parts[2] - starts[1]) / NS - lag
    first, last = max(t.min(initial=np.inf), u.min(initial=np.inf)), min(t.max(initial=-np.inf), u.max(initial=-np.inf))
    least = min(int(((one >= first) & (one <= last)).sum()) for one in (t, u))
    if least < FEWEST:
        return f"{least} readings of the {sensor} while both recorded"
    short = last - first < OVERLAP_S / 2
    return f"readings of the {sensor} in {last - first:.1f} s while both recorded" if short else ""


def _lengths(t_ns: Times, rates: Floats, step: float) -> Floats:
    t = (t_ns - t_ns[0]) / NS
    return np.asarray(np.linalg.norm(_means(t, rates - np.median(rates, axis=0), np.arange(0.0, t[-1], step)), axis=1))


def _means(t: Floats, readings: Floats, edges: Floats) -> Floats:
    """Means (m - 1, 3) of readings (n, 3) at t between neighbouring edges (m,): differences of their integral."""
    parts = 0.5 * (readings[1:] + readings[:-1]) * np.diff(t)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(parts, axis=0)])
    at = np.stack([np.interp(edges, t, column) for column in integral.T], axis=1)
    return np.asarray(np.diff(at, axis=0) / np.diff(edges)[:, None])


def _first_lag(one: Floats, two: Floats, step: float) -> float:
    """Seconds that the reference started before the device, by the correlation of the lengths of their rates."""
    from scipy import signal

    a, b = one - one.mean(), two - two.mean()
    overlap = signal.correlate(np.ones(len(b)), np.ones(len(a)), method="fft")
    power = signal.correlate(b**2, np.ones(len(a)), method="fft") * signal.correlate(
        np.ones(len(b)), a**2, "full", "fft"
    )
    there = overlap > OVERLAP_S / step - 0.5
    if not there.any():
        shorter = min(len(a), len(b)) * step
        raise CalibrationError(WHERE, f"a recording of {shorter:.0f} s", f"{OVERLAP_S:g} s of both", MOVING)
    share = np.where(there, signal.correlate(b, a, method="fft") / np.sqrt(np.maximum(power, 1e-12)), -1.0)
    best = int(np.argmax(share))
    lags = (np.arange(len(share)) - (len(a) - 1)) * step
    other = float(share[np.abs(lags - lags[best]) > APART_S].max(initial=-1.0))
    if share[best] < ALIKE or other > UNIQUE * share[best]:
        found = f"rates of device and reference correlate by {share[best]:.2f} at best, {other:.2f} at another lag"
        raise CalibrationError(WHERE, found, f"{ALIKE} and more at one lag only", f"mount them on one plate; {MOVING}")
    return float(lags[best])


def _aligned(
    parts: tuple[Times, Floats, Times, Floats], starts: tuple[int, int], clock: tuple[float, float], step: float,
    rates: tuple[Times, Floats] | None,
) -> SensorAxes:  # fmt: skip
    """One sensor by its readings and those of the reference; `rates` of the reference: with a lever arm."""
    t, x, u, y = (parts[0] - starts[0]) / NS, parts[1], (parts[2] - starts[1]) / NS, parts[3]
    lag, drift = clock
    first, last = max(t[0], u[0] - lag) + 0.2, min(t[-1], u[-1] - lag) - 0.2
    edges = np.arange(first, last, step)
    middle, block = (edges[1:] + edges[:-1]) / 2, np.floor((edges[:-1] - first) / BLOCK_S).astype(np.intp)
    beside, own = middle - middle.mean(), _means(t, x, edges)
    for _ in range(ROUNDS):
        at = edges + lag + drift * (edges - middle.mean())
        true = _means(u, y, at)
        change = np.stack([np.interp(at, u, column) for column in y.T], axis=1)
        slope = (change[1:] - change[:-1]) / step
        extra = [-slope, -slope * beside[:, None]]
        if rates is not None:
            extra += list(np.moveaxis(-_lever((rates[0] - starts[1]) / NS, rates[1], at), 2, 0))
        solved, covariance, left = _linear(own, true, np.stack(extra, axis=2), block)
        lag, drift = lag + float(solved[12]), drift + float(solved[13])
        if abs(solved[12]) < CONVERGED_S:
            break
    found = _decomposed(own, solved, covariance, left)
    return replace(found, lag_s=lag, lag_sigma_s=float(np.sqrt(covariance[12, 12])), drift=drift)


def _lever(t: Floats, rates: Floats, edges: Floats) -> Floats:
    """skew(alpha) + skew(omega)^2 (n, 3, 3) between edges."""
    at = np.stack([np.interp(edges, t, column) for column in rates.T], axis=1)
    omega, alpha = so3.skew(_means(t, rates, edges)), so3.skew(np.diff(at, axis=0) / np.diff(edges)[:, None])
    return np.asarray(alpha + omega @ omega)


def _linear(
    x: Floats, y: Floats, extra: Floats, block: Indices | None, bias: bool = True
) -> tuple[Floats, Floats, Floats]:
    """A (9, row-major), b (3, zero without `bias`), and the factors of `extra` (n, 3, q); covariance; residuals (n, 3).

    block (n,) : rows whose errors are alike; None for independent ones
    """
    identity = np.eye(3)
    by_matrix = np.einsum("ij,nk->nijk", identity, x).reshape(len(x), 3, 9)
    constant = np.tile(identity * float(bias), (len(x), 1, 1))
    J = np.concatenate([by_matrix, constant, extra], axis=2)
    normal = np.einsum("nip,niq->pq", J, J)
    ridge = RIDGE * float(np.trace(normal)) * np.eye(len(normal))
    normal += ridge
    solved = np.linalg.solve(normal, np.einsum("nip,ni->p", J, y))
    left = y - J @ solved
    freedom = max(left.size - J.shape[2] + 3 * (not bias), 1)
    variance = max(float((left**2).sum()) / freedom, 1e-16)
    if block is None:
        wider = float(chi_square.student_ratio(freedom))
        return solved, np.asarray(variance * wider**2 * np.linalg.inv(normal)), left
    groups = [np.flatnonzero(block == i) for i in np.unique(block)]
    information = np.array([np.einsum("nip,niq->pq", J[rows], J[rows]) for rows in groups])
    scores = np.array([np.einsum("nip,ni->p", J[rows], left[rows]) for rows in groups])
    return solved, clustered_covariance(information, scores, variance, ridge), left


def nearest_permutation(matrix: Floats) -> Floats:
    """The signed permutation P (3, 3) of the largest entries of a matrix (3, 3)."""
    from scipy import optimize

    rows, columns = optimize.linear_sum_assignment(-np.abs(matrix))
    found = np.zeros((3, 3))
    found[rows, columns] = np.where(matrix[rows, columns] < 0, -1.0, 1.0)
    return found


def _rotation_part(matrix: Floats) -> Floats:
    """Rotation vector (3,) of the rotation nearest to a matrix (9,)."""
    u, _, vt = np.linalg.svd(matrix.reshape(3, 3))
    return so3.log(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _decomposed(x: Floats, solved: Floats, covariance: Floats, left: Floats) -> SensorAxes:
    A = solved[:9].reshape(3, 3)
    P = nearest_permutation(A)
    E = A @ P.T
    entry = np.kron(np.eye(3), P)  # of E (row-major) by A
    J = derivatives_of(_rotation_part, E.ravel(), np.full(9, 1e-6)) @ entry
    scatter, axes = np.linalg.eigh(np.atleast_2d(np.cov(x.T)))
    weakest = "xyz"[int(np.argmax(np.abs(axes[:, 0])))]
    ratio = float(np.sqrt(scatter[0]) / max(np.sqrt(np.mean(left**2)), 1e-12))
    scale = float(np.linalg.svd(E, compute_uv=False).mean())
    own = covariance[:9, :9]
    return SensorAxes(P, _rotation_part(E.ravel()), J @ own @ J.T, scale, left, 0.0, 0.0, 0.0, weakest, ratio)


def parse_turns(text: str) -> list[tuple[int, float]]:
    """Axis (0 to 2) and angle, rad, of each of "x:90,y:-90"."""
    found = []
    for part in text.split(","):
        axis, _, angle = part.strip().lower().partition(":")
        try:
            degrees = float(angle)
        except ValueError:
            degrees = math.nan
        if axis not in ("x", "y", "z") or not math.isfinite(degrees):
            raise ConfigError("--turns", repr(part), "axis:deg, as x:90,y:90,z:-90")
        found.append(("xyz".index(axis), math.radians(degrees)))
    return found


def by_turns(session: Session, options: AxesOptions) -> dict[str, SensorAxes]:
    """Of gyro and accelerometer, by known turns between the rests of one recording."""
    imu, known = session.require_imu(), parse_turns(options.turns)
    rests = find_rests(imu, 0.75)
    if len(rests) != len(known) + 1 or len(known) < 4:
        found = f"{len(rests)} rests and {len(known)} turns"
        raise CalibrationError(
            session.path or WHERE, found, "a rest before and after each of at least 4 turns", TURNING
        )
    true = np.array([angle * np.eye(3)[axis] for axis, angle in known])
    attitude, up = [np.eye(3)], axis_vector(options.up)
    for turn in true:
        attitude.append(attitude[-1] @ so3.exp(turn))
    gravity = session.gravity * np.array([R.T @ up for R in attitude])
    P, turned = np.eye(3), np.zeros((0, 3))
    for _ in range(2):  # first to first order, then along the axes that were found
        turned = np.array([_turned(imu.t_ns, imu.gyro, one.last, two.first, (one.rows, two.rows), P)
                           for one, two in pairwise(rests)])  # fmt: skip
        solved, covariance, left = _linear(turned, true, np.zeros((len(true), 3, 0)), None, bias=False)
        P = nearest_permutation(solved[:9].reshape(3, 3)) @ P
    gyro = _decomposed(turned, solved, covariance, left)
    means = np.array([imu.accel[rest.rows].mean(axis=0) for rest in rests])
    force = _linear(means, gravity, np.zeros((len(means), 3, 0)), None)
    return {"gyro": replace(gyro, permutation=P), "accel": _decomposed(means, *force)}


def _turned(t_ns: Times, rates: Floats, first: int, last: int, rests: tuple[slice, slice], P: Floats) -> Floats:
    """Rotation vector (3,) of the turn from row `first` to `last`, along permuted axes; bias by the rests."""
    dt = np.diff(t_ns[first - 1 : last + 1]) / NS
    if dt.sum() > LONGEST_TURN_S:
        raise CalibrationError(WHERE, f"a turn of {dt.sum():.0f} s", f"at most {LONGEST_TURN_S:g} s", TURNING)
    bias = (rates[rests[0]].mean(axis=0) + rates[rests[1]].mean(axis=0)) / 2
    part = rates[first - 1 : last + 1] - bias
    small = 0.5 * (part[1:] + part[:-1]) * dt[:, None] @ P.T
    whole, total = so3.chained(small)[-1].as_rotvec(), small.sum(axis=0)
    return np.asarray(whole if np.linalg.norm(whole - total) < 0.5 else total)  # a rotation vector is below 180 deg


def _result(found: dict[str, SensorAxes], warnings: list[str], refused: dict[str, str]) -> CalibrationResult:
    values, residuals = dict[str, Value](), dict[str, Residual]()
    for sensor, axes in found.items():
        _check(sensor, axes, found, refused)
        if sensor in refused:
            continue
        for column, axis in enumerate("xyz"):
            row = int(np.argmax(np.abs(axes.permutation[:, column])))
            sign = float(axes.permutation[row, column])
            values[f"{sensor}_axis_{axis}"] = Value(sign * (row + 1), 0.0, "axis")
        for axis, angle, variance in zip("xyz", axes.angles, np.diag(axes.covariance), strict=True):
            sigma = float(np.degrees(np.sqrt(variance)))
            values[f"{sensor}_angle_{axis}"] = Value(float(np.degrees(angle)), sigma, "deg")
            if sigma > OPEN_DEG:
                refused[f"{sensor}_angle_{axis}"] = f"sigma of {sigma:.2g} deg: {MOVING}"
        if axes.lag_sigma_s:
            values[f"{sensor}_lag"] = Value(axes.lag_s, axes.lag_sigma_s, "s")
        residuals[sensor] = Residual(float(np.sqrt(np.mean(axes.left**2))), len(axes.left), UNITS[sensor])
    order = tuple(f"{s}_angle_{a}" for s in found if s not in refused for a in "xyz")
    covariance = np.zeros((len(order), len(order)))
    for i, axes in enumerate(axes for sensor, axes in found.items() if sensor not in refused):
        covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = np.degrees(np.degrees(axes.covariance))
    texts = (*warnings, *_warnings({s: axes for s, axes in found.items() if s not in refused}))
    return CalibrationResult(
        values, residuals, refused, texts, order=order, covariance=tuple(map(float, covariance.ravel()))
    )


def _check(sensor: str, axes: SensorAxes, found: dict[str, SensorAxes], refused: dict[str, str]) -> None:
    """Refuse a sensor whose readings do not vary about all axes; raise for the gyro, and for another unit."""
    if axes.signal < LEAST_SIGNAL:
        what = f"readings of the {sensor} vary by {axes.signal:.1f} times what the fit leaves"
        what += f" about its {axes.weakest} axis"
        remedy = TURNING if not axes.lag_sigma_s else MOVING
        if sensor == "gyro":
            raise CalibrationError(WHERE, what, f"at least {LEAST_SIGNAL:g} times", remedy)
        refused[sensor] = f"{what}; {remedy}"
    elif abs(axes.scale - 1) > LARGEST_SCALE and sensor != "magnetometer":
        what = f"the reference reads {axes.scale:.3g} times what the {sensor} does"
        raise CalibrationError(WHERE, what, f"one unit ({UNITS[sensor]})", "--repair units, or --columns of the import")


def _warnings(found: dict[str, SensorAxes]) -> list[str]:
    texts = []
    for sensor, axes in found.items():
        if np.linalg.det(axes.permutation) < 0:
            texts.append(f"{sensor}: left-handed: an axis reads with the opposite sign; mend it with --columns")
        if np.degrees(np.linalg.norm(axes.angles)) > FAR_DEG:
            angle = np.degrees(np.linalg.norm(axes.angles))
            texts.append(f"{sensor}: {angle:.0f} deg from any permutation of axes; mount the device along an edge")
    gyro = found["gyro"].permutation
    for sensor, axes in found.items():
        if not np.array_equal(axes.permutation, gyro):
            differ = ", ".join("xyz"[i] for i in range(3) if not np.array_equal(axes.permutation[:, i], gyro[:, i]))
            texts.append(f"axes {differ} of the {sensor} are not those of the gyro; exchange columns with --columns")
    return texts

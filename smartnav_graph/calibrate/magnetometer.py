"""Magnetometer from turns in a constant field: readings lie on an ellipsoid, calibrated ones on a sphere.

    | S (m - h) | = F,   S symmetric (3, 3): soft iron and scale, h: hard iron, F: strength of the field

With a known place F is that of the World Magnetic Model, else the mean diagonal of S is 1 and F is found. A sphere (h
only) is kept where an ellipsoid does not predict stretches of time that were left out better. The angle between field
and gravity is constant, too: it gives the turn R of the sensor's axes to those of the accelerometer where the device is
held still enough. Source: Renaudin, Afzal, Lachapelle (2010), Complete triaxis magnetometer calibration in the magnetic
domain, Journal of Sensors; Kok, Schoen (2016), Magnetometer calibration using inertial sensors, IEEE Sensors J. 16(14).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.calibrate.least_squares import Adjusted, adjust, derivatives_of
from smartnav_graph.calibrate.result import CalibrationResult, Chart, Series
from smartnav_graph.calibrate.static import one_session
from smartnav_graph.core import so3
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.timebase import interpolate
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.session.session import Session

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
EARTH_UT, OTHER_UNIT = (22.0, 67.0), 3.0  # strength at its surface; a factor that is no soft iron
FLAT = 0.15  # least over largest extent of the readings, below which they lie in a plane
MOST_ROWS = 3000
FOLDS, GAIN = 5, 0.9
LEAST_NOISE = 0.02  # uT
LARGEST_NOISE = 0.1  # of the length, share of the strength: the field changed, or the magnetisation
SOFT_PRIOR = 0.2  # of soft iron and scale factors, shares
MOST_SIGMA = 0.05  # of a hard iron, share of the strength
STILL = 0.03  # share of gravity by which the length of specific force may differ
TURN_PRIOR = 0.05  # rad, of the sensor's axes in a device
LASTING_UT = 2.0  # sigma of a hard iron in later recordings: the magnetisation of a device changes


@dataclass(frozen=True)
class MagnetometerOptions:
    """Magnetometer from turns about all axes, away from iron: hard and soft iron, strength of the field, turn to the
    axes of the accelerometer.
    """

    strength_ut: float | None = None
    """Strength of the field in uT, instead of that of the World Magnetic Model at the origin of the session."""


def soft_iron(parameters: Floats) -> Floats:
    """S (3, 3) of the parameters: hard iron (3), then nothing or the six of S."""
    matrix = np.eye(3)
    for (i, j), value in zip(PAIRS, parameters[3:9], strict=False):
        matrix[i, j] = matrix[j, i] = value
    return matrix


def field_lengths(parameters: Floats, readings: Floats) -> Floats:
    """Length (n,) uT of the calibrated field."""
    return np.asarray(np.linalg.norm((readings - parameters[:3]) @ soft_iron(parameters), axis=1))


def sphere(readings: Floats) -> tuple[Floats, float]:
    """Centre (3,) and radius of the sphere through readings (n, 3), by linear least squares."""
    middle = readings.mean(axis=0)
    near = readings - middle
    found, *_ = np.linalg.lstsq(np.column_stack([2 * near, np.ones(len(near))]), (near**2).sum(axis=1), rcond=None)
    return middle + found[:3], float(np.sqrt(max(found[3] + found[:3] @ found[:3], 1e-12)))


def fit(sources: Sequence[Session], options: MagnetometerOptions) -> CalibrationResult:
    """Calibrate the magnetometer of one recording.

    Raises
    ------
    CalibrationError
        No magnetometer, a constant axis, or readings in a plane.
    """
    session = one_session(sources)
    where, stream = str(session.path or "session"), session.magnetometer
    if stream is None or len(stream) < 50:
        raise CalibrationError(where, "has no magnetometer, or few readings", "at least 50", "turn it about all axes")
    readings = stream.field_ut[:: max(len(stream) // MOST_ROWS, 1)]
    _check(where, readings)
    known = options.strength_ut
    if known is None and session.magnetic_field_ut is not None:
        known = float(np.linalg.norm(session.magnetic_field_ut))
    centre, radius = sphere(readings)
    strength = radius if known is None else known
    weakest, strongest = EARTH_UT if known is None else (known, known)
    if not weakest / OTHER_UNIT < radius < strongest * OTHER_UNIT:
        rule = f"{weakest:.3g} uT" if known else "{:g} to {:g} uT, the field of the Earth".format(*EARTH_UT)
        found, remedy = (
            f"the readings turn about a field of {radius:.3g}",
            "import it in uT (--columns), away from iron",
        )
        raise CalibrationError(where, found, rule, remedy)
    ball, ellipsoid = _fit(readings, centre, radius, 3, radius), _fit(readings, centre, radius, 9, strength)
    left = {size: _left_out(readings, centre, radius, size, strength if size == 9 else radius) for size in (3, 9)}
    best, size = (ball, 3)
    if left[9] < GAIN * left[3] and (ellipsoid.sigmas[:3] < MOST_SIGMA * strength).all():
        best, size = ellipsoid, 9
    if (best.sigmas[:3] > MOST_SIGMA * strength).any() or best.noise > LARGEST_NOISE * strength:
        found = f"hard iron to {best.sigmas[:3].max():.2g} uT at a scatter of {best.noise:.2g} uT: too few directions"
        rule = f"{MOST_SIGMA * strength:.2g} uT"
        raise CalibrationError(where, found, rule, "turn it about all axes at one place, away from iron")
    return _result(session, readings, best, size, left, radius, known)


def _check(where: str, readings: Floats) -> None:
    for axis, column in zip("xyz", readings.T, strict=True):
        if column.min() == column.max():
            found = f"{axis} of the magnetometer is constant ({column[0]:.6g} uT)"
            raise CalibrationError(where, found, "readings that turn with the device", "check the import")
    extents = np.linalg.svd(readings - readings.mean(axis=0), compute_uv=False)
    if extents[2] < FLAT * extents[0]:
        found = "the readings lie in a plane or on a line: the device was turned about one axis, or not at all"
        raise CalibrationError(where, found, "turns about all axes", "turn it slowly in the air until each axis was up")


def _fit(readings: Floats, centre: Floats, radius: float, size: int, strength: float) -> Adjusted:
    if size == 3:  # the radius is a parameter, too
        nominal = np.append(centre, radius)
        return adjust(
            lambda p: np.linalg.norm(readings - p[:3], axis=1) - p[3], nominal, np.full(4, np.inf), LEAST_NOISE
        )
    scale = strength / radius
    nominal = np.concatenate([centre, [scale, scale, scale, 0, 0, 0]])
    prior = np.concatenate([np.full(3, np.inf), np.full(6, SOFT_PRIOR * scale)])
    return adjust(lambda p: field_lengths(p, readings) - strength, nominal, prior, LEAST_NOISE)


def _left_out(readings: Floats, centre: Floats, radius: float, size: int, strength: float) -> float:
    """RMS of the length in stretches of time that were left out, uT."""
    errors = []
    for rows in np.array_split(np.arange(len(readings)), FOLDS):
        found = _fit(np.delete(readings, rows, axis=0), centre, radius, size, strength).parameters
        given = readings[rows]
        if size == 3:
            errors.append(np.linalg.norm(given - found[:3], axis=1) - found[3])
        else:
            errors.append((field_lengths(found, given) - strength) * radius / strength)
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def correlated_by(residuals: Floats) -> float:
    """Factor on sigmas for residuals (n,) that are correlated in time: the root of 1 + 2 sum of their correlations."""
    left = residuals - residuals.mean()
    total, power = 1.0, float(left @ left)
    for lag in range(1, len(left) // 4):
        share = float(left[lag:] @ left[:-lag]) / power
        if share < 2 / np.sqrt(len(left)):
            break
        total += 2 * share
    return float(np.sqrt(total))


def _result(
    session: Session, readings: Floats, found: Adjusted, size: int, left: dict[int, float], radius: float,
    known: float | None,
) -> CalibrationResult:  # fmt: skip
    wider = correlated_by(found.residuals)
    parameters, sigmas = found.parameters.copy(), found.sigmas * wider
    strength = float(parameters[3]) if size == 3 else known or radius
    if size == 3:
        matrix = np.eye(3) * (known / strength if known else 1.0)
    else:
        free = 1.0 if known else 3.0 / float(parameters[3:6].sum())
        parameters[3:], sigmas[3:], strength = parameters[3:] * free, sigmas[3:] * free, strength * free
        matrix = soft_iron(parameters)
    values, refused = {}, {}
    for i, axis in enumerate("xyz"):
        values[f"hard_iron_{axis}"] = Value(float(parameters[i]), float(sigmas[i]), "uT")
    for k, (i, j) in enumerate(PAIRS):
        name = f"soft_iron_{'xyz'[i]}{'xyz'[j]}"
        if size == 9:
            values[name] = Value(float(parameters[3 + k]), float(sigmas[3 + k]), "1")
        else:
            refused[name] = (
                f"an ellipsoid is no better ({left[9]:.2g} against {left[3]:.2g} uT); turn it about all axes"
            )
    sigma = float(sigmas[3]) if size == 3 else strength * float(np.linalg.norm(sigmas[3:6])) / 3
    values["field_strength"] = Value(known or strength, np.nan if known else sigma, "uT")
    if known is None:
        refused["scale"] = "the place is not known; give [origin] of the session, or --strength-ut"
    iron = parameters[:3] if size == 3 else parameters
    ratio = sigmas[: len(iron)] / found.sigmas[: len(iron)]  # of the units above, and for correlated residuals
    covariance = found.covariance[: len(iron), : len(iron)] * np.outer(ratio, ratio)
    turn = _turn(session, iron, covariance, values, refused)
    charts = _charts(readings, parameters[:3], matrix)
    before = np.linalg.norm(readings, axis=1)
    after = np.linalg.norm((readings - parameters[:3]) @ matrix.T, axis=1)
    residuals = {
        "length_before": Residual(float(before.std()), len(before), "uT"),
        "length": Residual(float(after.std()), len(after), "uT"),
        "length_left_out": Residual(left[size], len(after), "uT"),
    }
    whole = turn @ matrix

    def change(now: Calibration) -> Calibration:
        noise = replace(
            now.magnetometer_noise,
            hard_iron_ut=(float(parameters[0]), float(parameters[1]), float(parameters[2])),
            soft_iron=tuple(map(float, whole.ravel())),
            hard_iron_sigma_ut=float(np.hypot(sigmas[:3].max(), LASTING_UT)),
            sigma_ut=max(float(after.std()), LEAST_NOISE),
        )
        return replace(now, magnetometer_noise=noise)

    return CalibrationResult(values, residuals, refused, (), change, charts)


def _turn(
    session: Session, iron: Floats, iron_covariance: Floats, values: dict[str, Value], refused: dict[str, str]
) -> Floats:
    """R (3, 3) from the sensor's axes to the accelerometer's, by a constant angle between field and gravity."""
    imu, stream = session.imu, session.magnetometer
    if imu is None or stream is None:
        refused["turn"] = "no accelerometer; record it with the magnetometer"
        return np.eye(3)
    force = interpolate(stream.t_ns, imu.t_ns, imu.accel)
    lengths = np.linalg.norm(force, axis=1)
    still = np.abs(lengths / session.gravity - 1) < STILL
    rows = np.flatnonzero(still)[:: max(int(still.sum()) // MOST_ROWS, 1)]
    if len(rows) < 50:
        refused["turn"] = "the device was not still enough; turn it slowly"
        return np.eye(3)
    field = (stream.field_ut[rows] - iron[:3]) @ soft_iron(iron).T
    field /= np.linalg.norm(field, axis=1, keepdims=True)
    up = force[rows] / lengths[rows, None]

    def misfit(p: Floats) -> Floats:
        return np.asarray(_angles(up, so3.exp(p[:3]), field) - p[3])

    nominal = np.array([0.0, 0.0, 0.0, float(np.mean(_angles(up, np.eye(3), field)))])
    found = adjust(misfit, nominal, np.array([TURN_PRIOR, TURN_PRIOR, TURN_PRIOR, np.inf]), 1e-4)

    def by_iron(p: Floats) -> Floats:
        own = (stream.field_ut[rows] - p[:3]) @ soft_iron(p).T
        own /= np.linalg.norm(own, axis=1, keepdims=True)
        return _angles(up, so3.exp(found.parameters[:3]), own)

    found = found.with_errors(derivatives_of(by_iron, iron, np.full(len(iron), 1e-3)), iron_covariance)
    sigmas = found.sigmas * correlated_by(found.residuals)
    for i, axis in enumerate("xyz"):
        values[f"turn_{axis}"] = Value(float(np.degrees(found.parameters[i])), float(np.degrees(sigmas[i])), "deg")
    if sigmas[:3].max() > 0.3 * TURN_PRIOR:
        refused["turn"] = f"sigma {np.degrees(sigmas[:3].max()):.2g} deg: not used; turn it slowly about all axes"
        return np.eye(3)
    return so3.exp(found.parameters[:3])


def _angles(up: Floats, turn: Floats, field: Floats) -> Floats:
    """Angles (n,) between directions up and turned field: unlike their cosines, of one noise at every angle."""
    return np.asarray(np.arccos(np.clip(np.einsum("ni,ij,nj->n", up, turn, field), -1.0, 1.0)))


def _charts(readings: Floats, hard: Floats, matrix: Floats) -> tuple[Chart, ...]:
    rows = np.arange(len(readings), dtype=np.float64)
    after = (readings - hard) @ matrix.T
    lengths = (
        Series("before", rows, np.linalg.norm(readings, axis=1), "dots", 3),
        Series("after", rows, np.linalg.norm(after, axis=1), "dots", 0),
    )
    planes = (
        Series("x, y", after[:, 0], after[:, 1], "dots", 0),
        Series("x, z", after[:, 0], after[:, 2], "dots", 1),
        Series("y, z", after[:, 1], after[:, 2], "dots", 2),
    )
    return (
        Chart("Length of the field", "Reading", "Field [uT]", lengths),
        Chart("Calibrated readings", "Field [uT]", "Field [uT]", planes, aspect=1.5),
    )

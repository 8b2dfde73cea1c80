"""Accelerometer from rests in several attitudes: the length of specific force at rest is gravity.

    | M (a_i - b) | = g,   M = [[s_x, m_xy, m_xz], [0, s_y, m_yz], [0, 0, s_z]]

for the mean reading a_i of each rest: 3 parameters (bias b), 6 (and scale s) or 9 (and misalignment m), by
cross-validation. The z axis of the calibrated axes is that of the sensor. Source: Tedaldi, Pretto, Menegatti (2014), A
robust and easy to implement method for IMU calibration without external equipments, ICRA.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.calibrate.least_squares import Adjusted, adjust
from smartnav_graph.calibrate.rests import RestRows, check_readings, check_unit, find_rests
from smartnav_graph.calibrate.result import CalibrationResult, Chart, Series
from smartnav_graph.calibrate.static import one_session
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.session.session import Session

# Parameters in order, their nominal values and prior sigmas: m/s^2 of bias, shares of scale and misalignment (radians),
# as data sheets of consumer sensors have them.
NAMES = ("bias_x", "bias_y", "bias_z", "scale_x", "scale_y", "scale_z", "misalignment_xy", "misalignment_xz",
         "misalignment_yz")  # fmt: skip
NOMINAL = np.array([0.0, 0, 0, 1, 1, 1, 0, 0, 0])
PRIOR = np.array([0.5, 0.5, 0.5, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01])
UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # of M, in the order of the parameters
MODELS = (3, 6, 9)
GAIN = 0.9  # of the cross-validated RMS of the smaller model, which a larger one must reach
APART = np.radians(15.0)  # between attitudes that count as two
MANY, SHORT_S = 2 * MODELS[-1], 0.25  # rests, two a parameter; s
LEAST_NOISE = 2e-4  # m/s^2, of the mean of a rest


@dataclass(frozen=True)
class AccelerometerOptions:
    """Accelerometer from rests that are found by themselves: bias, scale and misalignment (3, 6 or 9 parameters, by
    cross-validation) from the length of gravity. Hold the device still for two seconds in ten attitudes or more.
    """

    parameters: int | None = None
    """3, 6 or 9, instead of what cross-validation chooses."""
    least_rest_s: float = 0.75
    """Shortest rest that is used, s; where there are fewer than 18 of them, those of a quarter second are used, too."""

    def __post_init__(self) -> None:
        if self.parameters not in (None, *MODELS):
            raise CalibrationError("--parameters", f"{self.parameters}", "3, 6 or 9")


@dataclass(frozen=True)
class AccelerometerFit:
    """found : the parameters that were chosen; left_out (m,) : residual of each rest by the others; cross : RMS of
    these by number of parameters; means (m, 3) m/s^2 of the rests"""

    found: Adjusted
    left_out: Floats
    cross: dict[int, float]
    means: Floats

    @property
    def matrix(self) -> Floats:
        """M (3, 3)."""
        return matrix_of(self.found.parameters)

    @property
    def bias(self) -> Floats:
        """b (3,) m/s^2."""
        return self.found.parameters[:3]


def matrix_of(parameters: Floats) -> Floats:
    """M (3, 3) of 3, 6 or 9 parameters."""
    full = np.concatenate([parameters, NOMINAL[len(parameters) :]])
    matrix = np.zeros((3, 3))
    for (i, j), value in zip(UPPER, full[3:], strict=True):
        matrix[i, j] = value
    return matrix


def lengths(parameters: Floats, means: Floats) -> Floats:
    """Length (m,) of calibrated specific force."""
    return np.asarray(np.linalg.norm((means - parameters[:3]) @ matrix_of(parameters).T, axis=1))


def fit(sources: Sequence[Session], options: AccelerometerOptions) -> CalibrationResult:
    """Calibrate the accelerometer by the rests of one recording."""
    session = one_session(sources)
    warnings = check_readings(session, ("accel",))
    fitted = fit_rests(session, rests_of(session, options.least_rest_s), options.parameters)
    return result_of(fitted, session.gravity, warnings)


def rests_of(session: Session, least_s: float) -> list[RestRows]:
    """Rests of at least `least_s`; where these are fewer than `MANY`, also those of `SHORT_S`."""
    imu = session.require_imu()
    rests = find_rests(imu, least_s)
    return rests if len(rests) >= MANY else find_rests(imu, min(least_s, SHORT_S))


def fit_rests(session: Session, rests: list[RestRows], parameters: int | None = None) -> AccelerometerFit:
    """The parameters by the means of rests.

    Raises
    ------
    CalibrationError
        Too few attitudes, all alike, or readings in another unit.
    """
    imu, where = session.require_imu(), str(session.path or "session")
    means = np.array([imu.accel[rest.rows].mean(axis=0) for rest in rests]).reshape(-1, 3)
    apart = count_attitudes(means)
    if apart <= MODELS[0]:
        found = f"{len(rests)} rests in {apart} attitudes"
        remedy = "hold the device still for two seconds, each axis up and down and at angles between"
        raise CalibrationError(
            where, found, f"more than {MODELS[0]} attitudes {np.degrees(APART):.0f} deg apart", remedy
        )
    check_unit(session, means)
    sizes = [size for size in MODELS if size <= apart] if parameters is None else [parameters]
    if sizes[-1] > apart:
        raise CalibrationError(where, f"{apart} attitudes", f"at least {parameters}", "record more rests")
    fits = {size: _with_left_out(means, session.gravity, size) for size in sizes}
    cross = {size: float(np.sqrt(np.mean(left**2))) for size, (_, left) in fits.items()}
    best = sizes[0]
    for size in sizes[1:]:
        if cross[size] < GAIN * cross[best]:
            best = size
    return AccelerometerFit(*fits[best], cross, means)


def count_attitudes(means: Floats) -> int:
    """Number of directions among means (m, 3) that are `APART`."""
    kept: list[Floats] = []
    for unit in means / np.linalg.norm(means, axis=1, keepdims=True):
        if all(float(unit @ other) < np.cos(APART) for other in kept):
            kept.append(unit)
    return len(kept)


def _with_left_out(means: Floats, gravity: float, size: int) -> tuple[Adjusted, Floats]:
    def one(rows: Floats) -> Adjusted:
        return adjust(lambda p: lengths(p, rows) - gravity, NOMINAL[:size], PRIOR[:size], LEAST_NOISE)

    everything = one(means)
    left = [lengths(one(np.delete(means, i, axis=0)).parameters, means[i : i + 1])[0] for i in range(len(means))]
    return everything, np.array(left) - gravity


def result_of(fitted: AccelerometerFit, gravity: float, warnings: Sequence[str]) -> CalibrationResult:
    """Values, residuals, refusals and charts."""
    found, count = fitted.found, len(fitted.means)
    values: dict[str, Value] = {}
    refused = {}
    sigmas = np.concatenate([found.sigmas, np.full(9 - len(found.sigmas), np.nan)])
    parameters = np.concatenate([found.parameters, NOMINAL[len(found.parameters) :]])
    for i, name in enumerate(NAMES):
        label = f"accel_{name}"
        if i >= len(found.parameters):
            refused[label] = (
                f"does not lower the cross-validated RMS, or {count} rests are too few; record more attitudes"
            )
        elif sigmas[i] > 0.7 * PRIOR[i]:
            refused[label] = (
                f"not determined by these attitudes (sigma {sigmas[i]:.2g}); rest with this axis up and down"
            )
        if i < len(found.parameters):
            values[label] = Value(float(parameters[i]), float(sigmas[i]), "m/s^2" if i < 3 else "1" if i < 6 else "rad")
    before = np.linalg.norm(fitted.means, axis=1) - gravity
    residuals = {
        "length_before": Residual(float(np.sqrt(np.mean(before**2))), count, "m/s^2"),
        "length": Residual(float(np.sqrt(np.mean(found.residuals**2))), count, "m/s^2"),
        "length_left_out": Residual(float(np.sqrt(np.mean(fitted.left_out**2))), count, "m/s^2"),
    }
    rows = np.arange(count, dtype=np.float64)
    chart = Chart(
        "Length of specific force less gravity",
        "Rest",
        "Difference [m/s²]",
        (
            Series("before", rows, before, "dots", 3),
            Series("after", rows, found.residuals, "dots", 0),
            Series("each by the others", rows, fitted.left_out, "dots", 1),
        ),
    )

    def change(known: Calibration) -> Calibration:
        b = fitted.bias
        errors = replace(
            known.imu_errors,
            accel_matrix=tuple(map(float, fitted.matrix.ravel())),
            accel_bias=(float(b[0]), float(b[1]), float(b[2])),
        )
        return replace(known, imu_errors=errors)

    order = tuple(f"accel_{name}" for name in NAMES[: len(found.parameters)])
    covariance = tuple(map(float, found.covariance.ravel()))
    return CalibrationResult(values, residuals, refused, tuple(warnings), change, (chart,), order, covariance)

"""Gyro from turns: scale and misalignment of w = M (w_read - b), M a full matrix (3, 3).

Between two rests the turn that the gyro integrates must bring the direction of gravity before to that after: two
equations a turn, none for a turn about the vertical (Tedaldi et al. 2014, see `accelerometer`). A turn by a known angle
back to the same attitude, such as once around on a table, gives the angle about its axis, too (Ferraris, Grimaldi,
Parvis 1995, Procedure for effortless in-field calibration of three-axis rate gyros and accelerometers, Sensors and
Materials 7). The bias is the mean rate of the rests before and after.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from smartnav_graph.calibrate.accelerometer import AccelerometerFit, fit_rests, rests_of, result_of
from smartnav_graph.calibrate.least_squares import Adjusted, adjust, derivatives_of
from smartnav_graph.calibrate.rests import RestRows, check_readings, find_rests
from smartnav_graph.calibrate.result import CalibrationResult, Chart, Series
from smartnav_graph.calibrate.static import one_session
from smartnav_graph.core import so3
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.session.session import Session

NOMINAL = np.eye(3).ravel()
PRIOR = np.where(NOMINAL > 0, 0.03, 0.02)  # of scale, and of misalignment in radians
LEAST_TURN = 0.3  # rad between directions of gravity, or of a known turn
LONGEST_S = 60.0  # of a turn: the bias changes
FAR = 0.3  # rad: misfit of gravity after turns beyond which signs are tried
FASTEST = 35.0  # rad/s: range of the gyros of phones (2000 deg/s)
FOLDS, GAIN = 5, 0.8  # of cross-validation; share of the misfit before, that a matrix must reach for turns left out
LEAST_NOISE = 1e-4  # rad
LEAST_MISFIT = 3e-3  # rad, of gravity after a turn by a calibrated sensor: the weight of known angles
KNOWN_SHARE = 0.2  # by which an integrated turn may differ from a known one
SAME_ATTITUDE = np.radians(5.0)


@dataclass(frozen=True)
class GyroOptions:
    """Gyro from turns between rests, which are found by themselves: scale and misalignment by the direction of gravity
    before and after, and by known turns. Turn the device by 90 deg and more, also with each axis level.
    """

    turn_deg: float | None = None
    """Angle of turns that return to the same attitude, such as 360, where the device was turned against an edge."""
    turn_sigma_deg: float = 1.0
    """Standard deviation of that angle."""
    least_rest_s: float = 0.75
    """Shortest rest that is used, s."""


@dataclass(frozen=True)
class Turn:
    """Rates less bias (n, 3) rad/s with their intervals (n,) s, directions of gravity before and after (3,); `known` :
    angle, rad, 0 for none."""

    rates: Floats
    dt: Floats
    before: Floats
    after: Floats
    known: float = 0.0


def accelerated_by(session: Session, rests: list[RestRows], accel: AccelerometerFit, options: GyroOptions,
                   matrix: Floats) -> Callable[[Floats], Floats]:  # fmt: skip
    """Misfits of the turns as a function of the parameters of the accelerometer."""
    weight = LEAST_MISFIT / np.radians(options.turn_sigma_deg)
    axes = so3.across(np.array([turn.after for turn in turns_between(session, rests, accel, options)]))

    def by(parameters: Floats) -> Floats:
        other = replace(accel, found=replace(accel.found, parameters=parameters))
        return misfits(turns_between(session, rests, other, options), matrix, weight, axes)

    return by


def turns_between(session: Session, rests: list[RestRows], accel: AccelerometerFit, options: GyroOptions) -> list[Turn]:
    """The turns between neighbouring rests that show anything."""
    imu, found = session.require_imu(), []
    for one, two in pairwise(rests):
        rows = slice(max(one.last - 2, one.first), min(two.first + 2, two.last))
        bias = (imu.gyro[one.rows].mean(axis=0) + imu.gyro[two.rows].mean(axis=0)) / 2
        dt = np.diff(imu.t_ns[rows]) / NS
        rates = (imu.gyro[rows][1:] + imu.gyro[rows][:-1]) / 2 - bias
        before, after = (_up(imu.accel[rest.rows], accel) for rest in (one, two))
        whole = float(np.linalg.norm(dt @ rates))
        known = 0.0
        if options.turn_deg is not None and float(before @ after) > np.cos(SAME_ATTITUDE):
            wanted = np.radians(options.turn_deg)
            known = wanted if abs(whole / wanted - 1) < KNOWN_SHARE else 0.0
        if dt.sum() <= LONGEST_S and dt.max() < 0.5 and (known or float(before @ after) < np.cos(LEAST_TURN)):
            found.append(Turn(rates, dt, before, after, known))
    return found


def _up(force: Floats, accel: AccelerometerFit) -> Floats:
    mean = accel.matrix @ (force.mean(axis=0) - accel.bias)
    return np.asarray(mean / np.linalg.norm(mean))


def attitudes_after(turns: list[Turn], matrix: Floats) -> Floats:
    """Attitude (m, 3, 3) after each turn in axes before it: products of the small rotations, all turns at once."""
    length = max(len(turn.dt) for turn in turns)
    small = np.zeros((len(turns), 1 << (length - 1).bit_length(), 3))
    for i, turn in enumerate(turns):
        small[i, : len(turn.dt)] = (turn.rates @ matrix.T) * turn.dt[:, None]
    product = so3.exp(small)
    while product.shape[1] > 1:
        product = product[:, 0::2] @ product[:, 1::2]
    return np.asarray(product[:, 0])


def misfits(turns: list[Turn], matrix: Floats, known_weight: float, axes: Floats | None = None) -> Floats:
    """Direction of gravity after each turn by the gyro, across that by the accelerometer (2 m,); then errors of known
    angles, weighted."""
    attitude = attitudes_after(turns, matrix)
    by_gyro = so3.rotate_back(attitude, np.array([turn.before for turn in turns]))
    after = np.array([turn.after for turn in turns])
    left = np.einsum("nji,nj->ni", so3.across(after) if axes is None else axes, by_gyro - after).ravel()
    angles = [
        (np.linalg.norm(turn.dt @ turn.rates @ matrix.T) - turn.known) * known_weight for turn in turns if turn.known
    ]
    return np.concatenate([left, np.array(angles)])


def fit_turns(turns: list[Turn], where: str, options: GyroOptions) -> tuple[Adjusted, float]:
    """The matrix (9 parameters, row-major) by turns, and the RMS misfit before, rad.

    Raises
    ------
    CalibrationError
        Fewer than three turns, or rates of another sign or unit.
    """
    if len(turns) < 3:
        remedy = "turn the device by 90 deg or more between rests of a second, about each axis"
        raise CalibrationError(where, f"{len(turns)} turns between rests", "at least 3", remedy)
    plain = misfits(turns, np.eye(3), 0.0)[: 2 * len(turns)]
    before = float(np.sqrt(np.mean(plain**2)))
    if before > FAR:
        signs = [-np.ones(3), *(np.where(np.arange(3) == axis, -1.0, 1.0) for axis in range(3))]
        for axes, sign in zip(("all axes", *"xyz"), signs, strict=True):
            if np.sqrt(np.mean(misfits(turns, np.diag(sign), 0.0)[: 2 * len(turns)] ** 2)) < 0.3 * before:
                found = f"{axes} of the gyro read with the opposite sign"
                raise CalibrationError(where, found, "counter-clockwise positive", "change it in the import")
    weight = LEAST_MISFIT / np.radians(options.turn_sigma_deg)
    return adjust(lambda p: misfits(turns, p.reshape(3, 3), weight), NOMINAL, PRIOR, LEAST_NOISE), before


def left_out_misfit(turns: list[Turn], options: GyroOptions) -> float:
    """RMS misfit of gravity, rad, after turns by the matrix of the other turns, a fifth at a time."""
    weight, errors = LEAST_MISFIT / np.radians(options.turn_sigma_deg), []
    for fold in range(min(FOLDS, len(turns))):
        others = [turn for i, turn in enumerate(turns) if i % FOLDS != fold]

        def misfit(p: Floats, others: list[Turn] = others) -> Floats:
            return misfits(others, p.reshape(3, 3), weight)

        matrix = adjust(misfit, NOMINAL, PRIOR, LEAST_NOISE).parameters.reshape(3, 3)
        errors.append(misfits(turns[fold::FOLDS], matrix, 0.0)[: 2 * len(turns[fold::FOLDS])])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def fit(sources: Sequence[Session], options: GyroOptions) -> CalibrationResult:
    """Calibrate the gyro by the turns between the rests of one recording."""
    session = one_session(sources)
    return fit_both(session, options)[1]


def fit_both(session: Session, options: GyroOptions) -> tuple[CalibrationResult, CalibrationResult]:
    """Accelerometer and gyro by one recording."""
    warnings, rates = check_readings(session), np.abs(session.require_imu().gyro).max(axis=1)
    if np.quantile(rates, 0.99) > FASTEST:
        fast = f"rates of {np.quantile(rates, 0.99):.3g} rad/s: they look like deg/s"
        raise CalibrationError(str(session.path or "session"), fast, "rad/s", "--repair units converts them")
    rests = find_rests(session.require_imu(), options.least_rest_s)
    accel = fit_rests(session, rests_of(session, options.least_rest_s))
    turns = turns_between(session, rests, accel, options)
    found, before = fit_turns(turns, str(session.path or "session"), options)
    by = accelerated_by(session, rests, accel, options, found.parameters.reshape(3, 3))
    own = accel.found
    found = found.with_errors(derivatives_of(by, own.parameters, 0.1 * own.sigmas), own.covariance)
    return result_of(accel, session.gravity, warnings), _gyro_result(
        found, (before, left_out_misfit(turns, options)), turns, session, rests
    )


def _gyro_result(
    found: Adjusted, misfit: tuple[float, float], turns: list[Turn], session: Session, rests: list[RestRows]
) -> CalibrationResult:
    values, refused, (before, cross) = {}, {}, misfit
    useful = cross < GAIN * before or any(turn.known for turn in turns)
    if not useful:
        why = f"turns left out show {cross:.2g} rad, {before:.2g} without; not used: record more turns, about all axes"
        refused["gyro_matrix"] = why
    for i, (value, sigma) in enumerate(zip(found.parameters, found.sigmas, strict=True)):
        row, column = divmod(i, 3)
        name = f"gyro_scale_{'xyz'[row]}" if row == column else f"gyro_misalignment_{'xyz'[row]}{'xyz'[column]}"
        values[name] = Value(float(value), float(sigma), "1" if row == column else "rad")
        if sigma > 0.7 * PRIOR[i]:
            why = "turn about this axis while it is level, or by a known angle"
            refused[name] = f"not determined by these turns (sigma {sigma:.2g}): {why}"
    means = np.array([session.require_imu().gyro[rest.rows].mean(axis=0) for rest in rests])
    count, lengths = len(rests), np.array([len(rest) for rest in rests], dtype=np.float64)
    bias = lengths @ means / lengths.sum()
    spread = means.std(axis=0, ddof=1)
    for i, axis in enumerate("xyz"):
        values[f"gyro_bias_{axis}"] = Value(float(bias[i]), float(spread[i] / np.sqrt(count)), "rad/s")
    left = found.residuals[: 2 * len(turns)].reshape(-1, 2)
    residuals = {
        "gravity_before": Residual(before, len(turns), "rad"),
        "gravity": Residual(float(np.sqrt(np.mean(left**2))), len(turns), "rad"),
        "gravity_left_out": Residual(cross, len(turns), "rad"),
        "rest_bias": Residual(float(np.sqrt(np.mean(spread**2))), count, "rad/s"),
    }
    rows = np.arange(len(turns), dtype=np.float64)
    dots = (Series("after", rows, np.degrees(np.linalg.norm(left, axis=1)), "dots", 0),)
    chart = Chart("Direction of gravity after a turn, by gyro and by accelerometer", "Turn", "Angle [°]", dots)

    def change(known: Calibration) -> Calibration:
        matrix = tuple(map(float, found.parameters if useful else NOMINAL))
        errors = replace(
            known.imu_errors, gyro_matrix=matrix, gyro_bias=(float(bias[0]), float(bias[1]), float(bias[2]))
        )
        return replace(known, imu_errors=errors)

    names = tuple(list(values)[:9])
    covariance = tuple(map(float, found.covariance.ravel()))
    return CalibrationResult(values, residuals, refused, (), change, (chart,), names, covariance)

"""The verdict of a run: good, doubtful or contradictory, with its reasons.

Its tests are none that the estimate made itself: every sensor's chi-square by its own redundancy, how far the noise,
clock and biases found lie from what was known of them before, which fixes were rejected, whether residuals of
neighbouring fixes are alike, withheld fixes against interpolation of the kept ones, and what the recording showed
before the graph was built.

contradictory : measurements exclude each other, or the result is no trajectory of this device
doubtful : the result may be wrong by more than its covariance says
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import runs
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.result.chi2 import IMAGES
from smartnav_graph.estimate.result.predictions import fixes_left_out, predictions, withheld_points
from smartnav_graph.estimate.result.reasons import LEVELS, Reason, Test, VerdictInputs
from smartnav_graph.estimate.result.score_tests import SensorError, sensor_errors
from smartnav_graph.estimate.reweight.image_pair_outliers import pair_account
from smartnav_graph.estimate.reweight.imu_noise import worse_than_class
from smartnav_graph.estimate.reweight.lasting_errors import lasting_errors
from smartnav_graph.estimate.reweight.outliers import FixResiduals, position_builders
from smartnav_graph.factors.camera import FOCAL
from smartnav_graph.factors.coplanarity import SHARED
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.graph.update import one_of
from smartnav_graph.session.calibration.model import CARRIER_PHASE_SIGMA
from smartnav_graph.session.health.clocks import STATE_S

# Chi-square per degree of freedom of one sensor that its noise does not explain, and that nothing does.
MISFIT, EXCLUDED = 2.0, 6.0
# Sensors under a robust loss: their tails are expected, as those of draughts are.
ROBUST = (*IMAGES, "magnetometer", "barometer")
# How rarely a sensor that fits reaches its chi-square.
RARE = 1e-6
# Consecutive rejected fixes, seconds of them, and share of all, that speak against the solution rather than the fixes.
REJECTED_RUN, REJECTED_S, REJECTED_SHARE, MOST_REJECTED = 4, 3.0, 0.1, 0.3
# Share of the image pairs that contradict the other sensors where nothing is wrong but single images.
CONTRARY_SHARE = 0.1
# Biases beyond so many sigmas of what was known of them.
FAR = 4.0
# Scatter of the samples of an accelerometer over that of its class; of phones in cars and of feet it is 3.
SCATTERING = 6.0
# Noise of a constraint of the motion over that of its class.
WIDE = 6.0
# Correlation of neighbouring fix residuals, and the least number of pairs that shows it.
ALIKE, LEAST_PAIRS = 0.35, 40
# Fourth moment over the square of the second, and distance (m) of two places that fixes are at in turns; of rounded
# coordinates a device at rest has two in turns, too.
TWO_PLACES, LEAST_APART_M = 1.6, 5.0


@dataclass(frozen=True)
class Limit:
    """Size and number of sigmas of an error from which on it counts, and what it is in words."""

    size: float
    sigmas: float
    text: str
    remedy: str


# Clock errors (s) of more than that say that nothing moves; large ones are looked for before the graph is built.
LINEAR_S = 20.0
# Receivers are late, antennas lie beside the device, scale factors of phones are wrong, by less.
_LATER = "the motion fits with stamps {value:+.1f} s later"
_SCALED = "of {axis} is {percent:+.1f} % too large by the other sensors"
LIMITS = {
    "clock": Limit(STATE_S, 4.0, _LATER, "correct its stamps, or its lever arm"),
    "clock rate": Limit(
        0.003,
        3.5,
        "the motion fits with stamps stretched by {percent:+.1f} %",
        "correct the clock that is wrong, most likely that of the inertial data",
    ),
    "clock jump": Limit(1.0, 5.0, _LATER + " from there on", "correct its stamps from there on"),
    "lever arm": Limit(1.5, 4.5, "the motion fits a lever arm {value:+.1f} m longer along {axis}", "correct body_t"),
    "accelerometer scale": Limit(
        0.02, 5.0, "accel " + _SCALED, "calibrate the accelerometer, or check its axes and unit"
    ),
    "offset": Limit(
        2.0, 5.0, "positions lie {value:+.1f} m {axis} of the other sensors", "bring all positions to one datum"
    ),
    "stretch": Limit(
        0.05, 5.0, "positions {axis} are {percent:+.0f} % too far apart", "check units and projection of its positions"
    ),
    "focal length": Limit(0.015, 5.0, "the focal length given is {percent:+.1f} % too long", "calibrate the camera"),
    "gyro scale": Limit(0.02, 5.0, "gyro " + _SCALED, "calibrate the gyroscope, or check its axes and unit"),
}


def verdict(inputs: VerdictInputs) -> dict[str, object]:
    """The verdict as in summary.json: level, and reasons, worst first."""
    tests = POSITIONS_ONLY if inputs.solved.problem.positions_only else TESTS
    reasons = [reason for test in tests for reason in test(inputs)]
    reasons.sort(key=lambda reason: -LEVELS.index(reason.level))
    return {"level": reasons[0].level if reasons else LEVELS[0], "reasons": [reason.to_dict() for reason in reasons]}


def _misfits(inputs: VerdictInputs) -> Iterator[Reason]:
    """Sensors whose residuals are larger than their noise. States that left a lag one after the other were never
    solved together: their misfit says nothing of the data."""
    for name, value in inputs.fit.per_dof().items() if inputs.together else ():
        part = inputs.fit.parts.get(name)
        if part is None or (name in ROBUST and value < EXCLUDED):
            continue
        if value > MISFIT and chi_square.sf(part.square, max(part.redundancy, 1.0)) < RARE:
            level = LEVELS[2] if value > EXCLUDED and part.redundancy > 20 else LEVELS[1]
            text = f"chi-square per degree of freedom is {value:.1f}, 1 is expected"
            yield Reason(level, name, text, "check its units, axes, clock and sigmas", value)


def _rejected(inputs: VerdictInputs) -> Iterator[Reason]:
    for name, residuals in inputs.solved.fixes.items():
        out = ~inputs.solved.pass_state.used(name, residuals.rows)
        if not len(out):
            continue
        share = float(out.mean())
        if share > REJECTED_SHARE:
            level = LEVELS[2] if share > MOST_REJECTED else LEVELS[1]
            text = f"{100 * share:.0f} % of the fixes were rejected"
            yield Reason(level, name, text, "check clock, axes and outliers of this sensor", share)
        yield from _rejected_runs(inputs, name, residuals, out)


def _rejected_runs(inputs: VerdictInputs, name: str, residuals: FixResiduals, out: np.ndarray) -> Iterator[Reason]:
    t = inputs.solved.problem.session.seconds(inputs.solved.estimate.t_ns[residuals.keyframe])
    for first, end in runs(out):
        last = end - 1
        if last - first + 1 >= REJECTED_RUN and t[last] - t[first] >= REJECTED_S:
            size = float(np.linalg.norm(residuals.residual[first:end], axis=1).max())
            text = f"{end - first} fixes in a row were rejected, up to {size:.1f} m from the solution"
            remedy = "look whether the fixes or the solution are wrong there"
            yield Reason(LEVELS[1], name, text, remedy, size, float(t[first]), float(t[last]))


def _noise(inputs: VerdictInputs) -> Iterator[Reason]:
    imu, pass_state = one_of(inputs.solved.problem.builders, ImuBuilder), inputs.solved.pass_state
    for name, found in worse_than_class(imu, pass_state).items() if imu is not None else ():
        text = f"noise of the {name} is found {found:.1f} times that of its class, and its samples do not show it"
        yield Reason(LEVELS[1], "imu", text, "check units, axes and clock, or calibrate the device", found)
    scatter = 0.0 if imu is None else imu.sampling_scales()["accel"]
    if scatter > SCATTERING:
        text = f"samples of the accelerometer scatter {scatter:.1f} times as much as those of its class"
        yield Reason(LEVELS[1], "imu", text, "mount the device without vibration, or calibrate it", scatter)


def _constraints(inputs: VerdictInputs) -> Iterator[Reason]:
    """What the device is said not to do, and does."""
    for builder in inputs.solved.problem.builders:
        for group in builder.noise_groups:
            found = inputs.solved.pass_state.scale(group)
            if found > WIDE:
                text = f"noise of {group.replace('_', ' ')} is found {found:.0f} times what is usual"
                remedy = "check axes and clock, or give --vehicle none"
                yield Reason(LEVELS[1], builder.name, text, remedy, found)


def _filtered(inputs: VerdictInputs) -> Iterator[Reason]:
    """Fixes without sigmas that agree with each other, but with the inertial data only by a correlated error."""
    for builder in position_builders(inputs.solved.problem.builders):
        sigma = float(np.median(builder.scaled_sigma(inputs.solved.pass_state)[:, :2]))
        found = builder.name in inputs.solved.pass_state.correlated and not builder.has_sigmas
        if found and sigma < CARRIER_PHASE_SIGMA:
            text = f"fixes agree with each other to {sigma:.2f} m, but not so with the inertial data"
            remedy = "they may be filtered, or a lever arm, scale or height wrong; give sigmas where they are right"
            yield Reason(LEVELS[1], builder.name, text, remedy, sigma)


def _lasting(inputs: VerdictInputs) -> Iterator[Reason]:
    """Errors that last, of fixes whose sigmas or calibration say that they have none."""
    builders, pass_state = inputs.solved.problem.builders, inputs.solved.pass_state
    silent = frozenset[str]()
    if inputs.together:
        linear = None if inputs.unmodelled is None else inputs.unmodelled.linear
        silent = lasting_errors(builders, inputs.solved.estimate, pass_state, linear)
    for builder in position_builders(builders):
        sigma = float(np.median(builder.scaled_sigma(pass_state)[:, :2]))
        joined = builder.has_sigmas and builder.name in pass_state.correlated and sigma < CARRIER_PHASE_SIGMA
        if joined or builder.name in silent:
            text = f"errors of fixes with sigmas of {sigma:.2g} m last for many fixes, and the solution follows them"
            remedy = "the sigmas may be those of their noise alone: give larger ones, or the correlated error"
            yield Reason(LEVELS[1], builder.name, text, remedy, sigma)


def _clocks(inputs: VerdictInputs) -> Iterator[Reason]:
    for name in inputs.solved.fixes:
        offset = inputs.solved.estimate.offset_s(name)
        if abs(offset) > STATE_S:
            text = f"its clock is found {offset:+.2f} s off, more than a receiver is late"
            yield Reason(LEVELS[1], name, text, "correct its stamps", offset)


def _sensor_errors(inputs: VerdictInputs) -> Iterator[Reason]:
    """Errors that have no state, or are more than its prior allows: the clearest one of each sensor. Fixes that are
    filtered lag by more than a constant time, which looks like a lever arm along the motion. Sigmas are as wide as the
    residuals of the sensor show."""
    worst: dict[str, SensorError] = {}
    misfit = inputs.fit.per_dof()
    session = inputs.solved.problem.session
    for error in sensor_errors(inputs.unmodelled) if inputs.together else ():
        limit = LIMITS[error.kind]
        error = replace(error, sigma=error.sigma * float(np.sqrt(max(misfit.get(error.sensor, 1.0), 1.0))))
        along = (error.sensor, error.kind) == ("gnss", "lever arm") and error.axis == session.device.forward[1]
        linear = not error.kind.startswith("clock") or abs(error.value) < LINEAR_S
        clear = linear and abs(error.value) > max(limit.size, (1.5 if along else 1.0) * limit.sigmas * error.sigma)
        known = worst.get(error.sensor)
        if clear and (known is None or abs(error.value / error.sigma) > abs(known.value / known.sigma)):
            worst[error.sensor] = error
    for sensor, error in worst.items():
        limit = LIMITS[error.kind]
        start = None if error.t_ns is None else float(session.seconds(error.t_ns))
        text = limit.text.format(value=error.value, axis=error.axis, percent=100.0 * error.value)
        yield Reason(LEVELS[1], sensor, text, limit.remedy, error.value, start)


def _images(inputs: VerdictInputs) -> Iterator[Reason]:
    """Images that contradict the other sensors."""
    seen = pair_account(inputs.solved.problem.builders, inputs.solved.pass_state)
    share = 0.0 if seen is None else seen.contrary / max(seen.used + seen.contrary, 1)
    if seen is not None and (seen.refused or share > CONTRARY_SHARE):
        none = ", and none is used" if seen.refused else ""
        text = f"{100 * share:.0f} % of the image pairs contradict the other sensors{none}"
        remedy = "check clock and calibration of the camera, or add fixes, control points or standstills"
        yield Reason(LEVELS[1], "image_pairs", text, remedy, share)


def _direction(inputs: VerdictInputs) -> Iterator[Reason]:
    """Image pairs that count for less than their matches say."""
    turned = inputs.solved.pass_state.noise_scales.get(SHARED, 0.0)
    if turned:
        text = f"image pairs and the other sensors agree on the direction of motion to {np.degrees(turned):.1f} deg"
        yield Reason(LEVELS[1], "image_pairs", text, "check clock and calibration of the camera", turned)


def _focal_length(inputs: VerdictInputs) -> Iterator[Reason]:
    """A focal length that is found far from the calibrated one, or further than its sigma allows."""
    found = next((one for one in inputs.solved.estimate.session.values() if one.name == FOCAL and not one.held), None)
    if found is None or not inputs.together:
        return
    (value,), (sigma,), (prior,), limit = found.value, found.sigma, found.prior_sigma, LIMITS["focal length"]
    if abs(value) > min(max(limit.size, limit.sigmas * sigma), FAR * prior):
        yield Reason(LEVELS[1], "image_pairs", limit.text.format(percent=100.0 * value), limit.remedy, float(value))


def _biases(inputs: VerdictInputs) -> Iterator[Reason]:
    noise, bias = inputs.solved.problem.calibration.imu_noise, inputs.solved.estimate.states()[3]
    parts = {
        "accelerometer": (bias[:, :3], noise.accel_bias_sigma, "m/s^2"),
        "gyro": (bias[:, 3:], noise.gyro_bias_sigma, "rad/s"),
    }
    for name, (value, sigma, unit) in parts.items():
        size = float(np.abs(np.median(value, axis=0)).max())
        if size > FAR * sigma:
            text = f"bias of the {name} is found {size:.3g} {unit}, {size / sigma:.0f} times what its class has"
            yield Reason(LEVELS[1], "imu", text, "check its units, axes and scale, or calibrate the device", size)


def _alike(inputs: VerdictInputs) -> Iterator[Reason]:
    """Residuals of neighbouring fixes that are alike: an error of the fixes that lasts, or of the solution."""
    for name, residuals in inputs.solved.fixes.items():
        used = inputs.solved.pass_state.used(name, residuals.rows)
        white = (residuals.residual / residuals.sigma)[used, :2]
        if len(white) <= LEAST_PAIRS or name in inputs.solved.pass_state.correlated:
            continue
        rho = float((white[1:] * white[:-1]).sum() / max(float((white**2).sum()), 1e-12))
        if rho > ALIKE:
            text = f"residuals of neighbouring fixes have a correlation of {rho:.2f}: their errors last"
            yield Reason(LEVELS[1], name, text, "give larger sigmas; the covariance is too small", rho)


def _two_places(inputs: VerdictInputs) -> Iterator[Reason]:
    """Fixes on both sides of the solution and none on it, as of two receivers, places or height datums: along the axis
    of the largest spread d their fourth moment is little more than d^4, three times that if normal."""
    for name, residuals in inputs.solved.fixes.items():
        for axes, what in ((slice(0, 2), "fixes"), (slice(2, 3), "heights of the fixes")):
            if len(residuals.residual) <= LEAST_PAIRS:
                continue
            r = residuals.residual[:, axes] - residuals.residual[:, axes].mean(axis=0)
            along = r @ np.linalg.eigh(r.T @ r)[1][:, -1]
            apart = 2.0 * float(along.std())
            if apart > LEAST_APART_M and np.mean(along**4) < TWO_PLACES * np.mean(along**2) ** 2:
                text = f"{what} are alternately of two places, {apart:.1f} m apart"
                yield Reason(LEVELS[2], name, text, "look whether two receivers or datums were merged", apart)


def _recording(inputs: VerdictInputs) -> Iterator[Reason]:
    """What the recording showed before the graph was built."""
    t0 = inputs.solved.problem.session.t0_ns
    for finding in inputs.solved.problem.findings:
        if finding.verdict == LEVELS[0]:
            continue
        start, end = (None if t_ns is None else (t_ns - t0) / NS for t_ns in (finding.start_ns, finding.end_ns))
        yield Reason(finding.verdict, finding.where, finding.text, finding.remedy, finding.size, start, end)


def _solver(inputs: VerdictInputs) -> Iterator[Reason]:
    if not inputs.solved.estimate.converged:
        text = "the iteration limit was reached before the cost settled"
        yield Reason(LEVELS[1], "solve", text, "raise solver.max_iterations")


# What names a cause comes before what it makes of the solution.
TESTS: tuple[Test, ...] = (
    *(_recording, _clocks, _sensor_errors, _misfits, _rejected, _noise, _constraints, _filtered, _lasting, _images),
    *(_focal_length, _direction, _biases, _alike, _two_places, predictions, withheld_points, fixes_left_out, _solver),
)
# What compares positions with inertial data says nothing of a motion model.
POSITIONS_ONLY: tuple[Test, ...] = (_recording, _misfits, _rejected, _alike, _solver)

"""Sensors at rest: bias by temperature and time, noise and its terms, Allan deviation, heading noise of a magnetometer.

Values by sensor and axis, e.g. ``gyro_white_noise_x`` (N), ``gyro_bias_instability_x`` (B; the Allan deviation is flat
at 0.664 B), ``gyro_random_walk_x`` (K), ``gyro_quantisation_x`` (Q), ``gyro_rate_ramp_x``: see `noise`. A bias of the
gyro contains the Earth's rotation (7.3e-5 rad/s); that of the accelerometer is not separable from gravity in one
attitude and is left to ``smartnav calibrate accelerometer``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.calibrate.allan import allan_deviation, cluster_sizes, confidence_limits
from smartnav_graph.calibrate.noise import TERMS
from smartnav_graph.calibrate.rests import RestRows, check_readings, check_unit, find_rests, interval_s
from smartnav_graph.calibrate.result import CalibrationResult, Chart, Series
from smartnav_graph.calibrate.static_axis import MEANS, AxisAtRest, block_means, characterise
from smartnav_graph.core import so3
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.session.calibration.model import Calibration, ImuErrors, ImuNoise
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Imu

LEAST_REST_S = 60.0
LEAST_RANGE_C = 2.0  # of temperature for a regression
NOISE_ROWS = 100  # the standard deviation is that about means over about half as many readings
SMOOTHED_S = 60.0  # over which readings of temperature are averaged
NAMES = dict(zip(TERMS, ("white_noise", "bias_instability", "random_walk", "quantisation"), strict=True))
UNITS = {
    "accel": ("m/s^2", "m/s^2/sqrt(Hz)", "m/s^2", "m/s^3/sqrt(Hz)", "m/s"),
    "gyro": ("rad/s", "rad/s/sqrt(Hz)", "rad/s", "rad/s^2/sqrt(Hz)", "rad"),
}
REMEDIES = {
    "white": "record faster, unfiltered",
    "flicker": "record longer",
    "walk": "record longer",
    "quantisation": "record faster; nothing is needed for navigation",
}


@dataclass(frozen=True)
class StaticOptions:
    """Sensors at rest: temperature regression with cross-validation, drift, noise, overlapping Allan deviation with
    confidence limits; white noise, bias instability, random walk, rate ramp and quantisation with sigmas; magnetometer.
    """

    highest_order: int = 3
    """Highest power of temperature that cross-validation may choose."""
    least_rest_s: float = LEAST_REST_S
    """Shortest rest that is used, s."""


def fit(sources: Sequence[Session], options: StaticOptions) -> CalibrationResult:
    """Characterise the sensors of one recording at rest.

    Raises
    ------
    CalibrationError
        No rest that is long enough; constant or clipped axis; more than one recording.
    """
    session = one_session(sources)
    warnings, imu = check_readings(session), session.require_imu()
    rests, dt = find_rests(imu, options.least_rest_s, quiet=0.5), interval_s(imu.t_ns)
    if not rests:
        found = f"no rest of {options.least_rest_s:g} s: the device moved"
        raise CalibrationError(session.path or "session", found, "a device at rest", "put it on a firm table")
    check_unit(session, np.array([imu.accel[rest.rows].mean(axis=0) for rest in rests]))
    warnings += _moved(session, rests)
    temperature, refused = _temperature(session, rests)
    mean_c = 25.0 if temperature is None else float(np.mean(np.concatenate([temperature[r.rows] for r in rests])))
    beside = None if temperature is None else temperature - mean_c
    axes = {
        f"{sensor}_{'xyz'[i]}": characterise(
            getattr(imu, sensor)[:, i], rests, beside, dt, options.highest_order, common=sensor == "gyro"
        )
        for sensor in ("accel", "gyro")
        for i in range(3)
    }
    values: dict[str, Value] = {}
    longest = max(rests, key=len)
    for name, axis in axes.items():
        _record(axis, name, temperature is not None, len(longest) * dt, values, refused)
    _gravity(imu.accel[longest.rows].mean(axis=0), session.gravity, values)
    _heading_noise(session, longest, values, refused)
    warnings += _filtered({name: axis.found.noise.band_hz for name, axis in axes.items()}, dt)
    spans = [] if temperature is None else [temperature[r.rows] for r in rests]
    lowest, highest = (min(map(np.min, spans)), max(map(np.max, spans))) if spans else (mean_c, mean_c)

    def change(known: Calibration) -> Calibration:
        errors = _errors(known.imu_errors, axes, mean_c, (float(lowest), float(highest)))
        return replace(known, imu_errors=errors, imu_noise=_raised(known.imu_noise, axes))

    charts = [
        *_allan_charts(imu, longest, axes, dt, values),
        *_temperature_charts(rests, imu, temperature, axes, mean_c),
    ]
    left = {name: np.concatenate(axis.found.residuals) for name, axis in axes.items()}
    residuals = {name: Residual(float(r.std()), len(r), UNITS[name[:-2]][0]) for name, r in left.items()}
    return CalibrationResult(values, residuals, refused, tuple(warnings), change, tuple(charts))


def one_session(sources: Sequence[Session]) -> Session:
    """The only session of the sources.

    Raises
    ------
    CalibrationError
        There are several.
    """
    if len(sources) != 1:
        raise CalibrationError("sources", f"{len(sources)} recordings", "one session", "calibrate one at a time")
    return sources[0]


def _moved(session: Session, rests: list[RestRows]) -> list[str]:
    imu = session.require_imu()
    share = 1 - sum(map(len, rests)) / len(imu)
    if share < 0.02:
        return []
    spans = [session.seconds(imu.t_ns[[rest.first, rest.last - 1]]) for rest in rests[:5]]
    when = ", ".join(f"{a:.0f}-{b:.0f}" for a, b in spans) + (" ..." if len(rests) > 5 else "")
    return [f"moved {100 * share:.0f} % of the time: used are the rests at {when} s; leave the device at rest"]


def _filtered(bands: dict[str, float], dt: float) -> list[str]:
    names = [name for name, hz in bands.items() if hz < 0.45 / dt]
    if not names:
        return []
    found = f"readings follow no noise model above {min(bands.values()):.3g} Hz (low-passed, or vibration)"
    return [f"{', '.join(names)}: {found}: noise is that below, single samples do not show it; record unfiltered"]


def _temperature(session: Session, rests: list[RestRows]) -> tuple[Floats | None, dict[str, str]]:
    """Temperature (n,) of every inertial row, smoothed over a minute; the refusal where there is none, or no change."""
    stream, imu = session.temperature, session.require_imu()
    if stream is None or len(stream) < 3:
        return None, {"temperature": "none was recorded; record it beside the inertial data"}
    width = min(max(round(SMOOTHED_S / interval_s(stream.t_ns)), 1), len(stream))
    padded = np.pad(stream.temperature_c, (width // 2, width - 1 - width // 2), mode="edge")
    smooth = np.convolve(padded, np.full(width, 1 / width), mode="valid")
    at = interpolate(imu.t_ns, stream.t_ns, smooth)
    span = float(np.ptp(np.concatenate([at[rest.rows] for rest in rests])))
    if span < LEAST_RANGE_C:
        return None, {"temperature": f"constant within {span:.2g} deg C; heat or cool the device"}
    return at, {}


def _record(
    axis: AxisAtRest, name: str, by_temperature: bool, seconds: float, values: dict[str, Value], refused: dict[str, str]
) -> None:
    """Values and refusals of one axis."""
    from scipy.fft import dct

    sensor, letter = name.split("_")
    unit, *term_units = UNITS[sensor]
    found, noise = axis.found, axis.found.noise
    if sensor == "gyro":
        values[f"gyro_bias_{letter}"] = Value(float(found.means[0]), float(found.mean_sigmas[0]), unit)
    longest = max(found.residuals, key=len)
    spread = noise.variances(len(longest), axis.dt)
    first = len(longest) // NOISE_ROWS
    deviation = float(np.sqrt(np.mean(dct(longest, norm="ortho")[first:] ** 2)))
    relative = float(np.sqrt(2 * np.sum(spread[first:] ** 2)) / np.sum(spread[first:]))
    values[f"{sensor}_noise_{letter}"] = Value(deviation, deviation * relative / 2, unit)
    for term, term_unit in zip(TERMS, term_units, strict=True):
        label = f"{sensor}_{NAMES[term]}_{letter}"
        if term in noise.coefficients:
            values[label] = Value(*noise.coefficients[term], term_unit)
        else:
            limit = f"not significant, below {noise.limits[term]:.2g} {term_unit} (95 %)"
            refused[label] = f"{limit} in {seconds / 3600:.1f} h; {REMEDIES[term]}"
    ramp, sigma = axis.ramp
    values[f"{sensor}_rate_ramp_{letter}"] = Value(ramp, sigma, f"{unit}/s")
    if by_temperature:
        for power, (slope, error) in enumerate(zip(found.slopes, found.sigmas, strict=True), 1):
            suffix = "" if power == 1 else str(power)
            values[f"{sensor}_temperature{suffix}_{letter}"] = Value(float(slope), float(error), f"{unit}/K{suffix}")
        if axis.order == 0:
            why = "does not predict the bias at temperatures left out; the slope is not used: record a wider range"
            refused[f"{sensor}_temperature_{letter}"] = why
        if np.isfinite(axis.hysteresis):
            values[f"{sensor}_hysteresis_{letter}"] = Value(axis.hysteresis, np.nan, unit)


def _gravity(force: Floats, gravity: float, values: dict[str, Value]) -> None:
    values["accel_length_minus_gravity"] = Value(float(np.linalg.norm(force)) - gravity, np.nan, "m/s^2")


def _heading_noise(session: Session, rest: RestRows, values: dict[str, Value], refused: dict[str, str]) -> None:
    """Noise of heading, pitch and roll by magnetometer and accelerometer, each at its own rate."""
    imu, stream = session.require_imu(), session.magnetometer
    up = block_mean_direction(imu.accel[rest.rows])
    level = so3.across(up[None])[0]  # two directions, (3, 2)
    force = imu.accel[rest.rows]
    tilt = np.degrees((force - force.mean(axis=0)) @ level / np.linalg.norm(force.mean(axis=0)))
    for i, name in enumerate(("tilt_noise_a", "tilt_noise_b")):
        values[name] = Value(float(tilt[:, i].std()), np.nan, "deg")
    if stream is None:
        refused["heading_noise"] = "no magnetometer; record it"
        return
    inside = (stream.t_ns >= imu.t_ns[rest.first]) & (stream.t_ns <= imu.t_ns[rest.last - 1])
    if inside.sum() < 30:
        refused["heading_noise"] = f"{int(inside.sum())} readings of the magnetometer at rest; record longer"
        return
    for i, reading in enumerate(stream.field_ut[inside].T):
        values[f"magnetometer_noise_{'xyz'[i]}"] = Value(float(reading.std()), np.nan, "uT")
    field = stream.field_ut[inside] @ level
    heading = np.degrees(np.unwrap(np.arctan2(field[:, 1], field[:, 0])))
    count = len(heading)
    values["heading_noise"] = Value(float(heading.std()), float(heading.std() / np.sqrt(2 * count)), "deg")


def block_mean_direction(force: Floats) -> Floats:
    """Unit vector (3,) of the mean of specific force (n, 3)."""
    mean = force.mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _errors(known: ImuErrors, axes: dict[str, AxisAtRest], mean_c: float, span: tuple[float, float]) -> ImuErrors:
    """Bias of the gyro, and slopes that cross-validation keeps."""
    bias = tuple(float(axes[f"gyro_{a}"].found.means[0]) for a in "xyz")
    slopes = {}
    for sensor in ("accel", "gyro"):
        kept = [axes[f"{sensor}_{a}"] for a in "xyz"]
        highest = max(axis.order for axis in kept)
        rows = np.zeros((3, highest))
        for row, axis in zip(rows, kept, strict=True):
            row[: axis.order] = axis.found.slopes[: axis.order]
        slopes[sensor] = tuple(map(float, rows.ravel()))
    return replace(
        known,
        gyro_bias=(bias[0], bias[1], bias[2]),
        accel_temperature=slopes["accel"],
        gyro_temperature=slopes["gyro"],
        temperature_c=mean_c,
        temperature_range_c=span,
    )


def _raised(known: ImuNoise, axes: dict[str, AxisAtRest]) -> ImuNoise:
    """The noise that the estimation assumes covers motion too; it is raised where a sensor has more even at rest."""
    changes = {}
    for sensor in ("accel", "gyro"):
        for term, field in (("white", "noise_density"), ("walk", "bias_walk")):
            found = [axes[f"{sensor}_{a}"].found.noise.coefficients.get(term, (0.0, 0.0))[0] for a in "xyz"]
            name = f"{sensor}_{field}"
            changes[name] = max(getattr(known, name), float(np.sqrt(np.mean(np.square(found)))))
    return replace(known, **changes)


def _allan_charts(
    imu: Imu, rest: RestRows, axes: dict[str, AxisAtRest], dt: float, values: dict[str, Value]
) -> list[Chart]:
    """Allan deviation of each sensor with limits and model; its minimum is added to the values."""
    sizes = cluster_sizes(len(rest))
    tau = np.asarray(sizes * dt, dtype=np.float64)
    charts = []
    for sensor in ("accel", "gyro"):
        unit = UNITS[sensor][0]
        left = [max(axes[f"{sensor}_{a}"].found.residuals, key=len) for a in "xyz"]
        deviation = allan_deviation(np.stack(left, axis=1), sizes)
        series = []
        for i, a in enumerate("xyz"):
            low, high = confidence_limits(deviation[:, i], sizes, len(rest))
            model = np.sqrt(axes[f"{sensor}_{a}"].found.noise.allan_variance(tau))
            series += [
                Series(f"{a}, 95 %", tau, low, "band", i, high),
                Series(f"{a}", tau, deviation[:, i], "dots", i),
                Series(f"{a}, fitted terms", tau, model, "line", i),
            ]
            least = int(np.argmin(deviation[:, i]))
            sigma = float(high[least] - low[least]) / 3.92
            values[f"{sensor}_allan_minimum_{a}"] = Value(float(deviation[least, i]), sigma, unit)
            values[f"{sensor}_allan_minimum_tau_{a}"] = Value(float(tau[least]), np.nan, "s")
        charts.append(
            Chart(f"Allan deviation, {sensor}", "tau [s]", f"Allan deviation [{unit}]", tuple(series), log=True)
        )
    return charts


def _temperature_charts(
    rests: list[RestRows], imu: Imu, temperature: Floats | None, axes: dict[str, AxisAtRest], mean_c: float
) -> list[Chart]:
    """Short means by time, and by temperature with the regression."""
    rows = np.concatenate([np.arange(r.first, r.last) for r in rests])
    size = max(len(rows) // MEANS, 1)
    seconds = block_means((imu.t_ns[rows] - imu.t_ns[0]) / NS, size)
    gyro = block_means(imu.gyro[rows], size)
    lines = tuple(Series(a, seconds, gyro[:, i], "dots", i) for i, a in enumerate("xyz"))
    charts = [Chart("Gyro at rest", "Time since start [s]", "Rate [rad/s]", lines)]
    if temperature is not None:
        at = block_means(temperature[rows], size)
        order = np.argsort(at)
        series = []
        for i, a in enumerate("xyz"):
            found = axes[f"gyro_{a}"].found
            powers = (at[order] - mean_c)[:, None] ** np.arange(1, len(found.slopes) + 1)
            series += [
                Series(a, at, gyro[:, i], "dots", i),
                Series(f"{a}, regression", at[order], found.means[0] + powers @ found.slopes, "line", i),
            ]
        charts.append(Chart("Gyro by temperature", "Temperature [deg C]", "Rate [rad/s]", tuple(series)))
    return charts

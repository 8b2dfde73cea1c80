"""Plots over time: inertial and other signals, motion, biases, sigmas, errors, residuals."""

from __future__ import annotations

from dataclasses import MISSING
from typing import NamedTuple

import numpy as np
import rerun as rr

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.evaluation import Evaluation
from smartnav_graph.factors import title_of
from smartnav_graph.graph.solution import ACCEL_BIAS, GYRO_BIAS, POS, Residuals, Solution
from smartnav_graph.output.rerun_log import colours
from smartnav_graph.output.rerun_log.events import stops
from smartnav_graph.output.rerun_log.recorder import Recorder, readable
from smartnav_graph.session.session import Session

# Units of columns by the ends of their names.
UNITS = {"_rad_s": "rad/s", "_m_s2": "m/s²", "_m_s": "m/s", "_ut": "µT", "_hpa": "hPa", "_c": "°C"}
MARKER_SIZE = 2.0
AXES = ("x", "y", "z", "east", "north", "up")
MANY = 500
# Rows of a signal beyond which the viewer is given the lowest and highest reading of each stretch alone.
MOST_ROWS = 400_000
EVALUATION_FIELDS = ("t_ns", "error_enu_m", "sigma_enu", "rotation_error_deg")


class Signal(NamedTuple):
    """One quantity of a sampled stream: entity, title with unit, times (n,) ns, values (n,) or (n, 3)."""

    path: str
    title: str
    t_ns: Times
    values: Floats


def signals_of(session: Session) -> list[Signal]:
    """The sampled quantities of a session, in body axes and the units of their columns."""
    found = []
    for name, stream in session.streams().items():
        quantities = [f for f in stream.specs() if f.default is MISSING and f.metadata["kind"] == "float"]
        if stream.ABSOLUTE or not stream.UNIQUE_TIMES or name == "reference":
            continue
        for quantity in quantities:
            several = len(quantities) > 1
            column = quantity.metadata["columns"][0]
            unit = next((text for suffix, text in UNITS.items() if column.endswith(suffix)), "")
            title = f"{title_of(name)}{f' {quantity.name}' if several else ''} {unit}".strip()
            path = f"/{name}/{quantity.name}" if several else f"/{name}"
            found.append(Signal(path, title, stream.t_ns, getattr(stream, quantity.name)))
    return found


def lowest_and_highest(signal: Signal, most: int = MOST_ROWS) -> Signal:
    """At most `most` rows of a signal: the first, the last, and the lowest and highest of each axis in each of many
    stretches of equal numbers of rows, so that spikes remain."""
    n, table = len(signal.t_ns), signal.values.reshape(len(signal.t_ns), -1)
    if n <= most:
        return signal
    size = -(-n // (most // (2 * table.shape[1]) - 2))
    whole = np.pad(np.nan_to_num(table), ((0, -n % size), (0, 0)), mode="edge")  # the last row fills its stretch
    blocks = whole.reshape(-1, size, table.shape[1])
    first = np.arange(len(blocks))[:, None] * size
    extremes = [first + find(blocks, axis=1) for find in (np.argmin, np.argmax)]
    kept = np.unique(np.concatenate([[0, n - 1], *(rows.ravel() for rows in extremes)]))
    return signal._replace(t_ns=signal.t_ns[kept], values=signal.values[kept])


def log_sensors(recorder: Recorder, session: Session, end_ns: int) -> list[str]:
    """The raw signals; a note on those that are thinned."""
    signals = signals_of(session)
    long = [signal.path.removeprefix("/") for signal in signals if len(signal.t_ns) > MOST_ROWS]
    for signal in map(lowest_and_highest, signals):
        names = ["x", "y", "z"] if signal.values.ndim == 2 else [signal.path.removeprefix("/")]
        _log_lines(recorder, signal.path, signal.t_ns, signal.values, names)
        recorder.clear(signal.path, stops(signal.t_ns, end_ns))
    note = f"{', '.join(long)}: the lowest and highest reading of each stretch, every row is in the session"
    return [note + " (of the inertial data also in imu.parquet of the run)"] if long else []


def _log_lines(recorder: Recorder, path: str, t_ns: Times, values: Floats, names: list[str]) -> None:
    recorder.rows(path, t_ns, rr.Scalars.columns(scalars=values))
    recorder.style(path, rr.SeriesLines(colors=colours.of_axes(len(names)), names=names, widths=[1.0] * len(names)))


def log_bands(
    recorder: Recorder,
    path: str,
    t_ns: Times,
    values: Floats,
    sigmas: Floats,
    names: list[str],
    unit: str,
    colors: list[list[int]] | None = None,
) -> None:
    """Lines with bands of one sigma, values and sigmas (n, k), at `path`/<name> (at `path` itself where k is 1), and
    below it at ``three_sigma`` with bands of three."""
    colors = colors or colours.of_axes(len(names))
    for k, name in enumerate(names):
        here = axis_path(path, name, len(names))
        value, sigma = values[:, k : k + 1], sigmas[:, k : k + 1]
        for where, times in ((here, 1.0), (f"{here}/three_sigma", 3.0)):
            recorder.rows(where, t_ns, rr.Measurements.columns(values=value, variances=(times * sigma) ** 2))
            width = 1.5 if times == 1.0 else 0.0
            style = rr.Measurements.from_fields(names=[name], units=[unit], colors=[colors[k]], widths=[width])
            recorder.style(where, style)
        if len(names) > 1:
            recorder.widen(here, value - 3.0 * sigma, value + 3.0 * sigma)
    recorder.widen(path, values - 3.0 * sigmas, values + 3.0 * sigmas)


def axis_path(path: str, name: str, count: int) -> str:
    """Entity of one of `count` lines with bands."""
    return f"{path}/{name}" if count > 1 else path


def log_biases(recorder: Recorder, solution: Solution, evaluation: Evaluation | None) -> None:
    """Biases with their bands, sigmas, and with a reference the error with its bands."""
    sigma, t = solution.sigmas, solution.t_ns
    axes = ["x", "y", "z"]
    log_bands(recorder, "/bias/accel", t, solution.accel_bias, sigma[:, ACCEL_BIAS], axes, "m/s²")
    log_bands(recorder, "/bias/gyro", t, solution.gyro_bias, sigma[:, GYRO_BIAS], axes, "rad/s")
    _log_lines(recorder, "/sigma/position", t, sigma[:, POS], ["east", "north", "up"])
    _log_lines(recorder, "/sigma/heading", t, solution.sigma_heading_deg[:, None], ["heading"])
    recorder.limits["/sigma/position"] = readable(0.0, float(np.nanmax(sigma[:, POS], initial=1e-3)))
    recorder.limits["/sigma/heading"] = readable(0.0, float(np.nanmax(solution.sigma_heading_deg, initial=1e-3)))
    if evaluation is not None:
        _log_error(recorder, evaluation)


def log_motion(recorder: Recorder, solution: Solution) -> None:
    """Speed, height, heading, pitch and roll."""
    t, angles = solution.t_ns, solution.heading_pitch_roll_deg
    speed = np.linalg.norm(solution.nav_v_body, axis=1)[:, None]
    _log_lines(recorder, "/motion/speed", t, speed, ["speed"])
    _log_lines(recorder, "/motion/height", t, solution.nav_t_body[:, 2:], ["up"])
    _log_lines(recorder, "/motion/attitude/tilt", t, angles[:, 1:], ["pitch", "roll"])
    # points: a line would cross the whole plot where the heading passes north
    recorder.rows("/motion/attitude/heading", t, rr.Scalars.columns(scalars=angles[:, :1]))
    style = rr.SeriesPoints(colors=colours.AXES[2], names="heading", markers="circle", marker_sizes=1.5)
    recorder.style("/motion/attitude/heading", style)


def _log_error(recorder: Recorder, evaluation: Evaluation) -> None:
    t, names = evaluation.t_ns, ["east", "north", "up"]
    log_bands(recorder, "/error/position", t, evaluation.error_enu_m, evaluation.sigma_enu, names, "m")
    rotation = evaluation.rotation_error_deg
    if rotation is not None:
        known = np.isfinite(rotation)
        _log_lines(recorder, "/error/rotation", t[known], rotation[known, None], ["rotation"])


class Marks(NamedTuple):
    """Style of points: names and colours of the axes, shape and size of all."""

    names: list[str]
    colors: list[list[int]]
    shape: str
    size: float

    def of(self, axis: int) -> Marks:
        """The style of one axis."""
        return self._replace(names=self.names[axis : axis + 1], colors=self.colors[axis : axis + 1])


def residual_rows(residuals: Residuals, sensor: str, used: bool) -> tuple[Times, Floats]:
    """Times (n,) and whitened residuals (n, axes) of one sensor; NaN where an axis has none.

    Several residuals of one axis at one time (many matches of an image pair) become rows with the same time.
    """
    chosen = residuals.of(sensor)
    width = int(residuals.axis[chosen].max()) + 1
    rows = np.flatnonzero(chosen & (residuals.used == used))
    if not len(rows):
        return np.zeros(0, dtype=np.int64), np.zeros((0, width))
    order = rows[np.lexsort((residuals.axis[rows], residuals.t_ns[rows]))]
    t, axis = residuals.t_ns[order], residuals.axis[order]
    new = np.concatenate([[True], (np.diff(t) != 0) | (np.diff(axis) != 0)])
    place = np.arange(len(order))
    repeat = place - np.maximum.accumulate(np.where(new, place, 0))
    keys, row = np.unique(np.stack([t, repeat], axis=1), axis=0, return_inverse=True)
    table = np.full((len(keys), width), np.nan)
    table[row.ravel(), axis] = residuals.whitened[order]
    return keys[:, 0], table


def log_residuals(recorder: Recorder, residuals: Residuals) -> None:
    """Whitened residuals by sensor: /residuals/<sensor>, and those not used at /residuals/<sensor>/rejected."""
    for sensor in residuals.sensors():
        path = f"/residuals/{sensor}"
        used, rejected = (residual_rows(residuals, sensor, kind) for kind in (True, False))
        width = used[1].shape[1]
        names = [axis_name(k, width) for k in range(width)]
        _log_axes(recorder, path, *used, Marks(names, colours.of_axes(width), "circle", MARKER_SIZE))
        # crosses, small ones where many would cover the rest
        size = (2.5 if len(rejected[0]) < MANY else 1.2) * MARKER_SIZE
        crosses = Marks(["rejected ×"] * width, [colours.REJECTED] * width, "cross", size)
        _log_axes(recorder, f"{path}/rejected", *rejected, crosses)
        if len(rejected[0]):
            limit = _limit(np.abs(used[1]), np.abs(rejected[1]))
            recorder.limits[path] = readable(-limit, limit)


def _limit(used: Floats, rejected: Floats) -> float:
    """The range of a plot of residuals: used ones must be visible beside large rejected ones."""
    inside = float(np.nanpercentile(used, 99.9)) if np.isfinite(used).any() else 3.0
    return max(1.2 * inside, min(1.1 * float(np.nanpercentile(rejected, 75)), 5.0 * inside))


def _log_axes(
    recorder: Recorder,
    path: str,
    t_ns: Times,
    values: Floats,
    marks: Marks,
) -> None:
    """Points of all axes in one entity, or one entity an axis where rows differ in their axes: recordings with NaN
    never compare equal."""
    there = np.isfinite(values)
    if there.all():
        _log_points(recorder, path, t_ns, values, marks)
        return
    for k, mask in enumerate(there.T):
        _log_points(recorder, f"{path}/{k}", t_ns[mask], values[mask, k : k + 1], marks.of(k))


def _log_points(recorder: Recorder, path: str, t_ns: Times, values: Floats, marks: Marks) -> None:
    recorder.rows(path, t_ns, rr.Scalars.columns(scalars=values))
    if len(t_ns):
        shapes, sizes = [marks.shape] * len(marks.names), [marks.size] * len(marks.names)
        style = rr.SeriesPoints(colors=marks.colors, names=marks.names, markers=shapes, marker_sizes=sizes)
        recorder.style(path, style)


def axis_name(axis: int, width: int) -> str:
    """East, north, up of a position; the axis number of anything else."""
    return ("east", "north", "up")[axis] if width == 3 else f"axis {axis}" if width > 1 else "residual"

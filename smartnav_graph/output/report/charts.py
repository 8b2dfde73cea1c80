"""Figures over time, histograms and distributions of one run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from html import escape
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.frames import ELLIPSOIDAL, LOCAL_HEIGHTS
from smartnav_graph.estimate.both_ways import BothWays
from smartnav_graph.evaluation import Evaluation
from smartnav_graph.factors import title_of
from smartnav_graph.graph.solution import ACCEL_BIAS, GYRO_BIAS, POS, Solution
from smartnav_graph.output.report.svg import Axis, Plot, axis, exact_axis, finite_values, legend, spread_axis, time_axis
from smartnav_graph.output.report.thin import thin_dots
from smartnav_graph.output.text import count, fixed, metres, number

Intervals = Sequence[tuple[float, float]]

AXES = ("East", "North", "Up")


class Scored(Protocol):
    """Errors at the withheld rows of one sensor: `t_ns` (n,) and `error` (n, 3) m, nav axes."""

    @property
    def t_ns(self) -> Times:
        """Stamps (n,) ns."""

    @property
    def error(self) -> Floats:
        """Errors (n, 3) m, east, north, up."""


MOST_FAR = 6.0  # whitened residuals beyond are drawn at the edge and counted
RESIDUAL_AXIS = Axis(-MOST_FAR, MOST_FAR, (-6.0, -3.0, 0.0, 3.0, 6.0), ("−6", "−3", "0", "3", "6"))


def figure(plots: Sequence[Plot], entries: Sequence[tuple[str, str]] = (), note: str = "") -> str:
    """Plots one below the other with one legend; the lowest names the shared x axis."""
    for plot in plots[:-1]:
        plot.x_title = ""
    caption = f"<figcaption>{escape(note)}</figcaption>" if note else ""
    return f"<figure>{legend(entries)}{''.join(p.render() for p in plots)}{caption}</figure>"


def grid(figures: Sequence[str]) -> str:
    """Small figures side by side on a wide page."""
    return f'<div class="grid">{"".join(figures)}</div>'


def time_of(solution: Solution) -> Axis:
    """The time axis of a solution."""
    t = solution.seconds
    return time_axis(float(t[0]), float(t[-1]))


def over_time(solution: Solution, y: Axis, title: str, gaps: Intervals, height: int = 190) -> Plot:
    """An empty plot over the time of a run, its IMU data gaps shaded."""
    plot = Plot(time_of(solution), y, f"{title} over time", title, height_px=height)
    plot.spans(gaps)
    return plot


def shaded(gaps: Intervals) -> list[tuple[str, str]]:
    """The legend of the IMU data gaps; empty without gaps."""
    return [("gap", "IMU data gap")] if gaps else []


def uncertainty(solution: Solution, gaps: Intervals, causal: Solution | None) -> str:
    """One-sigma position and heading."""
    t, sigma = solution.seconds, solution.sigmas[:, POS]
    extra = [] if causal is None else [finite_values(causal.sigmas[:, POS][:, :2])]
    position = over_time(
        solution, spread_axis(np.concatenate([finite_values(sigma), *extra])), "Position, 1 sigma [m]", gaps
    )
    if causal is not None:
        horizontal = np.linalg.norm(causal.sigmas[:, POS][:, :2], axis=1)
        position.line(causal.seconds, horizontal, "causal")
    for i in range(3):
        position.line(t, sigma[:, i], f"s{i}")
    heading = over_time(solution, spread_axis(solution.sigma_heading_deg), "Heading, 1 sigma [°]", gaps, 150)
    heading.line(t, solution.sigma_heading_deg, "s3")
    entries = [(f"line s{i}", name) for i, name in enumerate(AXES)] + [("line s3", "Heading")]
    entries += [("line causal", "Horizontal, causal")] if causal is not None else []
    return figure([position, heading], entries + shaded(gaps))


def motion(solution: Solution, gaps: Intervals) -> str:
    """Speed and height."""
    t, speed = solution.seconds, np.linalg.norm(solution.nav_v_body, axis=1)
    fast = over_time(solution, axis(speed, include=(0.0,), least=0.1), "Speed [m/s]", gaps)
    fast.line(t, speed, "s0")
    known = solution.origin is not None
    height = solution.trajectory_columns()["height_m"] if known else solution.nav_t_body[:, 2]
    above = solution.heights if known else LOCAL_HEIGHTS
    title = f"Height {'above the ellipsoid' if above == ELLIPSOIDAL else above} [m]"
    sigma = solution.sigmas[:, POS][:, 2]
    band = core(np.concatenate([height - sigma, height + sigma]))
    whole = np.ptp(band) < 10 * max(float(np.ptp(height)), 1.0) if len(band) else False
    high = over_time(solution, axis(np.concatenate([height, band]) if whole else height, least=0.5), title, gaps)
    high.band(t, height - sigma, height + sigma, "s0")
    high.line(t, height, "s0")
    return figure([fast, high], [("line s0", "Estimate"), ("band s0", "± 1 sigma"), *shaded(gaps)])


def attitude(solution: Solution, gaps: Intervals) -> str:
    """Heading, pitch and roll."""
    t, hpr = solution.seconds, solution.heading_pitch_roll_deg
    along = np.degrees(np.unwrap(np.radians(hpr[:, 0])))
    narrow = float(np.ptp(along)) < NARROW_DEG
    heading = over_time(solution, _compass(along) if narrow else COMPASS, "Heading, clockwise from north [°]", gaps)
    if narrow:
        heading.line(t, along, "s0")
    else:
        heading.line(*_unwrapped(t, hpr[:, 0]), "s0")
    tilt = over_time(solution, axis(hpr[:, 1:], least=2.0), "Pitch and roll [°]", gaps)
    tilt.line(*_unwrapped(t, hpr[:, 1]), "s1")
    tilt.line(*_unwrapped(t, hpr[:, 2]), "s2")
    entries = [("line s0", "Heading"), ("line s1", "Pitch, nose up"), ("line s2", "Roll, right side down")]
    return figure([heading, tilt], entries + shaded(gaps))


COMPASS = Axis(0.0, 360.0, (0.0, 90.0, 180.0, 270.0, 360.0), ("0", "90", "180", "270", "360"))
NARROW_DEG = 150.0  # headings that turn less are drawn without a break at north


def _compass(along: Floats) -> Axis:
    """An axis of headings that may run through north."""
    plain = axis(along, least=4.0)
    whole = 0 if plain.ticks[1] - plain.ticks[0] >= 1 else 1
    return replace(plain, labels=tuple(fixed(tick % 360.0, whole) for tick in plain.ticks))


def _unwrapped(t: Floats, angle: Floats) -> tuple[Floats, Floats]:
    """The same line with a break where the angle jumps through its limit."""
    jumps = np.flatnonzero(np.abs(np.diff(angle)) > 180.0) + 1
    return np.insert(t, jumps, t[jumps]), np.insert(angle, jumps, np.nan)


def biases(solution: Solution, gaps: Intervals) -> str:
    """Accelerometer and gyroscope biases with bands of one and three sigma."""
    t, sigma = solution.seconds, solution.sigmas
    sensors = (
        ("Accelerometer", "m/s²", solution.accel_bias, sigma[:, ACCEL_BIAS]),
        ("Gyroscope", "°/s", np.degrees(solution.gyro_bias), np.degrees(sigma[:, GYRO_BIAS])),
    )
    figures = []
    for name, unit, bias, spread in sensors:
        low, high = bias - 3 * spread, bias + 3 * spread
        for i, letter in enumerate("xyz"):
            y = axis(core(np.stack([low[:, i], high[:, i]])), count=5)
            plot = Plot(time_axis(float(t[0]), float(t[-1]), 4), y, f"{name} bias {letter} over time", height_px=140)
            plot.y_title = f"{name} {letter} [{unit}]"
            plot.spans(gaps)
            plot.band(t, low[:, i], high[:, i], "s0 wide")
            plot.band(t, bias[:, i] - spread[:, i], bias[:, i] + spread[:, i], "s0")
            plot.line(t, bias[:, i], "s0")
            figures.append(figure([plot]))
    marks = [("line s0", "Bias"), ("band s0", "± 1 sigma"), ("band s0 wide", "± 3 sigma"), *shaded(gaps)]
    note = '<p class="fine">In body axes. Wide bands of the first seconds are cut at the frame.</p>'
    return legend(marks) + grid(figures) + note


def core(values: Floats, percent: float = 1.0) -> Floats:
    """The range of a y axis: without the most extreme `percent` % on either side."""
    v = finite_values(values)
    return np.percentile(v, [percent, 100 - percent]) if len(v) else v


def residual_histograms(solution: Solution) -> str:
    """Whitened residuals that were used, against the standard normal density."""
    r = solution.residuals
    figures = []
    for sensor in solution.residuals.sensors():
        white = finite_values(r.whitened[r.of(sensor) & r.used])
        if len(white):
            figures.append(_histogram(sensor, white))
    note = [("bars s4", "Residuals over their sigma"), ("line ink", "Standard normal")]
    return legend(note) + grid(figures)


def _histogram(sensor: str, white: Floats) -> str:
    bins = 40 if len(white) >= 400 else 20
    density, edges = np.histogram(white, bins=bins, range=(-5.0, 5.0))
    density = density / (len(white) * (edges[1] - edges[0]))
    at = np.linspace(-5.0, 5.0, 101)
    normal = np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi)
    y = axis([float(density.max(initial=0.0)), float(normal.max())], include=(0.0,), count=4)
    plot = Plot(exact_axis(-5.0, 5.0, step=1.0), y, f"Histogram of {sensor} residuals", height_px=150)
    plot.y_title, plot.x_title = f"{title_of(sensor)}, density", "Residual / sigma"
    plot.bars(edges, density, "s4")
    plot.line(at, normal, "ink")
    far = int((np.abs(white) > 5.0).sum())
    outside = f", {count(far)} beyond ± 5" if far else ""
    return figure([plot], note=f"{count(len(white))} values, RMS {number(np.sqrt(np.mean(white**2)))}{outside}")


def residuals_over_time(solution: Solution, gaps: Intervals) -> str:
    """Whitened residuals of each sensor over time, rejected ones marked."""
    plots, far, rejected = list[Plot](), list[str](), False
    for sensor in solution.residuals.sensors():
        plots.append(_residual_plot(solution, sensor, gaps))
        r = solution.residuals
        rows = r.of(sensor) & np.isfinite(r.whitened)
        rejected |= bool((rows & ~r.used).any())
        n = int((np.abs(r.whitened[rows]) > MOST_FAR).sum())
        far += [f"{title_of(sensor)} {count(n)}"] if n else []
    note = f"Beyond ± {fixed(MOST_FAR, 0)} sigma, drawn at the edge: {', '.join(far)}." if far else ""
    entries = [("dots res", "Used"), *([("dots out", "Rejected")] if rejected else []), ("line limit", "± 3 sigma")]
    return figure(plots, [*entries, *shaded(gaps)], note)


def _residual_plot(solution: Solution, sensor: str, gaps: Intervals) -> Plot:
    r = solution.residuals
    seconds = (r.t_ns - solution.t0_ns) / 1e9
    plot = Plot(time_of(solution), RESIDUAL_AXIS, f"{sensor} residuals over time")
    plot.height_px, plot.y_title = 110, f"{title_of(sensor)}, residual / sigma"
    plot.spans(gaps)
    for level in (-3.0, 3.0):
        plot.rule(level, "limit")
    few = " few" if int(r.of(sensor).sum()) < 400 else ""
    for used, cls in ((False, "out"), (True, f"res{few}")):
        rows = r.of(sensor) & (r.used == used) & np.isfinite(r.whitened)
        y = np.clip(r.whitened[rows], -MOST_FAR * 0.97, MOST_FAR * 0.97)
        shown = thin_dots(np.abs(y) > 3.0, 1500)
        plot.dots(seconds[rows][shown], y[shown], cls)
    return plot


def distribution(errors: ArrayLike, what: str) -> str:
    """Cumulative distribution of horizontal errors in metres, with 50, 67 and 95 % marked."""
    e = np.sort(finite_values(errors))
    if len(e) < 2:
        return ""
    share = 100 * np.arange(len(e)) / (len(e) - 1)  # as the percentiles count
    x = exact_axis(0.0, max(float(np.percentile(e, 99)) * 1.1, 1e-4), count=6)
    y = Axis(0.0, 100.0, (0.0, 25.0, 50.0, 75.0, 100.0), ("0", "25", "50", "75", "100"))
    plot = Plot(x, y, f"Cumulative distribution of {what}", "Share of epochs [%]", height_px=240)
    plot.x_title = "Horizontal error [m]"
    plot.line(e, share, "s0")
    for p in (50, 67, 95):
        at = float(np.percentile(e, p))
        plot.line([at, at], [0, p], "limit", thin=False)
        plot.dots([at], [p], "pick")
        right = float(x.fraction(at)) < 0.7
        plot.text(
            at,
            p,
            f"{p} %: {metres(at)}",
            f"note {'' if right else 'end'}",
            dx=9 if right else -9,
            dy=15 if right else -7,
        )
    return figure([plot], note=f"{count(len(e))} {what}.")


def withheld(name: str, scored: Scored, solution: Solution, gaps: Intervals) -> str:
    """Horizontal errors at withheld measurements: their distribution, and over time beside the estimated sigma."""
    horizontal = np.linalg.norm(np.asarray(scored.error, dtype=np.float64)[:, :2], axis=1)
    picture = distribution(horizontal, f"withheld measurements ({title_of(name)})")
    if len(solution) < 2 or not len(finite_values(horizontal)):
        return picture
    sigma = np.linalg.norm(solution.sigmas[:, POS][:, :2], axis=1)
    y = axis(np.concatenate([horizontal, finite_values(sigma)]), include=(0.0,))
    plot = over_time(solution, y, "Horizontal error [m]", gaps)
    plot.line(solution.seconds, sigma, "s3")
    plot.dots((np.asarray(scored.t_ns) - solution.t0_ns) / 1e9, horizontal, "withheld")
    marks = [("dots withheld", "Withheld measurement"), ("line s3", "1 sigma of the solution"), *shaded(gaps)]
    return picture + figure([plot], marks)


def forward_backward(ways: BothWays, solution: Solution, gaps: Intervals) -> str:
    """Difference of the filter forward and backward in time, with two sigmas of it."""
    t = (ways.t_ns - solution.t0_ns) / 1e9
    inside = np.abs(ways.difference) <= 2.0 * ways.sigma
    largest = max(float(np.percentile(np.abs(ways.difference), 99)), 3.0 * float(np.median(ways.sigma)))
    plots, limits = [], axis([-largest, largest], count=4)
    for i, name in enumerate(AXES):
        plot = over_time(solution, limits, f"{name}, forward less backward [m]", gaps, 130)
        plot.band(t, -2.0 * ways.sigma[:, i], 2.0 * ways.sigma[:, i], f"s{i}")
        plot.line(t, ways.difference[:, i], f"s{i} solid")
        plots.append(plot)
    rms = np.sqrt((ways.difference**2).mean(axis=0))
    text = (
        "The filter with all measurements, forward in time less backward in time. Both are causal: at an epoch they "
        f"have only its own measurements in common. RMS east {metres(rms[0])}, north {metres(rms[1])}, up "
        f"{metres(rms[2])}; {number(100.0 * float(inside.mean()))} % inside two sigma (expected 95 %). Sigmas are "
        "large at the ends, where one of the two has just begun."
    )
    entries = [*((f"line s{i} solid", name) for i, name in enumerate(AXES)), ("band s0", "± 2 sigma of the difference")]
    return f"<p>{escape(text)}</p>" + figure(plots, [*entries, *shaded(gaps)])


def errors_over_time(evaluation: Evaluation, solution: Solution, gaps: Intervals) -> str:
    """Errors against the reference in east, north, up with the band of one sigma; and the rotation error."""
    error, sigma = evaluation.error_enu_m, evaluation.sigma_enu
    t = (evaluation.t_ns - solution.t0_ns) / 1e9
    limit = axis(error, include=(0.0,), count=4)
    plots = []
    for i, name in enumerate(AXES):
        plot = over_time(solution, limit, f"{name} error [m]", gaps, 130)
        plot.band(t, -sigma[:, i], sigma[:, i], f"s{i}")
        plot.line(t, error[:, i], f"s{i} solid")
        plots.append(plot)
    rotation = evaluation.rotation_error_deg
    if rotation is not None and len(finite_values(rotation)):
        plot = over_time(solution, axis(rotation, include=(0.0,), count=4), "Rotation error [°]", gaps, 130)
        plot.line(t, rotation, "s3")
        plots.append(plot)
    entries = [(f"line s{i} solid", f"{name} error") for i, name in enumerate(AXES)]
    return figure(plots, [*entries, ("band s0", "± 1 sigma, as estimated"), *shaded(gaps)])

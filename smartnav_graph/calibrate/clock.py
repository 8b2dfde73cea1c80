"""Clocks of a recording: the rate at which samples come, jitter of their stamps, and one clock against another.

Stamps of samples lie on a line over their number (lost samples counted); the scatter about it is jitter. Where fixes
carry both their own time and that at which they became known (`arrival_ns`), the line of arrivals over times of fixes
has offset and drift of the clock that stamps arrivals; the mean delay of the receiver is in the offset. The 2012 thesis
has such pairs of processor time and UTC in its Sync file. Lines are fitted without delays beyond `FAR` times the
scatter; sigmas are those of coloured noise (`regression`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smartnav_graph.calibrate.regression import regress
from smartnav_graph.calibrate.result import CalibrationResult, Chart, Series
from smartnav_graph.calibrate.static import one_session
from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.session.session import Session

FAR = 5.0  # standard deviations, by the median
LEAST_PAIRS = 60
ROUNDS = 5


@dataclass(frozen=True)
class ClockOptions:
    """Clocks: rate and jitter of the samples; offset and drift between the clock of fixes and that of their arrival."""

    claimed_hz: float | None = None
    """Rate that the device claims for its inertial samples."""


@dataclass(frozen=True)
class Line:
    """y = middle + slope (x - mean x) with sigmas; residuals (n,) s of the rows kept, and how many were left out."""

    slope: Value
    middle: Value
    residuals: Floats
    kept_x: Floats
    left_out: int


def robust_line(x: Floats, y: Floats, unit: str) -> Line:
    """A line through points (n,) of which some are far off."""
    kept = np.ones(len(x), dtype=bool)
    for _ in range(ROUNDS):
        slope, middle = np.polyfit(x[kept], y[kept], 1)
        left = y - (slope * x + middle)
        centre = np.median(left[kept])
        scatter = 1.4826 * float(np.median(np.abs(left[kept] - centre)))
        kept = np.abs(left - centre) <= FAR * max(scatter, 1e-9)
    step = float(np.median(np.diff(x)))
    fitted = regress([y[kept]], [x[kept, None] - x[kept].mean()], step)
    value = Value(float(fitted.slopes[0]), float(fitted.sigmas[0]), unit)
    middle = Value(float(fitted.means[0]), float(fitted.mean_sigmas[0]), "s")
    return Line(value, middle, fitted.residuals[0], x[kept], int((~kept).sum()))


def sample_numbers(t_ns: Times) -> Floats:
    """Number (n,) of each sample, lost ones counted."""
    steps = np.diff(t_ns)
    return np.concatenate([[0.0], np.cumsum(np.maximum(np.round(steps / np.median(steps)), 1.0))])


def fit(sources: Sequence[Session], options: ClockOptions) -> CalibrationResult:
    """Rate and jitter of the inertial samples of one recording, offset and drift of the arrivals of fixes.

    Raises
    ------
    CalibrationError
        Fewer than 60 inertial samples.
    """
    session = one_session(sources)
    imu, values, refused, warnings = session.require_imu(), {}, {}, []
    if len(imu) < LEAST_PAIRS:
        found = f"{len(imu)} inertial samples"
        raise CalibrationError(str(session.path or "session"), found, f"at least {LEAST_PAIRS}", "record longer")
    numbers, seconds = sample_numbers(imu.t_ns), (imu.t_ns - imu.t_ns[0]) / NS
    nominal = seconds[-1] / numbers[-1]
    line = robust_line(numbers, seconds - nominal * numbers, "s")
    interval = nominal + line.slope.value
    values["imu_rate"] = Value(1 / interval, line.slope.sigma / interval**2, "Hz")
    values["imu_jitter"] = Value(float(line.residuals.std()), np.nan, "s")
    values["imu_samples_lost"] = Value(float(numbers[-1] + 1 - len(imu)), 0.0, "1")
    charts = [_chart("Stamps of the inertial samples less an even clock", "Sample", line)]
    residuals = {"imu": Residual(float(line.residuals.std()), len(line.residuals), "s")}
    if options.claimed_hz is not None:
        share = values["imu_rate"].value / options.claimed_hz - 1
        values["imu_rate_error"] = Value(share, values["imu_rate"].sigma / options.claimed_hz, "1")
        if abs(share) > 0.01:
            warnings.append(f"imu: {100 * share:+.2f} % against the claimed rate; check the stamps of the log")
    if line.left_out:
        warnings.append(f"imu: {line.left_out} stamps are far from an even clock; --repair stamps rebuilds them")
    fixes = session.gnss
    if fixes is None or fixes.arrival_ns is None or len(fixes) < LEAST_PAIRS:
        refused["clock_drift"] = f"fewer than {LEAST_PAIRS} fixes with arrival_ns; record both clocks for minutes"
        return CalibrationResult(values, residuals, refused, tuple(warnings), charts=tuple(charts))
    known = (fixes.t_ns - fixes.t_ns[0]) / NS
    pairs = robust_line(known, (fixes.arrival_ns - fixes.t_ns) / NS, "s/s")
    values["clock_drift"], values["clock_offset"] = pairs.slope, pairs.middle
    values["clock_pairs_left_out"] = Value(float(pairs.left_out), 0.0, "1")
    residuals["clock"] = Residual(float(pairs.residuals.std()), len(pairs.residuals), "s")
    charts.append(_chart("Arrival less time of the fixes, about a line", "Time of the fix [s]", pairs))
    return CalibrationResult(values, residuals, refused, tuple(warnings), charts=tuple(charts))


def _chart(title: str, x_title: str, line: Line) -> Chart:
    shown = slice(None, None, max(len(line.residuals) // 4000, 1))
    dots = Series("residual", line.kept_x[shown], 1e3 * line.residuals[shown], "dots", 0)
    return Chart(title, x_title, "Difference [ms]", (dots,))

"""Figures by matplotlib (the extra ``plot``): a path, time series with bands of two sigmas. Arrays only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.errors import SmartnavError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    AxesList = list[Axes]

WIDTH_IN, PANEL_IN, PATH_IN = 8.0, 1.9, 4.5
BAND_SIGMAS = 2.0


@dataclass(frozen=True)
class Path:
    """Labels of both axes, and coordinates (n,) each."""

    x_label: str
    y_label: str
    x: Floats
    y: Floats


@dataclass(frozen=True)
class Panel:
    """A time series: label, values (n,), sigma (n,) of the band around the values, or around zero for errors."""

    label: str
    values: Floats
    sigma: Floats | None = None
    around_zero: bool = False


def figure_of(heights_in: Sequence[float]) -> AxesList:
    """Axes of a new figure, one above the other.

    Raises
    ------
    SmartnavError
        matplotlib is not installed.
    """
    try:
        from matplotlib import pyplot
    except ImportError as error:
        remedy = "pip install 'smartnav-graph[plot]'"
        raise SmartnavError("plot", f"matplotlib cannot be imported ({error})", "matplotlib 3.9", remedy) from error
    _, grid = pyplot.subplots(
        *(len(heights_in), 1),
        figsize=(WIDTH_IN, sum(heights_in)),
        height_ratios=list(heights_in),
        squeeze=False,
        layout="constrained",
    )
    return list(grid[:, 0])


def path_and_series(path: Path | None, seconds: Floats, panels: Sequence[Panel]) -> AxesList:
    """A path in equal scales, if any, above time series (n,) over seconds (n,) with a common time axis."""
    axes = figure_of([*([PATH_IN] if path is not None else []), *(PANEL_IN for _ in panels)])
    series = axes[-len(panels) :]
    if path is not None:
        axes[0].plot(path.x, path.y, lw=1.2)
        axes[0].plot(path.x[:1], path.y[:1], "o", ms=5, label="start")
        axes[0].set(xlabel=path.x_label, ylabel=path.y_label, aspect="equal", adjustable="datalim")
        axes[0].legend(frameon=False)
    for axis, panel in zip(series, panels, strict=True):
        axis.plot(seconds, panel.values, lw=1.0)
        if panel.sigma is not None:
            middle = 0.0 if panel.around_zero else panel.values
            half = BAND_SIGMAS * panel.sigma
            axis.fill_between(seconds, middle - half, middle + half, alpha=0.25, lw=0, label=f"±{BAND_SIGMAS:g} sigma")
            axis.legend(frameon=False, loc="upper right")
        _time_axis(axis, series[0], panel.label, last=axis is series[-1])
    return axes


def scatter_rows(rows: Sequence[tuple[str, Floats, Floats, Mask]]) -> AxesList:
    """Whitened residuals: label, seconds (m,), residuals (m,), which are used (m,), a panel each, lines at 2 sigma."""
    axes = figure_of([PANEL_IN] * len(rows))
    for axis, (label, seconds, values, used) in zip(axes, rows, strict=True):
        axis.plot(seconds[used], values[used], ".", ms=3)
        if not used.all():
            axis.plot(seconds[~used], values[~used], "x", ms=4, label="rejected", color="tab:red")
            axis.legend(frameon=False, loc="upper right")
        for level in (-BAND_SIGMAS, BAND_SIGMAS):
            axis.axhline(level, lw=0.8, ls="--", color="grey")
        largest = float(np.abs(values[used]).max()) if used.any() else 1.0
        axis.set_ylim(-1.1 * max(largest, 3.0), 1.1 * max(largest, 3.0))  # rejected rows may lie far outside
        _time_axis(axis, axes[0], f"{label}\nin sigmas", last=axis is axes[-1])
    return axes


def _time_axis(axis: Axes, first: Axes, label: str, *, last: bool) -> None:
    if axis is not first:
        axis.sharex(first)
    axis.set_ylabel(label)
    axis.grid(alpha=0.3)
    axis.tick_params(labelbottom=last)
    if last:
        axis.set_xlabel("time, s")

"""A small SVG plot: axes with round ticks, lines, bands, dots, bars. No fixed colours, no address.

Geometry lives in a nested ``<svg viewBox>`` that stretches with the page; tick labels are placed in per cent of the
same box, so that text keeps its size on a phone, on a screen and on paper. Colours come from CSS classes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.output.report.thin import thin_band, thin_line
from smartnav_graph.output.text import fixed

UNITS = 10000
LONGEST = 7
TIME_STEPS = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 14400, 43200, 86400)


@dataclass(frozen=True)
class Axis:
    """Range `lo` .. `hi` in data units with labelled ticks; labels show the value minus `offset`."""

    lo: float
    hi: float
    ticks: tuple[float, ...]
    labels: tuple[str, ...]
    log: bool = False
    offset: float = 0.0
    of_time: bool = False

    def titled(self, title: str) -> str:
        """The title of the axis, with the offset of its labels."""
        return f"{title}, minus {fixed(self.offset, 3).rstrip('0').rstrip('.')}" if self.offset and title else title

    def fraction(self, values: ArrayLike) -> Floats:
        """Position of `values` along the axis, 0 at `lo`, 1 at `hi`."""
        v = np.asarray(values, dtype=np.float64)
        if self.log:
            lo, hi = math.log10(self.lo), math.log10(self.hi)
            return np.asarray((np.log10(np.maximum(v, self.lo / 10)) - lo) / (hi - lo))
        return np.asarray((v - self.lo) / (self.hi - self.lo))


def finite_values(values: ArrayLike) -> Floats:
    """The values that are finite, in one row."""
    v = np.asarray(values, dtype=np.float64).ravel()
    return v[np.isfinite(v)]


def round_step(span: float, at_most: int) -> float:
    """The smallest step of 1, 2, 5 x 10^k that cuts `span` into at most `at_most` parts."""
    raw = span / at_most
    scale = 10.0 ** math.floor(math.log10(raw))
    return scale * next(m for m in (1, 2, 5, 10) if m * scale >= raw * (1 - 1e-9))


def ticked(lo: float, hi: float, step: float) -> Axis:
    """Axis with ticks at the multiples of `step` inside [lo, hi], and labels of just enough decimals.

    Labels of more than `LONGEST` characters are shown minus a round offset, or else with a power of ten.
    """
    first, last = math.ceil(lo / step - 1e-9), math.floor(hi / step + 1e-9)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    values = tuple(i * step for i in range(first, last + 1))
    labels = tuple(fixed(v, decimals) for v in values)
    if max(map(len, labels), default=0) <= LONGEST:
        return Axis(lo, hi, values, labels)
    power = 10.0 ** math.ceil(math.log10(hi - lo))
    offset = math.floor(lo / power) * power
    labels = tuple(fixed(v - offset, decimals) for v in values)
    if max(map(len, labels)) <= LONGEST:
        return Axis(lo, hi, values, labels, offset=offset)
    return Axis(lo, hi, values, tuple(f"{v:.3g}".replace("e+0", "e").replace("-", "−") for v in values))


def axis(values: ArrayLike, *, count: int = 5, include: Iterable[float] = (), least: float = 0.0) -> Axis:
    """Linear axis over the finite `values`, widened to round limits, spanning `include` and at least `least`."""
    v = np.concatenate([finite_values(values), np.fromiter(include, dtype=np.float64)])
    lo, hi = (float(v.min()), float(v.max())) if len(v) else (0.0, 1.0)
    span = max(hi - lo, least, 1e-9 * max(abs(lo), abs(hi)), 1e-12)
    middle = (lo + hi) / 2
    if hi - lo < span:
        lo, hi = middle - span / 2, middle + span / 2
    step = round_step(span, count)
    lo, hi = math.floor(lo / step + 1e-9) * step, math.ceil(hi / step - 1e-9) * step
    return ticked(lo, hi, step)


def exact_axis(lo: float, hi: float, *, count: int = 6, step: float | None = None) -> Axis:
    """Linear axis from `lo` to `hi`; round ticks inside."""
    hi = hi if hi > lo else lo + 1.0
    return ticked(lo, hi, step or round_step(hi - lo, count))


def time_axis(lo: float, hi: float, count: int = 12) -> Axis:
    """Seconds since the start; ticks in seconds, at whole seconds, minutes or hours."""
    span = max(hi - lo, 1e-9)
    step = next((s for s in TIME_STEPS if span / s <= count), None)
    return replace(exact_axis(lo, hi, step=step, count=count), of_time=True)


def log_axis(values: ArrayLike) -> Axis:
    """Logarithmic axis over the positive finite `values`; ticks 1, 2, 5 x 10^k, or decades when there are many."""
    v = finite_values(values)
    v = v[v > 0]
    lo, hi = (float(v.min()), float(v.max())) if len(v) else (0.1, 1.0)
    multiples = (1, 2, 5) if math.log10(hi / lo) < 2.2 else (1,)
    decades = range(math.floor(math.log10(lo)) - 1, math.ceil(math.log10(hi)) + 2)
    ladder = [m * 10.0**k for k in decades for m in multiples]
    low = max(t for t in ladder if t <= lo * (1 + 1e-9))
    high = min(t for t in ladder if t >= hi * (1 - 1e-9) and t > low)
    ticks = tuple(t for t in ladder if low * (1 - 1e-9) <= t <= high * (1 + 1e-9))
    return Axis(low, high, ticks, tuple(map(_log_label, ticks)), log=True)


def _log_label(tick: float) -> str:
    power = math.floor(math.log10(tick) + 1e-9)
    if -5 < power < 5:
        return fixed(tick, max(0, -power))
    return f"{tick / 10.0**power:.0f}e{power}".replace("-", "−")


def spread_axis(values: ArrayLike, *, least: float = 0.0) -> Axis:
    """For standard deviations: logarithmic when they spread over more than a factor of 20, else linear from zero."""
    v = finite_values(values)
    v = v[v > 0]
    if len(v) and float(v.max()) > 20 * float(v.min()):
        return log_axis(v)
    return axis(v, include=(0.0,), least=least)


@dataclass
class Plot:
    """One pair of axes. `height_px` fixes the height; an `aspect` (width / height) keeps equal scales instead."""

    x: Axis
    y: Axis
    label: str
    y_title: str = ""
    x_title: str = "Time since start [s]"
    height_px: int = 190
    aspect: float | None = None
    _shapes: list[str] = field(default_factory=list)
    _texts: list[str] = field(default_factory=list)

    @property
    def _height(self) -> float:
        return UNITS / self.aspect if self.aspect else UNITS

    def points(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.int64]:
        """Integer drawing units (n, 2); far outliers are moved to just outside the box."""
        fx = np.clip(self.x.fraction(x), -1.0, 2.0)
        fy = np.clip(1.0 - self.y.fraction(y), -1.0, 2.0)
        return np.rint(np.stack([fx * UNITS, fy * self._height], axis=-1)).astype(np.int64)

    def line(self, x: ArrayLike, y: ArrayLike, cls: str, *, thin: bool = True, data: str = "") -> None:
        """A line that breaks where y is not finite. A time line is thinned by `thin_line`; `data` are attributes."""
        xs, ys = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        if thin:
            xs, ys = thin_line(xs, ys)
        good = np.isfinite(xs) & np.isfinite(ys)
        pieces = np.split(np.arange(len(xs)), np.flatnonzero(np.diff(good.astype(int))) + 1)
        d = "".join(path(self.points(xs[p], ys[p])) for p in pieces if len(p) and good[p[0]])
        if d:
            self._shapes.append(f'<path class="line {cls}"{data} d="{d}"/>')

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, cls: str) -> None:
        """The area between `low` and `high`."""
        xs, lo, hi = thin_band(np.asarray(x), np.asarray(low), np.asarray(high))
        good = np.isfinite(lo) & np.isfinite(hi)
        if good.sum() < 2:
            return
        ring = np.concatenate([self.points(xs[good], hi[good]), self.points(xs[good], lo[good])[::-1]])
        self._shapes.append(f'<path class="band {cls}" d="{path(ring)}z"/>')

    def dots(self, x: ArrayLike, y: ArrayLike, cls: str) -> None:
        """Round marks of constant size where x and y are finite."""
        xs, ys = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        good = np.isfinite(xs) & np.isfinite(ys)
        if good.any():
            d = "".join(f"M{a} {b}h0" for a, b in self.points(xs[good], ys[good]))
            self._shapes.append(f'<path class="dots {cls}" d="{d}"/>')

    def area(self, ring_x: ArrayLike, ring_y: ArrayLike, cls: str) -> None:
        """A closed outline."""
        self._shapes.append(f'<path class="{cls}" d="{path(self.points(ring_x, ring_y))}z"/>')

    def spans(self, intervals: Iterable[tuple[float, float]], cls: str = "gap") -> None:
        """Shaded spans of the x axis, with a minimum width."""
        for start, end in intervals:
            a, b = self.points([max(start, self.x.lo), min(end, self.x.hi)], [self.y.lo, self.y.lo])[:, 0]
            if end >= self.x.lo and start <= self.x.hi:
                size = f'width="{max(int(b - a), UNITS // 400)}" height="{self._height:.0f}"'
                self._shapes.append(f'<rect class="{cls}" x="{a}" y="0" {size}/>')

    def bars(self, edges: ArrayLike, heights: ArrayLike, cls: str) -> None:
        """Histogram columns between consecutive `edges`."""
        e = np.asarray(edges, dtype=np.float64)
        base = self.points(e, np.full(len(e), self.y.lo))
        top = self.points(e[:-1], heights)
        d = "".join(
            f"M{a} {base[i, 1]}V{y}H{base[i + 1, 0]}V{base[i, 1]}z" for i, (a, y) in enumerate(top) if y != base[i, 1]
        )
        self._shapes.append(f'<path class="bars {cls}" d="{d}"/>')

    def rule(self, y: float, cls: str = "rule") -> None:
        """A horizontal line across the plot."""
        self.line([self.x.lo, self.x.hi], [y, y], cls, thin=False)

    def text(self, x: float, y: float, text: str, cls: str, *, dx: int = 0, dy: int = 0) -> None:
        """Text at a data point, shifted by pixels."""
        fx, fy = float(self.x.fraction(x)), 1.0 - float(self.y.fraction(y))
        self._texts.append(
            f'<text class="{cls}" x="{100 * fx:.2f}%" y="{100 * fy:.2f}%" dx="{dx}" dy="{dy}">{escape(text)}</text>'
        )

    def raw(self, element: str) -> None:
        """Any SVG element in the coordinates of the page: per cent of the box, pixels for sizes."""
        self._texts.append(element)

    def _grid(self) -> str:
        height = round(self._height)
        xs = self.points(self.x.ticks, np.full(len(self.x.ticks), self.y.lo))[:, 0]
        ys = self.points(np.full(len(self.y.ticks), self.x.lo), self.y.ticks)[:, 1]
        d = "".join(f"M{x} 0V{height}" for x in xs) + "".join(f"M0 {y}H{UNITS}" for y in ys)
        return f'<path class="mesh" d="{d}"/><path class="frame" d="M0 0V{height}H{UNITS}"/>'

    def _tick_labels(self) -> str:
        """Labels at the ticks; every second one along a crowded x axis is marked ``odd``: narrow pages hide it."""
        at_x = 100 * self.x.fraction(self.x.ticks)
        at_y = 100 * (1.0 - self.y.fraction(self.y.ticks))
        along = (f'<text class="tick tx{odd}" x="{p:.2f}%" y="100%" dy="19">{escape(t)}</text>'
                 for p, t, odd in zip(at_x, self.x.labels, self._odd(), strict=True))  # fmt: skip
        up = (f'<text class="tick ty" x="0" y="{p:.2f}%" dx="-7" dy="4">{escape(t)}</text>'
              for p, t in zip(at_y, self.y.labels, strict=True))  # fmt: skip
        return "".join([*along, *up])

    def _odd(self) -> list[str]:
        ticks = self.x.ticks
        step = ticks[1] - ticks[0] if len(ticks) > 1 else 1.0
        return [" odd" if len(ticks) > 5 and round(tick / step) % 2 else "" for tick in ticks]

    def _ranges(self) -> str:
        """Ranges of the axes for the time cursor, where x is time."""
        if not self.x.of_time:
            return ""
        return f' data-x="{self.x.lo:.12g} {self.x.hi:.12g}" data-y="{self.y.lo:.12g} {self.y.hi:.12g} {self.y.log:d}"'

    def render(self) -> str:
        """The ``<svg>`` element."""
        size = f"--aspect:{self.aspect:.4f};aspect-ratio:var(--aspect)" if self.aspect else f"height:{self.height_px}px"
        kind = "plot" if self.x_title else "plot above"
        titles = (
            f'<text class="title ty0" x="-48" y="-13">{escape(self.y.titled(self.y_title))}</text>'
            if self.y_title
            else ""
        )
        if self.x_title:
            titles += f'<text class="title tx0" x="100%" y="100%" dy="37">{escape(self.x.titled(self.x_title))}</text>'
        return (
            f'<svg class="{kind}" style="{size}" role="img" aria-label="{escape(self.label)}"{self._ranges()}>'
            f'<svg class="box" viewBox="0 0 {UNITS} {self._height:.0f}" preserveAspectRatio="none" '
            f'width="100%" height="100%">{self._grid()}{"".join(self._shapes)}</svg>'
            f"{self._tick_labels()}{titles}{''.join(self._texts)}</svg>"
        )


def path(points: NDArray[np.int64]) -> str:
    """SVG path data of integer points, in relative steps; repeated points left out."""
    steps = np.diff(points, axis=0)
    moves = "".join(f"{a},{b} " for a, b in steps if a or b).rstrip().replace(",-", "-")
    start = f"M{points[0, 0]} {points[0, 1]}"
    return f"{start}l{moves}" if moves else f"{start}h0"


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """A list of (class, text): a sample of the mark beside its meaning."""
    items = "".join(
        f'<li><svg class="key" viewBox="0 0 24 10" aria-hidden="true">{_sample(cls)}</svg>{escape(text)}</li>'
        for cls, text in entries
    )
    return f'<ul class="legend">{items}</ul>' if items else ""


def _sample(cls: str) -> str:
    kind = cls.split()[0]
    if kind == "dots":
        return f'<path class="{cls}" d="M12 5h0"/>'
    if kind == "line":
        return f'<path class="{cls}" d="M1 5H23"/>'
    return f'<rect class="{cls}" x="2" y="1" width="20" height="8"/>'

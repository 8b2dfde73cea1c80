"""The trajectory on a map in metres: path, fixes used and rejected, uncertainty ellipses, IMU data gaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.factors import title_of
from smartnav_graph.graph.solution import POS, Residuals, Solution
from smartnav_graph.output.report.svg import Axis, Plot, legend, round_step, ticked
from smartnav_graph.output.report.thin import thin_path
from smartnav_graph.output.text import count, fixed
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned

SHAPES = (1.25, 2.4)  # width / height of the map
ELLIPSES = 30
CONTROL = {"used": "control", "unused": "control-withheld"}
NARROW_PX, WIDE_PX = 290.0, 600.0  # width of the map on a phone, on a screen and on paper


def fix_states(session: Session, solution: Solution) -> dict[str, tuple[Floats, NDArray[np.str_]]]:
    """Per position sensor: rows (n, 2) east, north and whether each was ``used``, ``rejected`` or ``unused``.

    A fix without residuals of its own is unused (`Residuals.found_for`). Without any every fix inside the run counts as
    used.
    """
    found = {}
    for name, stream in session.positions().items():
        if not len(stream) or not len(solution):
            continue
        inside = (stream.t_ns >= solution.t_ns[0]) & (stream.t_ns <= solution.t_ns[-1])
        if inside.any():
            stream = stream.take(inside)
            found[name] = session.nav_position(stream)[:, :2], _states(stream, name, solution.residuals)
    return found


def _states(stream: Positioned, name: str, residuals: Residuals) -> NDArray[np.str_]:
    if not len(residuals):
        return np.full(len(stream), "used")
    there, used = residuals.found_for(name, stream.t_ns)
    return np.where(used, "used", np.where(there, "rejected", "unused"))


def _axes(points: Floats) -> tuple[Axis, Axis, float]:
    """Equal scales: east axis, north axis and width / height of the box."""
    lo, hi = points.min(axis=0), points.max(axis=0)
    size = np.maximum(hi - lo, 1e-3 * max(float((hi - lo).max()), 1.0)) * 1.12
    width, height = max(size[0], size[1] * SHAPES[0]), max(size[1], size[0] / SHAPES[1])
    middle, half = (lo + hi) / 2, np.array([width, height]) / 2
    (west, south), (east, north) = middle - half, middle + half
    step = round_step(max(width, height), 9)
    return ticked(west, east, step), ticked(south, north, step), float(width / height)


def draw(
    session: Session, solution: Solution, gaps: Sequence[tuple[float, float, str]], causal: Solution | None
) -> str:
    """The map as a figure with its legend."""
    path = solution.nav_t_body[:, :2]
    if len(solution) < 2 or not np.isfinite(path).all():
        return "<p>The run has no path.</p>"
    fixes = fix_states(session, solution)
    near = _near(path, fixes)
    x, y, aspect = _axes(np.concatenate([path, near]))
    plot = Plot(x, y, "Map of the trajectory, east and north in metres", "North [m]", "East [m]", aspect=aspect)
    under = _ellipses(plot, solution) + _gaps(plot, solution, gaps)
    entries = [("line path", "Smoothed path"), *_fixes(plot, fixes, ("used", "unused"))]
    if causal is not None and len(causal) > 1:
        _path(plot, causal.nav_t_body[:, :2], "line causal")
        entries.append(("line causal", "Causal estimate"))
    _path(plot, path, "line path", solution.seconds)
    entries += _fixes(plot, fixes, ("rejected",)) + under
    _labels(plot, session, solution, _ends(plot, path))
    _scale_and_north(plot)
    widest = f"max-width:min(100%,calc(680px*{aspect:.3f} + 70px))"
    return f'<figure class="map" style="{widest}">{legend(entries)}{plot.render()}</figure>'


def two_paths(estimate: Floats, seconds: Floats, reference: Floats) -> str:
    """An estimated path (n, 3) with its times s, and a reference (m, 3), as a figure."""
    x, y, aspect = _axes(np.concatenate([estimate[:, :2], reference[:, :2]]))
    plot = Plot(x, y, "Map of both trajectories", "North [m]", "East [m]", aspect=aspect)
    if len(reference) > 1:
        _path(plot, reference[:, :2], "line reference")
    _path(plot, estimate[:, :2], "line path", seconds)
    _scale_and_north(plot)
    widest = f"max-width:min(100%,calc(680px*{aspect:.3f} + 70px))"
    entries = [("line path", "Estimate, aligned"), ("line reference", "Reference")]
    return f'<figure class="map" style="{widest}">{legend(entries)}{plot.render()}</figure>'


def _near(path: Floats, fixes: Mapping[str, tuple[Floats, NDArray[np.str_]]]) -> Floats:
    """Fixes that enlarge the map: at most by a fifth of the size of the path."""
    lo, hi = path.min(axis=0), path.max(axis=0)
    slack = 0.2 * float((hi - lo).max())
    rows = np.concatenate([np.zeros((0, 2)), *(xy for xy, _ in fixes.values())])
    return np.asarray(rows[((rows >= lo - slack) & (rows <= hi + slack)).all(axis=1)])


def _path(plot: Plot, xy: Floats, cls: str, seconds: Floats | None = None) -> None:
    """A path, with the times of its corners where they are given."""
    keep = thin_path(xy, (plot.x.hi - plot.x.lo) / 4000)
    data = ""
    if seconds is not None:
        points = plot.points(xy[keep, 0], xy[keep, 1])
        keep = keep[np.concatenate([[True], (np.diff(points, axis=0) != 0).any(axis=1)])]
        data = f' data-t="{" ".join(f"{t:.2f}".rstrip("0").rstrip(".") for t in seconds[keep])}"'
    plot.line(xy[keep, 0], xy[keep, 1], cls.removeprefix("line "), thin=False, data=data)


def _fixes(
    plot: Plot, fixes: Mapping[str, tuple[Floats, NDArray[np.str_]]], states: Sequence[str]
) -> list[tuple[str, str]]:
    states_shown = {"used": "used", "unused": "withheld or not used", "rejected": "rejected"}
    entries = []
    for name, (xy, state) in fixes.items():
        for key in states:
            rows = xy[state == key]
            seen = (np.abs(plot.x.fraction(rows[:, 0]) - 0.5) <= 0.5) & (
                np.abs(plot.y.fraction(rows[:, 1]) - 0.5) <= 0.5
            )
            if len(rows):
                cls = f"fix-{key}" if name == "gnss" or key == "rejected" else CONTROL[key]
                plot.dots(rows[seen, 0], rows[seen, 1], cls)
                outside = f", {count((~seen).sum())} off the map" if (~seen).any() else ""
                entries.append((f"dots {cls}", f"{title_of(name)} {states_shown[key]} ({count(len(rows))}{outside})"))
    return entries


def _gaps(plot: Plot, solution: Solution, gaps: Sequence[tuple[float, float, str]]) -> list[tuple[str, str]]:
    t, path = solution.seconds, solution.nav_t_body[:, :2]
    for start, length, _ in gaps:
        at = np.concatenate([[start], t[(t > start) & (t < start + length)], [start + length]])
        plot.line(np.interp(at, t, path[:, 0]), np.interp(at, t, path[:, 1]), "imu-gap", thin=False)
    return [("line imu-gap", f"IMU data gap ({len(gaps)})")] if gaps else []


def _ellipses(plot: Plot, solution: Solution) -> list[tuple[str, str]]:
    """One-sigma ellipses at equal distances along the path, enlarged by a round factor where they are too small."""
    chosen = _spaced(solution)
    block = solution.covariance[:, POS, POS][chosen][:, :2, :2]
    good = np.isfinite(block).all(axis=(1, 2))
    chosen, block = chosen[good], block[good]
    if not len(chosen):
        return []
    value, vector = np.linalg.eigh(block)
    axes = np.sqrt(np.clip(value, 0.0, None))
    wanted = 0.018 * (plot.x.hi - plot.x.lo)
    typical = max(float(np.median(axes[:, 1])), float(axes[:, 1].max()) / 4)
    scale = max(1.0, round_step(wanted / typical, 1)) if typical > 0 else 1.0
    fits = scale * axes[:, 1] < (plot.x.hi - plot.x.lo) / 3
    angle = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for i, half, turn in zip(chosen[fits], axes[fits], vector[fits], strict=True):
        ring = solution.nav_t_body[i, :2, None] + scale * (turn * half) @ circle
        plot.area(ring[0], ring[1], "ellipse")
    size = f"enlarged {fixed(scale, 0)}×" if scale > 1 else "true size"
    wide = f"; {count((~fits).sum())} too large for this map" if not fits.all() else ""
    return [("ellipse", f"1 sigma ellipse, {size}{wide}")]


def _spaced(solution: Solution) -> NDArray[np.intp]:
    step = np.linalg.norm(np.diff(solution.nav_t_body[:, :2], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(step)])
    if along[-1] <= 0:
        return np.array([0])
    return np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], ELLIPSES)).clip(0, len(along) - 1))


def _labels(plot: Plot, session: Session, solution: Solution, ends: Sequence[Mark]) -> None:
    """Names of the control points, as far as they do not cover each other or the names of start and end on a small
    screen; those of class ``wide`` have enough space only on a large one."""
    points = session.control
    if points is None:
        return
    points = points.take((points.t_ns >= solution.t_ns[0]) & (points.t_ns <= solution.t_ns[-1]))
    nav, height = session.nav_position(points)[:, :2], 1.0 / (plot.aspect or 1.0)
    places = np.column_stack([plot.x.fraction(nav[:, 0]), (1.0 - plot.y.fraction(nav[:, 1])) * height])
    names = dict(zip(map(str, points.point_id), places.tolist(), strict=True))  # a point that is visited twice has one
    boxes = {width: [end.box(width) for end in ends] for width in (NARROW_PX, WIDE_PX)}
    for name, (x, y) in names.items():
        mark = Mark(name, x, y, x > 0.8)
        free = {width: not any(_overlap(mark.box(width), other) for other in boxes[width]) for width in boxes}
        if not (name and 0.0 <= x <= 1.0 and 0.0 <= y <= height and free[WIDE_PX]):
            continue
        for width in boxes:
            boxes[width] += [mark.box(width)] if free[width] else []
        cls = f"name{' end' if mark.leftward else ''}{'' if free[NARROW_PX] else ' wide'}"
        at = f'x="{100 * x:.2f}%" y="{100 * y / height:.2f}%" dx="{-8 if mark.leftward else 8}" dy="4"'
        plot.raw(f'<text class="{cls}" {at}>{escape(name)}</text>')


class Mark(NamedTuple):
    """A name beside a point at (x, y), in shares of the width of the map."""

    name: str
    x: float
    y: float
    leftward: bool

    def box(self, width: float) -> tuple[float, float, float, float]:
        """Left, top, right and bottom of the text on a map of `width` px."""
        near, far = 8 / width, (8 + 7.5 * len(self.name)) / width
        left, right = (self.x - far, self.x - near) if self.leftward else (self.x + near, self.x + far)
        return left, self.y - 22 / width, right, self.y + 22 / width


def _overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _ends(plot: Plot, path: Floats) -> list[Mark]:
    """Start and end with their names."""
    marks, height = [], 1.0 / (plot.aspect or 1.0)
    a, b = path[0], path[-1]
    where = [(float(plot.x.fraction(p[0])), 1 - float(plot.y.fraction(p[1]))) for p in (a, b)]
    left = where[0][0] <= where[1][0]
    for (fx, fy), p, name, on_left in ((where[0], a, "Start", left), (where[1], b, "End", not left)):
        shape = f'cx="{100 * fx:.2f}%" cy="{100 * fy:.2f}%" r="5.5"'
        plot.raw(f'<circle class="mark {name.lower()}" {shape}/>')
        outward = on_left if 0.12 < fx < 0.88 else fx >= 0.88
        plot.text(
            p[0], p[1], name, f"note {'end' if outward else ''}", dx=-10 if outward else 10, dy=-8 if on_left else 16
        )
        marks.append(Mark(name, fx, fy * height, outward))
    return marks


def _scale_and_north(plot: Plot) -> None:
    """Scale bar and north arrow, outside the frame to cover nothing on a small screen."""
    width = plot.x.hi - plot.x.lo
    length = round_step(width / 5, 1) / (1 if round_step(width / 5, 1) < width / 3.5 else 2)
    share, text = 100 * length / width, f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    plot.raw(
        f'<svg class="scale" x="0" y="100%"><rect x="0" y="31" width="{share:.2f}%" height="4"/>'
        f'<text class="note" x="{share:.2f}%" dx="8" y="37">{text}</text></svg>'
    )
    plot.raw('<svg class="north" x="100%" y="0"><path d="M-7 -27l6 20l-6 -5l-6 5z"/>'
             '<text class="note end" x="-20" y="-11">N</text></svg>')  # fmt: skip

"""Named, counted repairs of faulty tables. Applied only on request; the file on disk is not changed.

=========  ==========================================================================================
``clock``  a clock that was set back continued by one median step (a week of GPS time added where that is it);
           inertial rows that arrive in bursts spread evenly
``order``  rows sorted by stamp (stable), rows with a repeated stamp dropped; refused where a clock was set back
``nan``    rows with a non-finite required value dropped
``units``  readings that are known to be in another unit converted (of the whole session, see `health.units`)
``stamps`` jittered inertial stamps rebuilt between gaps: row order is kept, each becomes its 4 s moving mean
=========  ==========================================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from smartnav_graph.core.arrays import Column, Indices, Mask, Table, Times
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.stream import Stream, required_columns
from smartnav_graph.session.streams import Imu

_OF_ROWS = ("nan", "clock", "stamps", "order")
REPAIRS = (*_OF_ROWS, "units")
_RESET_S, _RESET_ROWS = 1.0, 10  # a clock set back by less, or of fewer rows, is disorder
_WEEK_S = 604_800
_BURST = 0.05  # of the mean step: steps within a burst


def check_names(names: Iterable[str]) -> tuple[str, ...]:
    """The wanted repairs, in the order of application.

    Raises
    ------
    ConfigError
        A name that is no repair.
    """
    wanted = set(names)
    unknown = sorted(wanted - set(REPAIRS))
    if unknown:
        raise ConfigError("--repair", f"unknown repair {', '.join(unknown)}", f"some of {', '.join(REPAIRS)}")
    return tuple(name for name in REPAIRS if name in wanted)


def repair(kind: type[Stream], table: Mapping[str, Column], names: Iterable[str]) -> tuple[Table, dict[str, int]]:
    """Apply `names` to the columns of one stream.

    Returns
    -------
    table : the repaired columns
    counts : rows touched by each reason; empty when nothing was wrong
    """
    rows: Table = dict(table)
    counts: dict[str, int] = {}
    for name in check_names(names):
        if name in _OF_ROWS and "t_ns" in rows and len(rows["t_ns"]):
            rows, found = _STEPS[name](kind, rows)
            counts |= {reason: counts.get(reason, 0) + count for reason, count in found.items() if count}
    return rows, counts


def _keep(rows: Table, selected: Mask | Indices) -> Table:
    return {name: np.asarray(column)[selected] for name, column in rows.items()}


def _drop_nan(kind: type[Stream], rows: Table) -> tuple[Table, dict[str, int]]:
    required = [
        name
        for spec in kind.specs()
        for name, required in zip(spec.metadata["columns"], required_columns(spec), strict=True)
        if required and name in rows
    ]
    good = np.ones(len(rows["t_ns"]), dtype=bool)
    for name in required:
        good &= np.isfinite(np.asarray(rows[name], dtype=np.float64))
    return _keep(rows, good), {"non-finite rows dropped": int((~good).sum())}


def _sort(kind: type[Stream], rows: Table) -> tuple[Table, dict[str, int]]:
    t = np.asarray(rows["t_ns"], dtype=np.int64)
    if len(resets := clock_resets(rows)):
        row = int(resets[0])
        found = f"t_ns falls back by {(t[row - 1] - t[row]) / NS:.3f} s at row {row}: the clock was set back"
        remedy = "add --repair clock to continue it; sorting would merge two parts of the recording"
        raise SessionError(kind.NAME, found, "one clock from begin to end", remedy, row=row, stream=kind.NAME)
    moved = int((np.diff(t) < 0).sum())
    rows = _keep(rows, np.argsort(t, kind="stable"))
    repeated = 0
    if kind.UNIQUE_TIMES:
        first = np.concatenate([[True], np.diff(np.asarray(rows["t_ns"], dtype=np.int64)) > 0])
        repeated = int((~first).sum())
        rows = _keep(rows, first)
    return rows, {"disordered rows sorted": moved, "repeated stamps dropped": repeated}


def clock_resets(rows: Table) -> Indices:
    """Rows (k,) at which a clock was set back: from there on rows lie between those before, or before them all, and
    repeat none of them. Rows that are swapped, delivered twice or delivered late are no resets."""
    t = np.asarray(rows["t_ns"], dtype=np.int64)
    values = [np.asarray(column) for name, column in rows.items() if name != "t_ns"]
    resets = []
    for row in np.flatnonzero(np.diff(t) < -_RESET_S * NS) + 1:
        if row < 3:  # too few before it to have a period
            continue
        order = np.argsort(t[:row], kind="stable")
        before, late = t[:row][order], row + np.flatnonzero(t[row:] < t[:row].max())
        at = np.searchsorted(before, t[late])
        same = before[at] == t[late]
        for column in values:
            same &= column[order][at] == column[late]
        step, most = before[at] - before[np.maximum(at - 1, 0)], 3.0 * float(np.median(np.diff(before)))
        first = at == 0
        apart = first & (before[0] - t[late][first].max(initial=t.min()) > most)
        merged = ~same & np.where(first, apart, step < most)
        if merged.sum() >= min(_RESET_ROWS, len(t) - row) and 2 * merged.sum() > len(late):
            resets.append(row)
    return np.array(resets, dtype=np.intp)


def arrives_in_bursts(t: Times) -> bool:
    """Whether most rows follow the one before at once, as stamps of the arrival of packets do."""
    step = np.diff(t)
    return len(step) > 20 and bool(np.median(step) < _BURST * step.mean()) and bool(step.min() >= 0)


def _repair_clock(kind: type[Stream], rows: Table) -> tuple[Table, dict[str, int]]:
    t = np.asarray(rows["t_ns"], dtype=np.int64).copy()
    resets = clock_resets(rows)
    for row in resets:
        back = int(t[row - 1] - t[row])
        weeks = round(back / (_WEEK_S * NS))
        near = weeks > 0 and abs(back - weeks * _WEEK_S * NS) < 10 * NS
        t[row:] += weeks * _WEEK_S * NS if near else back + round(float(np.median(np.diff(t[:row]))))
    counts = {"after a clock was set back, continued": len(t) - int(resets[0]) if len(resets) else 0}
    if kind is Imu and arrives_in_bursts(t):
        spacing = np.diff(t)
        spacing = spacing[spacing > _BURST * spacing.mean()]
        breaks = np.flatnonzero(np.diff(t) > 3.0 * np.median(spacing)) + 1
        t = np.concatenate([_steady(part) for part in np.split(t, breaks)])
        counts["of bursts, spread evenly"] = len(t)
    return rows | {"t_ns": t}, counts


def _rebuild_stamps(kind: type[Stream], rows: Table) -> tuple[Table, dict[str, int]]:
    """Only inertial samples come at a steady rate; the stamps of events (fixes, standstills) are kept."""
    if kind is not Imu:
        return rows, {}
    # a row delivered twice would shift its neighbours
    first = np.concatenate([[True], np.diff(np.asarray(rows["t_ns"], dtype=np.int64)) != 0])
    rows = _keep(rows, first)
    t = np.asarray(rows["t_ns"], dtype=np.int64)
    rebuilt = np.concatenate([_steady(part) for part in np.split(t, _breaks(t))])
    return rows | {"t_ns": rebuilt}, {"repeated stamps dropped": int((~first).sum()), "stamps rebuilt": len(t)}


def _breaks(t: Times) -> Indices:
    """Rows after a step that jitter cannot explain: 8 robust sigmas of the steps (and 10 periods) above the median."""
    step = np.diff(t)
    if not len(step):
        return np.zeros(0, dtype=np.intp)
    median = float(np.median(step))
    sigma = 1.4826 * float(np.median(np.abs(step - median)))
    return np.asarray(np.flatnonzero(step > median + max(8.0 * sigma, 10.0 * median)) + 1)


def _steady(t: Times) -> Times:
    """4 s moving mean of stamps in row order, about their straight line of least squares."""
    if len(t) < 3:
        return t
    rows = np.arange(len(t)) - (len(t) - 1) / 2
    since = np.asarray(t - t[0], dtype=np.float64)
    slope = float(rows @ since / (rows @ rows))
    width = max(3, round(4.0 * NS / slope)) | 1 if slope > 0 else 3
    from scipy.ndimage import uniform_filter1d

    smooth = uniform_filter1d(since - slope * rows, width, mode="reflect") + slope * rows
    return np.asarray(np.rint(smooth).astype(np.int64) + t[0], dtype=np.int64)


_STEPS = {"nan": _drop_nan, "clock": _repair_clock, "stamps": _rebuild_stamps, "order": _sort}

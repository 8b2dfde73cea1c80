"""Named, counted repairs of faulty tables. Applied only on request; the file on disk is not changed.

=========  ==========================================================================================
``order``  rows sorted by stamp (stable), rows with a repeated stamp dropped
``nan``    rows with a non-finite required value dropped
``stamps`` jittered inertial stamps rebuilt between gaps: row order is kept, each becomes its 4 s moving mean
=========  ==========================================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from scipy.ndimage import uniform_filter1d

from smartnav_graph.core.arrays import Column, Indices, Mask, Table, Times
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import Imu

REPAIRS = ("nan", "stamps", "order")


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
        if "t_ns" in rows and len(rows["t_ns"]):
            rows, found = {"nan": _drop_nan, "order": _sort, "stamps": _rebuild_stamps}[name](kind, rows)
            counts |= {reason: counts.get(reason, 0) + count for reason, count in found.items() if count}
    return rows, counts


def _keep(rows: Table, selected: Mask | Indices) -> Table:
    return {name: np.asarray(column)[selected] for name, column in rows.items()}


def _drop_nan(kind: type[Stream], rows: Table) -> tuple[Table, dict[str, int]]:
    required = [
        name
        for spec in kind.specs()
        if spec.metadata["kind"] == "float" and not spec.metadata["nan"]
        for name in spec.metadata["columns"]
        if name in rows
    ]
    good = np.ones(len(rows["t_ns"]), dtype=bool)
    for name in required:
        good &= np.isfinite(np.asarray(rows[name], dtype=np.float64))
    return _keep(rows, good), {"non-finite rows dropped": int((~good).sum())}


def _sort(kind: type[Stream], rows: Table) -> tuple[Table, dict[str, int]]:
    t = np.asarray(rows["t_ns"], dtype=np.int64)
    moved = int((np.diff(t) < 0).sum())
    rows = _keep(rows, np.argsort(t, kind="stable"))
    repeated = 0
    if kind.UNIQUE_TIMES:
        first = np.concatenate([[True], np.diff(np.asarray(rows["t_ns"], dtype=np.int64)) > 0])
        repeated = int((~first).sum())
        rows = _keep(rows, first)
    return rows, {"disordered rows sorted": moved, "repeated stamps dropped": repeated}


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
    smooth = uniform_filter1d(since - slope * rows, width, mode="reflect") + slope * rows
    return np.asarray(np.rint(smooth).astype(np.int64) + t[0], dtype=np.int64)

"""Positions that one device cannot have visited all: those out of reach of the largest set that it can.

Two positions are within reach of each other if no more than the fastest motion, some slack and their noise lie between
them. The largest set is the longest path through the parts between jumps, without a few rows at their edges where need
be: an outlier within slack and noise of a part may be out of reach of the next. Robust estimation finds such outliers.
It needs no other sensor and no model: where half of all fixes lie elsewhere, a solution would lie in between.
"""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Mask, Times
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.stream import Positioned

# Speed (m/s) that positions are never out of reach at, and distance (m) that robust estimation takes care of.
FAST_M_S, SLACK_M = 100.0, 100.0
# Sigmas of noise between two positions.
SIGMAS = 4.0
# A device that is faster has most of its lowest speeds below the limit, over one of these numbers of rows.
LOW, SPANS, FASTER = 0.25, (1, 2, 3, 4), 2.0
# Rows at each edge of a part that a path may leave out, and rows before one that are looked at together.
EDGE, LATEST = 3, 256


def out_of_reach(stream: Positioned, position: Floats, at_first: Mask | None = None) -> Mask:
    """Rows (n,) out of reach of the largest set that one device can have visited.

    Parameters
    ----------
    position : (n, 3) nav m
    at_first : (n,) rows that decide which set it is; a later row is out of reach of the last one in reach before it.
        All rows, where it is not given
    """
    first = np.ones(len(position), dtype=bool) if at_first is None else at_first
    kept = np.zeros(len(position), dtype=bool)
    if not first.any():
        return kept
    sigma = np.zeros(len(position)) if stream.sigma is None else np.nan_to_num(stream.sigma)[:, :2].max(axis=1)
    known = np.column_stack([position[:, :2], np.where(stream.has_height, position[:, 2], np.nan)])
    reach = _Reach(stream.t_ns, known, SIGMAS * sigma, np.flatnonzero(first))
    kept[reach.largest] = True
    last = reach.largest[0]
    for row in range(len(kept)) if at_first is not None else ():
        kept[row] = kept[row] or (not first[row] and reach.between(np.array([last]), np.array([row]))[0])
        last = row if kept[row] else last
    return ~kept


class _Reach:
    """Stamps t_ns (n,), positions (n, 3) m, NaN where not known, and what noise puts between (n,) m; the largest set
    among `rows`."""

    def __init__(self, t_ns: Times, position: Floats, noise: Floats, rows: Indices) -> None:
        self.t, self.position, self.noise = (t_ns - t_ns[0]) / NS, position, noise
        low = [np.quantile(self._speed(rows[:-k], rows[k:]), LOW) for k in SPANS if len(rows) > k]
        self.speed = max(FAST_M_S, FASTER * float(min(low, default=0.0)))
        self.largest = self._largest(rows)

    def _distance(self, rows: Indices, others: Indices) -> Floats:
        return np.asarray(np.linalg.norm(np.nan_to_num(self.position[others] - self.position[rows]), axis=1))

    def _speed(self, rows: Indices, others: Indices) -> Floats:
        return np.asarray(self._distance(rows, others) / np.maximum(self.t[others] - self.t[rows], 1e-9))

    def between(self, rows: Indices, others: Indices) -> Mask:
        """Whether rows (k,) are within reach of others (k,), or of one."""
        slack = SLACK_M + self.noise[others] + self.noise[rows]
        return np.asarray(self._distance(rows, others) <= self.speed * np.abs(self.t[others] - self.t[rows]) + slack)

    def _largest(self, rows: Indices) -> Indices:
        """The longest path through rows in time order, from row to row within a part, and from the end of one part to
        the beginning of a later one, where these are within reach; and rows within reach of most beside them."""
        n, near = len(rows), self.between(rows[:-1], rows[1:])
        parts = np.split(np.arange(n), np.flatnonzero(~near) + 1)
        ends = np.concatenate([part[-EDGE:] for part in parts])
        begins = np.zeros(n, dtype=bool)
        begins[np.concatenate([part[:EDGE] for part in parts])] = True
        size, before = np.ones(n, dtype=np.intp), np.full(n, -1)
        most = np.zeros(n + 1, dtype=np.intp)  # of the rows before
        for k in range(n):
            if k and near[k - 1]:
                size[k], before[k] = size[k - 1] + 1, k - 1
            last = int(np.searchsorted(ends, k)) if begins[k] else 0
            while last > 0 and most[ends[last - 1] + 1] >= size[k]:  # the latest first
                some = ends[max(last - LATEST, 0) : last]
                within = some[self.between(rows[some], rows[k : k + 1])]
                if len(within) and size[within].max() >= size[k]:
                    before[k] = within[np.argmax(size[within])]
                    size[k] = size[before[k]] + 1
                last -= len(some)
            most[k + 1] = max(most[k], size[k])
        found, k = [], int(np.argmax(size))
        while k >= 0:
            found.append(k)
            k = int(before[k])
        kept = np.array(found[::-1])
        others = np.setdiff1d(np.arange(n), kept)
        after, count = np.searchsorted(kept, others), np.zeros(len(others), dtype=np.intp)
        for shift in range(-EDGE, EDGE):
            beside = kept[np.clip(after + shift, 0, len(kept) - 1)]
            count += self.between(rows[beside], rows[others]) & (np.abs(beside - others) <= EDGE)
        found.extend(others[count > EDGE])
        return rows[np.unique(found)]

"""Standstills from images: the points do not move, even if an engine shakes the accelerometer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import StaticPeriod
from smartnav_graph.vision.pairs import Pairs

# Largest median displacement of points (normalised, about half a pixel of a phone) over `LEAST_S` to `MOST_S` at a
# standstill, and the least number of matches.
MOST_DISPLACEMENT, LEAST_S, MOST_S, MATCHES = 1e-3, 0.5, 2.0, 8
# Sigma of the speed (m/s) of such a camera: half a pixel a second indoors.
SPEED_SIGMA = 0.01
SOURCE = "images"
# Displacement of nearly all points, in units of the one above, of a camera that moves though it does not turn; the
# share of the points; time (s) before the second image that a standstill is refuted for, and of a standstill that is
# uncertain at both ends (ns).
MOVING, NEARLY_ALL, RECENT_S, EDGE_NS = 5.0, 80.0, 1.0, NS // 10


def static_periods(pairs: Pairs) -> StaticPeriod | None:
    """Periods in which images about a second apart show no motion; None without any."""
    usable, median = _displacement(pairs, 50.0)
    spans = pairs.t_ns[pairs.images[usable][median < MOST_DISPLACEMENT]]
    if not len(spans):
        return None
    start, end = _union(spans)
    source = np.full(len(start), SOURCE, dtype=object)
    return StaticPeriod(t_ns=start, t_end_ns=end, sigma_v=np.full(len(start), SPEED_SIGMA), source=source)


def moving_spans(pairs: Pairs, rests: Sequence[tuple[int, int]]) -> NDArray[np.int64]:
    """Spans (k, 2) ns in which images of a camera that does not turn show motion, though both were taken in one of the
    `rests`, spans of stamps: between an image before a rest and one in it, the motion may have ended."""
    usable, most = _displacement(pairs, 100.0 - NEARLY_ALL)
    first, last = pairs.t_ns[pairs.images[usable][most > MOVING * MOST_DISPLACEMENT]].reshape(-1, 2).T
    start, end = np.array(rests, dtype=np.int64).reshape(-1, 2).T
    rest = np.searchsorted(start, first - EDGE_NS, side="right") - 1
    inside = (rest >= 0) & (last + EDGE_NS <= end[rest]) if len(rests) else np.zeros(len(first), dtype=bool)
    spans = np.stack([np.maximum(first, last - round(RECENT_S * NS)), last], axis=1)[inside]
    return np.stack(_union(spans), axis=1) if len(spans) else spans


def _displacement(pairs: Pairs, percentile: float) -> tuple[NDArray[np.bool_], Floats]:
    """Which pairs (n,) are about a second apart with matches enough, and a percentile (k,) of their displacements."""
    usable = (pairs.length_s >= LEAST_S) & (pairs.length_s <= MOST_S) & (pairs.count >= MATCHES)
    if not usable.any():
        return usable, np.zeros(0)
    size = np.asarray(pairs.padded(np.linalg.norm(pairs.x1 - pairs.x0, axis=1)))[usable]
    return usable, np.nanpercentile(np.where(pairs.there[usable], size, np.nan), percentile, axis=1)


def _union(spans: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Start and end of the unions of spans (n, 2)."""
    spans = spans[np.argsort(spans[:, 0], kind="stable")]
    reach = np.maximum.accumulate(spans[:, 1])
    new = np.concatenate([[True], spans[1:, 0] > reach[:-1]])
    last = np.concatenate([np.flatnonzero(new)[1:] - 1, [len(spans) - 1]])
    return spans[new, 0], reach[last]

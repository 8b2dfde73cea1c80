"""Standstills from images: the points do not move, even if an engine shakes the accelerometer."""

from __future__ import annotations

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
# share of the points; time (s) before the second image that the motion surely holds for.
MOVING, NEARLY_ALL, RECENT_S = 5.0, 80.0, 1.0


def static_periods(pairs: Pairs) -> StaticPeriod | None:
    """Periods in which images about a second apart show no motion; None without any."""
    usable, median = _displacement(pairs, 50.0)
    spans = pairs.t_ns[pairs.images[usable][median < MOST_DISPLACEMENT]]
    if not len(spans):
        return None
    start, end = _union(spans)
    source = np.full(len(start), SOURCE, dtype=object)
    return StaticPeriod(t_ns=start, t_end_ns=end, sigma_v=np.full(len(start), SPEED_SIGMA), source=source)


def moving_spans(pairs: Pairs) -> NDArray[np.int64]:
    """Spans (k, 2) ns in which images of a camera that does not turn show motion."""
    usable, most = _displacement(pairs, 100.0 - NEARLY_ALL)
    spans = pairs.t_ns[pairs.images[usable][most > MOVING * MOST_DISPLACEMENT]].reshape(-1, 2)
    spans[:, 0] = np.maximum(spans[:, 0], spans[:, 1] - round(RECENT_S * NS))
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

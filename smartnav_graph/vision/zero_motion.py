"""Standstills from images: the points do not move, even if an engine shakes the accelerometer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.session.streams import StaticPeriod
from smartnav_graph.vision.pairs import Pairs

# Largest median displacement of points (normalised, about half a pixel of a phone) over `LEAST_S` to `MOST_S` at a
# standstill, and the least number of matches.
MOST_DISPLACEMENT, LEAST_S, MOST_S, MATCHES = 1e-3, 0.5, 2.0, 8
# Sigma of the speed (m/s) of such a camera: half a pixel a second indoors.
SPEED_SIGMA = 0.01
SOURCE = "images"


def static_periods(pairs: Pairs) -> StaticPeriod | None:
    """Periods in which images about a second apart show no motion; None without any."""
    usable = (pairs.length_s >= LEAST_S) & (pairs.length_s <= MOST_S) & (pairs.count >= MATCHES)
    if not usable.any():
        return None
    displacement = np.asarray(pairs.padded(np.linalg.norm(pairs.x1 - pairs.x0, axis=1)))[usable]
    median = np.nanmedian(np.where(pairs.there[usable], displacement, np.nan), axis=1)
    spans = pairs.t_ns[pairs.images[usable][median < MOST_DISPLACEMENT]]
    if not len(spans):
        return None
    start, end = _union(spans)
    source = np.full(len(start), SOURCE, dtype=object)
    return StaticPeriod(t_ns=start, t_end_ns=end, sigma_v=np.full(len(start), SPEED_SIGMA), source=source)


def _union(spans: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Start and end of the unions of spans (n, 2)."""
    spans = spans[np.argsort(spans[:, 0], kind="stable")]
    reach = np.maximum.accumulate(spans[:, 1])
    new = np.concatenate([[True], spans[1:, 0] > reach[:-1]])
    last = np.concatenate([np.flatnonzero(new)[1:] - 1, [len(spans) - 1]])
    return spans[new, 0], reach[last]

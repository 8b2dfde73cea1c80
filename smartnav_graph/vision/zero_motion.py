"""When a camera stands still: nothing moves in the image, however much a motor shakes the accelerometer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.session.streams import StaticPeriod
from smartnav_graph.vision.pairs import Pairs

# Median displacement of points (normalised, about half a pixel of a phone) over `LEAST_S` to `MOST_S` at a standstill,
# and matches that tell it.
STILL, LEAST_S, MOST_S, MATCHES = 1e-3, 0.5, 2.0, 8
# Speed (m/s) that such a camera may have: half a pixel a second in a room.
SPEED_SIGMA = 0.01
SOURCE = "images"


def still_periods(pairs: Pairs) -> StaticPeriod | None:
    """Stretches in which images about a second apart show the same; None where there are none."""
    asked = (pairs.length_s >= LEAST_S) & (pairs.length_s <= MOST_S) & (pairs.count >= MATCHES)
    if not asked.any():
        return None
    moved = np.asarray(pairs.padded(np.linalg.norm(pairs.x1 - pairs.x0, axis=1)))[asked]
    median = np.nanmedian(np.where(pairs.there[asked], moved, np.nan), axis=1)
    spans = pairs.t_ns[pairs.images[asked][median < STILL]]
    if not len(spans):
        return None
    start, end = _joined(spans)
    source = np.full(len(start), SOURCE, dtype=object)
    return StaticPeriod(t_ns=start, t_end_ns=end, sigma_v=np.full(len(start), SPEED_SIGMA), source=source)


def _joined(spans: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Start and end of the unions of spans (n, 2)."""
    spans = spans[np.argsort(spans[:, 0], kind="stable")]
    reach = np.maximum.accumulate(spans[:, 1])
    new = np.concatenate([[True], spans[1:, 0] > reach[:-1]])
    last = np.concatenate([np.flatnonzero(new)[1:] - 1, [len(spans) - 1]])
    return spans[new, 0], reach[last]

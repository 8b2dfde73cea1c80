"""Fewer points, same picture: how lines, bands and dots are thinned before they are drawn.

* A line over time: the lowest and the highest point of each of many equal buckets are kept (so that spikes
  remain), with the first and the last point of the line.
* A band: of each bucket the lowest lower and the highest upper edge.
* A path on the map: Ramer-Douglas-Peucker (Douglas and Peucker 1973), the tolerance doubled until it fits.
* Dots: an even random choice with a fixed seed (every 9th row would show one axis only), outliers first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats

MOST = 2400


def _buckets(x: Floats, buckets: int) -> NDArray[np.intp]:
    """Bucket number (n,) of each x."""
    span = x[-1] - x[0]
    return np.asarray(np.minimum((x - x[0]) / (span or 1.0) * buckets, buckets - 1), dtype=np.intp)


def thin_line(x: Floats, y: Floats, most: int = MOST) -> tuple[Floats, Floats]:
    """Lowest and highest point of each of `most` / 2 - 2 buckets, both ends, and every break (NaN).

    x must not decrease. A line of at most `most` points is returned as it is.
    """
    if len(x) <= most:
        return x, y
    bucket = _buckets(x, most // 2 - 2)
    known = np.where(np.isfinite(y), y, np.inf), np.where(np.isfinite(y), y, -np.inf)
    low = np.lexsort((known[0], bucket))
    high = np.lexsort((-known[1], bucket))
    keep = [0, len(x) - 1, *_firsts(bucket[low], low), *_firsts(bucket[high], high)]
    breaks = np.flatnonzero(~np.isfinite(y))
    index = np.unique(np.concatenate([np.array(keep), breaks[: most // 4]]))
    return x[index], y[index]


def _firsts(bucket: NDArray[np.intp], order: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.asarray(order[np.concatenate([[True], np.diff(bucket) > 0])])


def thin_band(x: Floats, low: Floats, high: Floats, most: int = MOST // 4) -> tuple[Floats, Floats, Floats]:
    """The widest band of each of `most` buckets; rows that are not finite are left out."""
    good = np.isfinite(low) & np.isfinite(high)
    x, low, high = x[good], low[good], high[good]
    if len(x) <= most:
        return x, low, high
    starts = np.flatnonzero(np.concatenate([[True], np.diff(_buckets(x, most)) > 0]))
    middle = np.add.reduceat(x, starts) / np.diff(np.append(starts, len(x)))
    middle[0], middle[-1] = x[0], x[-1]
    return middle, np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)


def thin_dots(special: NDArray[np.bool_], most: int = MOST) -> NDArray[np.intp]:
    """Indices of at most `most` dots: up to half of them `special` ones, the rest chosen evenly at random."""
    if len(special) <= most:
        return np.arange(len(special))
    rng = np.random.default_rng(0)  # fixed: the same run gives the same page

    def some(rows: NDArray[np.intp], n: int) -> NDArray[np.intp]:
        return rows if len(rows) <= n else rng.choice(rows, n, replace=False)

    marked = some(np.flatnonzero(special), most // 2)
    return np.sort(np.concatenate([marked, some(np.flatnonzero(~special), most - len(marked))]))


def thin_path(xy: Floats, tolerance: float, most: int = MOST) -> NDArray[np.intp]:
    """Indices of the rows of a plane path (n, 2) that keep it within `tolerance`, doubled until <= `most` stay."""
    keep = _douglas_peucker(xy, tolerance)
    while keep.sum() > most:
        tolerance *= 2
        keep = _douglas_peucker(xy, tolerance)
    return np.flatnonzero(keep)


def _douglas_peucker(xy: Floats, tolerance: float) -> NDArray[np.bool_]:
    keep = np.zeros(len(xy), dtype=bool)
    keep[[0, -1]] = True
    stack = [(0, len(xy) - 1)]
    while stack:
        first, last = stack.pop()
        if last - first < 2:
            continue
        distance = _from_segment(xy[first + 1 : last], xy[first], xy[last])
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            middle = first + 1 + worst
            keep[middle] = True
            stack += [(first, middle), (middle, last)]
    return keep


def _from_segment(points: Floats, a: Floats, b: Floats) -> Floats:
    """Distance of points (n, 2) from the segment a b."""
    along = b - a
    share = np.clip((points - a) @ along / max(float(along @ along), 1e-30), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - (a + share[:, None] * along), axis=1))

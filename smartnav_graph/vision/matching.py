"""Matches of two pictures by their descriptors.

``ratio``    mutual nearest neighbours whose distance is at most `RATIO` times that of the second nearest (Lowe 2004)
``thesis``   of the nearest neighbours the 15 best, none farther than three times the smallest distance

Source: Lowe (2004), Distinctive image features from scale-invariant keypoints, IJCV 60(2), 7.1. The other is the rule
of the SmartNav system of 2012.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError

Rows = NDArray[np.intp]

POLICIES = ("ratio", "thesis")
RATIO = 0.8  # of the ratio test
THESIS_BEST = 15
THESIS_TIMES = 3.0


class Pairing(NamedTuple):
    """Matched rows (m,) of the first and of the second picture, with a score (m,), smaller is better.

    The score of ``ratio`` is the ratio of distances, that of ``thesis`` the distance over the smallest.
    """

    first: Rows
    second: Rows
    score: Floats


def pair(one: NDArray[np.generic], other: NDArray[np.generic], policy: str = "ratio") -> Pairing:
    """Match descriptors (n, k) and (m, k): bits in bytes (Hamming distance), or floats (Euclidean).

    Raises
    ------
    ConfigError
        Unknown policy.
    """
    if policy not in POLICIES:
        raise ConfigError("--policy", f"unknown policy {policy!r}", f"one of {', '.join(POLICIES)}")
    if len(one) < 2 or len(other) < 2:
        return Pairing(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), np.zeros(0))
    distance, nearest = _nearest(one, other, 2)
    if policy == "thesis":
        return choose_thesis(distance[:, 0], nearest[:, 0])
    share = distance[:, 0] / np.maximum(distance[:, 1], np.finfo(float).tiny)
    rows = np.flatnonzero((share <= RATIO) & (distance[:, 1] > 0))
    if not len(rows):
        return Pairing(rows, rows, np.zeros(0))
    columns, back = np.unique(nearest[rows, 0], return_inverse=True)
    returned = _nearest(other[columns], one, 1)[1][:, 0]
    rows = rows[returned[back] == rows]
    return Pairing(rows, nearest[rows, 0], share[rows])


def choose_thesis(distance: Floats, nearest: Rows) -> Pairing:
    """The 15 best of nearest neighbours (n,), none farther than three times the smallest distance."""
    best = np.argsort(distance, kind="stable")[:THESIS_BEST]
    best = best[distance[best] <= THESIS_TIMES * distance[best[0]]]
    least = max(float(distance[best[0]]), 1e-9)
    return Pairing(best, nearest[best], distance[best] / least)


def _nearest(one: NDArray[np.generic], other: NDArray[np.generic], count: int) -> tuple[Floats, Rows]:
    """Distances and rows (n, count) of the nearest of `other`."""
    import cv2

    norm = cv2.NORM_HAMMING if one.dtype == np.uint8 else cv2.NORM_L2
    distance, rows = cv2.batchDistance(one, other, -1, normType=norm, K=count)
    return np.asarray(distance, dtype=np.float64), np.asarray(rows, dtype=np.intp)

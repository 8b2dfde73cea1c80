"""Names of the array types that are used everywhere, and runs of true values in a mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]  # ns
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
Texts = NDArray[np.object_]
Column = NDArray[np.generic]  # of a table: numbers, time stamps or text
Table = dict[str, Column]  # columns by name


def runs(mask: Mask) -> Indices:
    """First row and row after the last (k, 2) of every run of true values in a mask (n,)."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    return np.stack([np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)], axis=1)

"""The baseline of the Allan deviation: its formula in NumPy, as in allantools, and the readings for both.

python scripts/bare_allan.py        one JSON line: processor seconds, sum of all deviations
"""

from __future__ import annotations

import json
import time

import numpy as np

AXES, HOURS, RATE_HZ, CLUSTER_TIMES = 6, 6, 100.0, 46


def readings() -> np.ndarray:
    """White noise (n, 6) beside a bias."""
    count = int(HOURS * 3600 * RATE_HZ)
    return 0.02 + 1e-3 * np.random.default_rng(0).standard_normal((count, AXES))


def deviations(rows: np.ndarray) -> np.ndarray:
    sizes = np.unique(np.round(np.logspace(0, np.log10(len(rows) // 3), CLUSTER_TIMES + 4)).astype(int))
    found = []
    for column in rows.T:
        x = np.concatenate([[0.0], np.cumsum(column - column.mean())])
        for m in sizes:
            second = x[2 * m :] - 2 * x[m:-m] + x[: -2 * m]
            found.append(np.sqrt(np.sum(second**2) / (2 * len(second))) / m)
    return np.array(found)


if __name__ == "__main__":
    given = readings()
    begin = time.process_time()
    total = float(deviations(given).sum())
    print(json.dumps({"seconds": time.process_time() - begin, "sum": total}))

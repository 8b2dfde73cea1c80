"""Whether fixes with stated sigmas have errors that last, as those of code receivers do.

A solution follows such errors, and its residuals hide them. What is left is compared by the Bayes factor of a
first-order Gauss-Markov error x of the fixes, of covariance K, against none,

    log B = s^T (1 + K I)^-1 K s / 2 - log det(1 + K I) / 2

with information I and score s of the errors of each fix (`smoothers.sensitivity`).

Source: Rasmussen, Williams (2006), Gaussian Processes for Machine Learning, 5.4; Kass, Raftery (1995), JASA 90, 773.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.factors.gnss import PositionBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.update import Builder
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.sensitivity import LinearSystem, Sensitivity

# Errors that are looked for: amplitude in units of the stated sigmas, and correlation time, s.
LASTING = ((1.0, 10.0), (2.0, 20.0))
# Logarithm of the Bayes factor from which they are more likely than not.
EVIDENCE = 0.0
# Fixes needed, those looked at, and the least sigma (m): below it clocks and lever arms are no better.
LEAST_FIXES, MOST_FIXES, LEAST_SIGMA = 30, 120, 0.1


def lasting_errors(
    builders: Iterable[Builder], estimate: Estimate, pass_state: PassState, linear: LinearSystem | None = None
) -> frozenset[str]:
    """Sensors whose fixes have errors that last, and neither a state for them nor sigmas found by the run; linear : the
    system of the estimate, where it is there already."""
    asked = [
        builder
        for builder in position_builders(builders)
        if builder.config.correlated
        and builder.name not in pass_state.correlated
        and builder.has_sigmas
        and float(np.median(builder.sigma[:, :2])) >= LEAST_SIGMA
    ]
    if not asked:
        return frozenset()
    linear = linear or LinearSystem(estimate)
    return frozenset(b.name for b in asked if _evidence(b, linear, estimate, pass_state) > EVIDENCE)


def _evidence(builder: PositionBuilder, linear: LinearSystem, estimate: Estimate, pass_state: PassState) -> float:
    """Largest logarithm of the Bayes factors of `LASTING`, horizontal errors and those of heights that count."""
    rows = linear.at_poses(builder.name)[:MOST_FIXES]
    if len(rows) < LEAST_FIXES:
        return -np.inf
    R = estimate.states()[0]
    sigma = builder.scaled_sigma(pass_state)[[part.name.row for part, _, _ in rows]]
    axes = 3 if builder.measures_height.all() else 2
    errors = [
        [(part.row, (by @ R[row].T)[:, axis] * sigma[k, axis])]
        for axis in range(axes)
        for k, (part, by, row) in enumerate(rows)
    ]
    found = linear.sensitivity(errors)
    t = np.array([part.name.t_ns - rows[0][0].name.t_ns for part, _, _ in rows]) / NS
    apart = np.abs(t[:, None] - t)
    return max(_log_factor(size**2 * np.exp(-apart / time), axes, found) for size, time in LASTING)


def _log_factor(one: Floats, axes: int, found: Sensitivity) -> float:
    """By the covariance (n, n) of the errors of one axis."""
    K = np.kron(np.eye(axes), one)
    matrix = np.eye(len(K)) + K @ found.information
    explained = 0.5 * found.score @ np.linalg.solve(matrix, K @ found.score)
    return float(explained - 0.5 * np.linalg.slogdet(matrix)[1])

"""Noise of a constraint's rows found from kept data, with their correlation counted.

A car that slips sideways slips on for seconds: rows a second apart are no independent samples. Taken as white with the
sigma of one row they weigh too much, with

    sigma^2 = sigma_1^2 (1 + 2 sum_k rho_k)

as much as they should for whatever lasts longer than they hang together (rho_k: autocorrelation of the residuals at lag
k, up to its first zero). sigma_1 is the variance component sum r^2 / redundancy, held softly at the class default, and
never below it: where fixes are weak the solution follows a slow slip, and the residuals show only its fast part.

Source: Koch (1999), Parameter estimation, 3.6; Priestley (1981), Spectral Analysis and Time Series, 5.3.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.update import Builder
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.whole_graph import StackedFactors

# What the class default counts, in independent rows.
PRIOR_ROWS = 20.0
LEAST_ROWS = 10
# Lags looked at, as a share of the rows: longer ones are noise.
LONGEST_LAG = 0.2


def correlation_factor(rows: Floats) -> float:
    """1 + 2 sum_k rho_k of evenly spaced rows (m,), the sum up to the first lag that is not positive; at least 1."""
    square = float((rows**2).sum())
    total = 1.0
    for lag in range(1, int(LONGEST_LAG * len(rows)) + 1):
        rho = float((rows[lag:] * rows[:-lag]).sum()) / square
        if rho <= 0:
            break
        total += 2.0 * rho
    return total


def _unexplained(stack: StackedFactors, jacobians: list[Floats], estimate: Estimate) -> Floats:
    """Share (m, d) of each residual's variance that the solution left: 1 - J P J^T over pose and velocity."""
    letters = stack.model.letters
    by_state = np.concatenate([jacobians[letters.index("X")], jacobians[letters.index("V")]], axis=2)
    place = np.searchsorted(estimate.t_ns, stack.t_ns)
    P = estimate.marginals.joint[place][:, :9, :9]
    return np.asarray(np.clip(1.0 - np.einsum("mdi,mij,mdj->md", by_state, P, by_state), 0.0, 1.0))


def _scales(
    stack: StackedFactors, groups: Iterable[str], estimate: Estimate, pass_state: PassState
) -> dict[str, float]:
    white, jacobians = stack.linearize(estimate.snapshot)
    weight = stack.weight(white) * stack.used
    left = _unexplained(stack, jacobians, estimate)
    found = {}
    for axis, group in enumerate(groups):
        rows = np.sqrt(weight) * white[:, axis]
        redundancy = float(left[stack.used, axis].sum())
        if redundancy < LEAST_ROWS or not rows.any():
            continue
        factor = correlation_factor(rows[stack.used])
        scale = pass_state.scale(group)
        independent = redundancy / factor
        square = (scale**2 * float((rows**2).sum()) + PRIOR_ROWS) / (independent + PRIOR_ROWS)
        found[group] = max(1.0, float(np.sqrt(square)))
    return found


def row_scales(builders: Iterable[Builder], estimate: Estimate, pass_state: PassState) -> dict[str, float]:
    """Scales on the class sigmas of every builder that names its `noise_groups`."""
    found: dict[str, float] = {}
    for builder in builders:
        groups = builder.noise_groups
        for stack in estimate.stacks(builder.name) if groups else ():
            found |= _scales(stack, groups, estimate, pass_state)
    return found

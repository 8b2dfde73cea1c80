"""Measures by which tests compare solutions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from smartnav_graph.core.arrays import Floats
from smartnav_graph.smoothers.estimate import Estimate, state_distance


def largest_difference(one: Estimate, other: Estimate) -> tuple[float, float]:
    """Largest distance m and rotation angle deg over the keyframes of two estimates of the same problem."""
    return state_distance(one.states(), other.states())


def wrap_deg(angle: ArrayLike) -> Floats:
    """Angles in degrees wrapped to [-180, 180)."""
    return (np.asarray(angle, dtype=np.float64) + 180.0) % 360.0 - 180.0


def chi2_bounds(dof: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided interval that one NEES of `dof` degrees of freedom lies in with `probability`."""
    tail = 0.5 * (1.0 - probability)
    return float(chi2.ppf(tail, dof)), float(chi2.ppf(1.0 - tail, dof))


def average_nees_bounds(dof: int, samples: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided interval for the mean of `samples` independent NEES values of `dof` degrees of freedom.

    samples * mean ~ chi2(samples * dof). Successive epochs of one smoothed trajectory are not independent:
    the bounds hold across runs, and are too narrow along one run.
    """
    low, high = chi2_bounds(dof * samples, probability)
    return low / samples, high / samples

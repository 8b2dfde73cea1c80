"""The chi-square distribution, and quantiles of the normal and of Student's; `scipy.stats` takes 0.5 s to load.

Source: DLMF 8.2 (incomplete gamma functions), 8.17 (incomplete beta functions); the functions of scipy.special.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core.arrays import Floats


def ppf(probability: ArrayLike, dof: ArrayLike) -> Floats:
    """The value that chi-square with `dof` degrees of freedom stays below with a probability."""
    from scipy import special

    return np.asarray(2.0 * special.gammaincinv(np.asarray(dof) / 2.0, probability))[()]


def sf(square: ArrayLike, dof: ArrayLike) -> Floats:
    """The probability that chi-square with `dof` degrees of freedom exceeds a value."""
    from scipy import special

    return np.asarray(special.chdtrc(dof, square))[()]


def isf(probability: ArrayLike, dof: ArrayLike) -> Floats:
    """The value that chi-square with `dof` degrees of freedom exceeds with a probability."""
    from scipy import special

    return np.asarray(special.chdtri(dof, probability))[()]


def normal_ppf(probability: ArrayLike) -> Floats:
    """The value that a standard normal variable stays below with a probability."""
    from scipy import special

    return np.asarray(special.ndtri(probability))[()]


def student_ratio(dof: ArrayLike) -> Floats:
    """By how much an interval of 95 % is wider with a sigma of `dof` residuals than with one that is known."""
    from scipy import special

    return np.asarray(special.stdtrit(dof, 0.975) / special.ndtri(0.975))[()]


def student_limit(sigmas: float, dof: ArrayLike) -> Floats:
    """The value that Student's t with `dof` degrees of freedom exceeds as often as a normal variable `sigmas`."""
    from scipy import special

    return np.asarray(-special.stdtrit(dof, special.ndtr(-sigmas)))[()]

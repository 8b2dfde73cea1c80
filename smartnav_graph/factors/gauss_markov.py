"""Position fixes with a correlated error: a first-order Gauss-Markov state beside the white part.

    r = (nav_t_antenna + c - fix) / sigma        c_j = phi c_i + q,  phi = exp(-dt / tau)

Fixes of code receivers (phones) share their atmospheric and multipath errors for a minute or so. Taken as white they
make the covariance many times too small; scaling the sigma does not help.

Source: Gelb (1974), Applied Optimal Estimation, 3.8; Niu et al. (2014), GPS Solutions 18(2), on GNSS position noise.
"""

from __future__ import annotations

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import FactorId, GraphUpdate
from smartnav_graph.graph.windows import PerWindow, Window
from smartnav_graph.session.calibration.model import GnssNoise

Ties = PerWindow[gtsam.NonlinearFactor]


def correlated_sigma(noise: GnssNoise) -> Floats:
    """Sigma (3,) m of the correlated part, nav axes."""
    h, v = noise.correlated_horizontal_sigma, noise.correlated_vertical_sigma
    return np.array([h, h, v])


def add_correlated_error(
    update: GraphUpdate, window: Window, previous: State | None, noise: GnssNoise, ties: Ties
) -> None:
    """The Gauss-Markov state of one keyframe and its tie to the one before; ties : of earlier passes."""
    name = key("C", window.index)
    update.chain[name] = np.zeros(3)
    sigma, tag = correlated_sigma(noise), FactorId("gnss_correlated_error", window.t1_ns)
    if previous is None:
        update.add(tag, gtsam.PriorFactorVector(name, np.zeros(3), gtsam.noiseModel.Diagonal.Sigmas(sigma)))
        return

    def tie(window: Window) -> gtsam.NonlinearFactor:
        phi = float(np.exp(-window.length_s / noise.correlated_time))
        root = np.diag(1.0 / (sigma * np.sqrt(1.0 - phi**2)))
        return decay(key("C", window.index - 1), name, phi, root)

    update.add(tag, ties.of(window, tie))


def decay(before: int, after: int, phi: float, root: Floats) -> gtsam.NonlinearFactor:
    """Factor root (c_after - phi c_before) = 0 of two vectors (n,); root (n, n) whitens."""
    zero, origin = np.zeros(len(root)), gtsam.Values()
    linear = gtsam.JacobianFactor(before, -phi * root, after, root, zero, gtsam.noiseModel.Unit.Create(len(root)))
    for name in (before, after):  # without a linearisation point GTSAM counts the factor as zero cost
        origin.insert(name, zero)
    return gtsam.LinearContainerFactor(linear, origin)

"""Whether the heading is known.

Fixes and inertial data show it where the velocity changes. At rest nothing but noise turns with the heading; linearised
at the estimate, that noise passes for information, and a sigma of some 20 deg comes out where every heading fits.
"""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.estimate.result.assemble import SolvedProblem
from smartnav_graph.factors.pose_fix import ATTITUDE
from smartnav_graph.factors.prior import UNKNOWN_ANGLE

# Sigma of the heading, deg, from which twice of it is no less than a quarter turn to either side.
OPEN_DEG = 45.0
# Square over variance of a change of the velocity that is none by chance: once in 3 million.
CLEAR = 30.0
# Distance (m) between position sensors of one device from which they show its heading.
LEAST_APART_M = 0.1


def heading_known(solved: SolvedProblem, start_sigma_deg: float) -> bool:
    """Whether the start shows the heading, or a sensor of attitudes, or sensors apart from each other, or the velocity,
    which clearly changes between two keyframes."""
    estimate, session = solved.estimate, solved.problem.session
    sensors = {name.sensor for name, _ in estimate.factors} | {block.sensor for block in estimate.blocks}
    arms = [session.lever_arms(stream) for stream in session.positions().values()]
    apart = float(np.ptp(np.concatenate(arms), axis=0).max()) if arms else 0.0
    if start_sigma_deg < OPEN_DEG or sensors & {"magnetometer", ATTITUDE} or apart > LEAST_APART_M:
        return True
    joint, following = (
        np.diagonal(p, axis1=1, axis2=2)[:, 6:8] for p in (estimate.marginals.joint, estimate.marginals.following)
    )
    variance = (joint[:-1] + joint[1:] - 2.0 * following).mean(axis=1)
    change = np.diff(estimate.states()[2][:, :2], axis=0)
    return bool(((change**2).sum(axis=1) > CLEAR * variance).any())


def with_unknown_heading(covariance: Floats) -> Floats:
    """Covariances (n, 15, 15) whose rotation about the vertical has at least the variance of a uniform angle."""
    found = covariance.copy()
    found[:, 2, 2] = np.maximum(found[:, 2, 2], UNKNOWN_ANGLE**2)
    return found

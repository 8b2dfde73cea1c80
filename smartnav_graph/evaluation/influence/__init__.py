"""Influence of every measurement on a state: the linear system at the solution, stored with the run.

Whitened rows J dx = b of all factors at the solution, b = -r, under their loss. With P = (J^T J)^-1 and P_k its columns
of keyframe k, the row f moves the state of that keyframe by K_f b_f, with K = P_k^T J^T (15 rows), so that

    sum_f K_f K_f^T = P_kk        share of f in the variance of component i: K_if^2 / P_ii, one in all
    sum_f K_f b_f = 0             the shifts K_f b_f balance at the solution

A share is also the square of a sensitivity: a change of f by its own sigma changes component i by sqrt(share) sigmas. A
shift is how far the residual of f moves the state against all others. J_fk^T J_fk is the information of the factors
that touch the keyframe if all its neighbours were known. P without the rows of one source shows what depends on it.

Source: Teunissen (2003), Adjustment theory, 2.4; Cook, Weisberg (1982), Residuals and Influence in Regression, 2.
"""

from smartnav_graph.evaluation.influence.factors import FACTORS, KEYFRAMES, Group, Influence, Keyframes
from smartnav_graph.evaluation.influence.keyframe_influence import (
    KeyframeInfluence,
    Measurements,
    influence_of_keyframe,
)
from smartnav_graph.smoothers.redundancy import CALIBRATION

__all__ = [
    "CALIBRATION",
    "FACTORS",
    "KEYFRAMES",
    "Group",
    "Influence",
    "KeyframeInfluence",
    "Keyframes",
    "Measurements",
    "influence_of_keyframe",
]

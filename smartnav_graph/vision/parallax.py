"""Rays of two cameras after the rotation is removed: parallax, and which matches lie in front (cheirality).

Source: Hartley, Zisserman (2004), Multiple View Geometry, 9.6.2 (the four poses of one essential matrix).
"""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp
from smartnav_graph.vision.epipolar import cross, rays
from smartnav_graph.vision.refine import MatchedPoints, angle

CLEAR = 3.0  # sigmas of parallax beyond which front and behind are certain
ALIKE = 0.1  # share of the matches: smallest significant difference of votes between two poses


def in_front(matched: MatchedPoints, R: Floats, t: Floats) -> Floats:
    """Vote (m,) of every match: 1 in front of both cameras, -1 behind one, nearer to 0 the less parallax it has.

    Depths a, b of x0~ a = y b + t with y = R x1~ and n = x0~ x y: a = (t x y) . n / n^2, b = (t x x0~) . n / n^2.
    """
    a, y = rays(matched.xy0), rays(matched.xy1) @ R.T
    n = cross(a, y)
    first = (cross(t, y) * n).sum(axis=1)
    second = (cross(t, a) * n).sum(axis=1)
    sine = np.sqrt((n * n).sum(axis=1) / ((a * a).sum(axis=1) * (y * y).sum(axis=1)))
    weight = np.minimum(sine / (CLEAR * matched.sigma), 1.0)
    return np.asarray(np.where((first > 0) & (second > 0), weight, -weight))


def cheirality(matched: MatchedPoints, R: Floats, t: Floats, *, known_rotation: bool) -> tuple[Floats, Floats]:
    """Of the four poses of one essential matrix the one with the scene in front: c0_R_c1, c0_t_c1.

    Of two equally good poses that of the smaller rotation is taken: without parallax the matches cannot distinguish the
    second one, half a turn about the baseline. With a known rotation there is no second one.
    """
    second = exp(np.pi * t) @ R
    turns = [R] if known_rotation else [R, second]
    poses = [(turn, side * t) for turn in turns for side in (1.0, -1.0)]
    votes = [float(in_front(matched, *pose).sum()) for pose in poses]
    least = max(votes) - ALIKE * len(matched.sigma)
    angles = [angle(pose[0]) for pose in poses]
    best = min(range(len(poses)), key=lambda k: (votes[k] < least, round(angles[k], 9), -votes[k]))
    return poses[best]

"""Trajectories of other programs, without covariances, compared like a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import from_quaternion
from smartnav_graph.core.timebase import seconds_since
from smartnav_graph.graph.solution import Solution
from smartnav_graph.session.streams import Reference


def as_solution(track: Reference, reference: Reference, where: str) -> tuple[Solution, Reference]:
    """The trajectory as a solution whose covariances and biases are not known (NaN), and the reference to compare it
    with. Without velocity, that of the positions is taken; without attitude that of the reference is left out.

    Raises
    ------
    SessionError
        Fewer than two rows; `where` they are from.
    """
    n = len(track)
    if n < 2:
        raise SessionError(where, f"has {n} rows", "at least two", "give a whole trajectory")
    t0_ns = int(track.t_ns[0])
    velocity = track.velocity
    if velocity is None:
        velocity = np.gradient(track.enu, seconds_since(track.t_ns, t0_ns), axis=0)
    rotation = np.broadcast_to(np.eye(3), (n, 3, 3)) if track.quat is None else from_quaternion(track.quat)
    unknown = np.full((n, 3), np.nan)
    solution = Solution(
        t_ns=track.t_ns,
        nav_R_body=rotation,
        nav_t_body=track.enu,
        nav_v_body=velocity,
        accel_bias=unknown,
        gyro_bias=unknown,
        covariance=np.full((n, 15, 15), np.nan),
        t0_ns=t0_ns,
    )
    return solution, replace(reference, quat=None) if track.quat is None else reference

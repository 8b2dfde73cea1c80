"""How far two solutions of one session are apart."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from smartnav_graph.errors import SessionError
from smartnav_graph.evaluation.align import Track, track_of_solution
from smartnav_graph.evaluation.metrics import Statistics, rotation_error_deg
from smartnav_graph.solution import POS, ROT, VEL, Solution


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Magnitudes of the differences at common epochs, and the median ratio of the sigmas, second over first."""

    epochs: int
    position_m: Statistics
    rotation_deg: Statistics
    velocity_m_s: Statistics
    sigma_ratio: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """The figures."""
        return asdict(self)


def compare(first: Solution, second: Solution) -> Comparison:
    """Two solutions at their common stamps; without at least two of them, at the stamps of the first inside the second.

    Raises
    ------
    SessionError
        They have no time in common.
    """
    one, other = track_of_solution(first), track_of_solution(second)
    common = np.isin(one.t_ns, other.t_ns)
    inside = one.take(common if common.sum() >= 2 else one.inside(other))
    if not len(inside):
        raise SessionError("compare", "the two runs have no time in common", "two runs of one session")
    at = other.at(inside.t_ns)
    angle = rotation_error_deg(inside, at)
    assert angle is not None and inside.velocity is not None and at.velocity is not None
    return Comparison(
        epochs=len(inside),
        position_m=Statistics.of(np.linalg.norm(at.position - inside.position, axis=1)),
        rotation_deg=Statistics.of(angle),
        velocity_m_s=Statistics.of(np.linalg.norm(at.velocity - inside.velocity, axis=1)),
        sigma_ratio={
            name: _sigma_ratio(inside, at, block)
            for name, block in (("position", POS), ("rotation", ROT), ("velocity", VEL))
        },
    )


def _sigma_ratio(one: Track, other: Track, block: slice) -> float:
    assert one.covariance is not None and other.covariance is not None
    of_one, of_other = (
        np.trace(covariance[:, block, block], axis1=1, axis2=2) for covariance in (one.covariance, other.covariance)
    )
    return float(np.median(np.sqrt(of_other / of_one)))

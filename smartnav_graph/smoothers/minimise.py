"""Levenberg-Marquardt over `graph.linearize`, Gauss-Newton first.

The loop is ours because GTSAM's own copies all values into Python for every custom factor, and because an elimination
order of our own makes the marginals cheap. Damping comes only when a Gauss-Newton step does not lower the cost.

Source: Nocedal, Wright (2006), Numerical Optimization, 10.3; Grippo, Lampariello, Lucidi (1986), SIAM J. Numer. Anal.
23(4), 707 (steps that lower the largest of the last costs).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from smartnav_graph.core.errors import ConfigError, SolverError
from smartnav_graph.graph.states import STATES, damping_scales, kind_of
from smartnav_graph.smoothers.whole_graph import WholeGraph


@dataclass(frozen=True)
class SolveConfig:
    """max_iterations : most steps of one solve; tolerance : relative decrease of the cost that ends it, together with
    step_tolerance, a ratio; step_tolerance : the largest step, a ratio of a third of a radian, 100 m, 10 m/s.
    Gauss-Newton steps shrink quadratically: after one of 1e-3 the next would be of 1e-6.
    """

    max_iterations: int = 50
    tolerance: float = 1e-5
    step_tolerance: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("max_iterations", "tolerance", "step_tolerance"):
            if not getattr(self, name) > 0:
                raise ConfigError("config [solver]", f"{name} = {getattr(self, name)}", "> 0")


# Iterations in a row that no longer lower the cost end the search even where a state that nothing holds still moves.
FLAT = 3

# A Gauss-Newton step may cost more than the last one, not more than all of so many: along a curved valley the next
# ones are lower than damped steps would come to.
RECENT = 4

# Enough to go on from: a later solve finishes the work.
COARSE = SolveConfig(max_iterations=40, tolerance=0.03, step_tolerance=1.0)
FIRST = SolveConfig(max_iterations=40, tolerance=1e-4, step_tolerance=1e-2)


@dataclass(frozen=True)
class Solve:
    """Result of `minimise`."""

    values: gtsam.Values
    cost: float
    iterations: int
    converged: bool


def minimise(
    graph: WholeGraph,
    values: gtsam.Values,
    order: gtsam.Ordering,
    config: SolveConfig,
    reintegrate: Callable[[gtsam.Values], gtsam.Values] | None = None,
    enough: float = 0.0,
) -> Solve:
    """Levenberg-Marquardt with Gauss-Newton steps first; ends at once at a cost of `enough`.

    `reintegrate` replaces the states of a candidate by those predicted from its first state. Where a step fails only
    because rotations far along the segment curve (an unknown gyro bias), reintegration reaches the valley floor.

    Raises
    ------
    RuntimeError
        GTSAM finds the linear system indeterminate with Cholesky and with QR.
    SolverError
        The cost is not finite, or no step lowers it.
    """
    cost = graph.error(values)
    if not np.isfinite(cost):
        raise SolverError("solve", f"cost {cost} at the start", "finite measurements and initial values")
    damping_scale = damping_scales(np.array(list(values.keys()), dtype=np.uint64))
    damping, iterations, converged, flat = 0.0, 0, False, 0
    recent = deque([cost], RECENT)
    while iterations < config.max_iterations and not converged:
        iterations += 1
        linear = graph.linearize(values)
        while True:
            delta = _step(linear, order, damping)
            candidate, new_cost = _better(graph, values.retract(delta), cost, reintegrate)
            if new_cost <= (cost if damping else max(recent)) * (1 + 1e-9) + 1e-12:
                break
            damping = max(10.0 * damping, 1e-2)
            if damping > 1e10:
                return Solve(values, cost, iterations, _stationary(linear, order))
        small = float((np.abs(delta.vector()) / damping_scale).max()) < config.step_tolerance
        flat = flat + 1 if abs(cost - new_cost) <= config.tolerance * max(new_cost, 1.0) else 0
        converged = new_cost <= enough or (damping <= 1.0 and flat > 0 and (small or flat >= FLAT))
        values, cost, damping = candidate, new_cost, damping / 10.0 if damping > 1e-2 else 0.0
        recent.append(cost)
    return Solve(values, cost, iterations, converged)


def _better(
    graph: WholeGraph, candidate: gtsam.Values, cost: float, reintegrate: Callable[[gtsam.Values], gtsam.Values] | None
) -> tuple[gtsam.Values, float]:
    """The candidate, reintegrated where it does not lower the cost; the cost is infinite where it is not finite."""
    own = graph.error(candidate)
    if reintegrate is None or own < cost:
        return candidate, own if np.isfinite(own) else np.inf
    reintegrated = reintegrate(candidate)
    other = graph.error(reintegrated)
    costs = [(c, v) for c, v in ((own, candidate), (other, reintegrated)) if np.isfinite(c)]
    new_cost, best = min(costs, key=lambda item: item[0], default=(np.inf, candidate))
    return best, new_cost


def _step(linear: gtsam.GaussianFactorGraph, order: gtsam.Ordering, damping: float) -> gtsam.VectorValues:
    if damping:
        linear = linear.clone()
        damper = {
            letter: (
                np.diag(np.sqrt(damping) / kind.damping_scale),
                np.zeros(kind.dim),
                gtsam.noiseModel.Unit.Create(kind.dim),
            )
            for letter, kind in STATES.items()
        }
        for i in range(order.size()):
            name = order.at(i)
            rows, zero, unit = damper[kind_of(name).letter]
            linear.push_back(gtsam.JacobianFactor(name, rows, zero, unit))
    try:
        return linear.optimize(order)
    except RuntimeError:
        return linear.optimize(order, gtsam.EliminateQR)


def _stationary(linear: gtsam.GaussianFactorGraph, order: gtsam.Ordering) -> bool:
    """Whether the undamped step is negligible: nothing lowers the cost because it is lowest already."""
    return bool(np.abs(_step(linear, order, 0.0).vector()).max() < 1e-4)

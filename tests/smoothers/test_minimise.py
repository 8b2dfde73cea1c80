"""Levenberg-Marquardt on problems with known answers."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
import pytest

from smartnav_graph.core.errors import ConfigError, SolverError
from smartnav_graph.graph.states import key
from smartnav_graph.smoothers.minimise import SolveConfig, minimise

X, V = key("X", 0), key("V", 0)
TIGHT = SolveConfig(tolerance=1e-14, step_tolerance=1e-12)


def ordering(*names: int) -> gtsam.Ordering:
    order = gtsam.Ordering()
    for name in names:
        order.push_back(name)
    return order


def at(*pairs: tuple[int, Any]) -> gtsam.Values:
    values = gtsam.Values()
    for name, value in pairs:
        values.insert(name, value)
    return values


def marks(truth: gtsam.Pose3) -> gtsam.NonlinearFactorGraph:
    """Four points of a body measured without error: zero residual at `truth`, nonlinear in its rotation."""
    graph = gtsam.NonlinearFactorGraph()
    model = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)
    for lever in ([2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0], [-1.0, -1.0, 1.0]):
        graph.add(gtsam.GPSFactorArm(X, truth.transformFrom(np.array(lever)), np.array(lever), model))
    return graph


def rosenbrock() -> gtsam.NonlinearFactorGraph:
    """r = (10 (y - x^2), 1 - x, z) / sqrt(1): minimum 0 at (1, 1, 0)."""

    def error(this: Any, values: Any, jacobians: Any) -> np.ndarray:
        x, y, z = values.atVector(V)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray([[-20.0 * x, 10.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return np.array([10.0 * (y - x**2), 1.0 - x, z])

    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3), [V], error))
    return graph


def test_a_linear_problem_takes_one_step():
    graph = gtsam.NonlinearFactorGraph()
    for point, sigma in (([1.0, 2.0, 3.0], 1.0), ([4.0, 2.0, 3.0], 2.0)):
        graph.add(gtsam.PriorFactorVector(V, np.array(point), gtsam.noiseModel.Isotropic.Sigma(3, sigma)))
    solve = minimise(graph, at((V, np.zeros(3))), ordering(V), SolveConfig())
    assert solve.values.atVector(V) == pytest.approx([1.6, 2.0, 3.0])  # (1 / 1 + 4 / 4) / (1 / 1 + 1 / 4)
    assert solve.converged and solve.iterations <= 2
    assert solve.cost == pytest.approx(0.5 * (0.6**2 + (2.4 / 2) ** 2))


def test_steps_shrink_quadratically_near_a_zero_residual():
    truth = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.0), np.array([10.0, -5.0, 2.0]))
    start = truth.retract(np.array([0.4, -0.5, 0.3, 3.0, 2.0, -1.0]))
    distance = []
    for count in range(1, 5):
        solve = minimise(marks(truth), at((X, start)), ordering(X), SolveConfig(max_iterations=count, tolerance=1e-30))
        distance.append(float(np.linalg.norm(truth.localCoordinates(solve.values.atPose3(X))[:3])))
    assert distance[0] < 0.3
    for before, after in pairwise(distance):
        assert after < max(2.0 * before**2, 1e-11)
    assert distance[3] < 1e-9  # rad


def test_a_gauss_newton_step_that_climbs_is_damped():
    """From (-1.2, 1) the first Gauss-Newton step of Rosenbrock's valley ends at (1, -3.84): 60 times the cost."""
    start = at((V, np.array([-1.2, 1.0, 0.0])))
    first = minimise(rosenbrock(), start, ordering(V), SolveConfig(max_iterations=1))
    assert first.cost < rosenbrock().error(start) and first.values.atVector(V)[1] > -3.0
    solve = minimise(rosenbrock(), start, ordering(V), SolveConfig(max_iterations=200, tolerance=1e-12))
    assert solve.values.atVector(V) == pytest.approx([1.0, 1.0, 0.0], abs=1e-5)
    assert solve.converged


def test_the_cost_never_rises():
    start = at((V, np.array([-1.2, 1.0, 0.0])))
    costs = [minimise(rosenbrock(), start, ordering(V), SolveConfig(max_iterations=n)).cost for n in range(1, 12)]
    assert all(after <= before * (1 + 1e-9) + 1e-12 for before, after in pairwise(costs))


def test_a_small_step_that_climbs_is_not_the_end():
    class Valley:
        """Steps of 1e-5, and costs as they come along a curved valley."""

        costs = iter([10.0, 9.0, 9.5, 5.0, 5.0])

        def linearize(self, values: Any) -> gtsam.GaussianFactorGraph:
            linear = gtsam.GaussianFactorGraph()
            linear.add(V, np.eye(3), np.full(3, 1e-5), gtsam.noiseModel.Unit.Create(3))
            return linear

        def error(self, values: Any) -> float:
            return next(self.costs)

    solve = minimise(Valley(), at((V, np.zeros(3))), ordering(V), SolveConfig())
    assert solve.converged and (solve.cost, solve.iterations) == (5.0, 4)


def test_the_iteration_limit_is_told():
    solve = minimise(rosenbrock(), at((V, np.array([-1.2, 1.0, 0.0]))), ordering(V), SolveConfig(max_iterations=3))
    assert not solve.converged and solve.iterations == 3


def test_a_start_at_the_minimum_stays():
    solve = minimise(rosenbrock(), at((V, np.array([1.0, 1.0, 0.0]))), ordering(V), TIGHT)
    assert solve.converged and solve.cost < 1e-20
    assert solve.values.atVector(V) == pytest.approx([1.0, 1.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_start_that_is_not_finite_is_refused(value):
    with pytest.raises(SolverError, match=r"solve: cost (nan|inf) at the start; expected finite measurements"):
        minimise(rosenbrock(), at((V, np.array([value, 0.0, 0.0]))), ordering(V), SolveConfig())


def test_a_shot_is_taken_where_the_step_fails():
    """`reintegrate` offers the minimum itself: one iteration is enough."""
    solve = minimise(
        rosenbrock(),
        at((V, np.array([-1.2, 1.0, 0.0]))),
        ordering(V),
        SolveConfig(max_iterations=1),
        lambda candidate: at((V, np.array([1.0, 1.0, 0.0]))),
    )
    assert solve.cost == 0.0


def test_an_unheld_state_is_refused():
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorVector(V, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)))
    graph.add(gtsam.GPSFactor(X, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)))  # says nothing of attitude
    with pytest.raises(RuntimeError, match=r"[Ii]ndetermina"):
        minimise(graph, at((V, np.zeros(3)), (X, gtsam.Pose3())), ordering(V, X), SolveConfig())


@pytest.mark.parametrize("field", ["max_iterations", "tolerance", "step_tolerance"])
def test_options(field):
    with pytest.raises(ConfigError, match=r"config \[solver\]"):
        SolveConfig(**{field: 0})

"""All steps at once: Levenberg-Marquardt over `graph.linearize`.

The loop is ours because GTSAM's own copies all values into Python for every custom factor, and because a nested
dissection of time makes the marginals four times cheaper. Gauss-Newton steps are tried first; damping comes when one
does not lower the cost.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from smartnav_graph.errors import ConfigError, SolverError
from smartnav_graph.graph import State, Step, Tag, key
from smartnav_graph.smoothers.estimate import (
    Estimate,
    elimination_order,
    indeterminate,
    nav_covariances,
    state_at,
)


@dataclass(frozen=True)
class BatchConfig:
    """settle_s : stretch after which the latest steps are solved by themselves, so that later windows start from an
    anchored state; tolerance, step_tolerance : relative decrease of the cost, and largest step in units of a
    third of a radian, 100 m, 10 m/s, that end the iteration."""

    max_iterations: int = 50
    tolerance: float = 1e-7
    step_tolerance: float = 1e-5
    settle_s: float = 30.0

    def __post_init__(self) -> None:
        if not (self.max_iterations > 0 and self.tolerance > 0 and self.settle_s > 0):
            raise ConfigError("config [batch]", "a value <= 0", "> 0")


# Step sizes that a damping of one holds a state to: rad, m; m/s; m/s^2, rad/s; m.
_TRUST = {
    "X": np.array([0.3] * 3 + [100.0] * 3),
    "V": np.full(3, 10.0),
    "B": np.array([0.3] * 3 + [0.02] * 3),
    "C": np.full(3, 10.0),
}


# Growing stretches shorter than this hold the first attitude.
HOLD_S = 10.0


@dataclass(frozen=True)
class Solve:
    """Result of `minimise`."""

    values: Any
    cost: float
    iterations: int
    converged: bool


def minimise(
    graph: Any,
    values: Any,
    order: gtsam.Ordering,
    config: BatchConfig,
    shoot: Callable[[Any], Any] | None = None,
) -> Solve:
    """Levenberg-Marquardt with Gauss-Newton steps first.

    `shoot` replaces the states of a candidate by those its first state foretells. Where a Gauss-Newton step fails only
    because rotations far along the stretch turn on curves (an unknown gyro bias), the shot finds the valley's floor.

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
    trust = np.concatenate([_TRUST[chr(gtsam.symbolChr(name))] for name in list(values.keys())])
    damping, iterations, converged = 0.0, 0, False
    while iterations < config.max_iterations and not converged:
        iterations += 1
        linear = graph.linearize(values)
        while True:
            delta = _step(linear, order, damping)
            candidate = values.retract(delta)
            new_cost = graph.error(candidate)
            if np.isfinite(new_cost) and new_cost <= cost * (1 + 1e-9) + 1e-12:
                break
            if shoot is not None and damping == 0.0:
                shot = shoot(candidate)
                shot_cost = graph.error(shot)
                if np.isfinite(shot_cost) and shot_cost < cost:
                    candidate, new_cost = shot, shot_cost
                    break
            damping = max(10.0 * damping, 1e-2)
            if damping > 1e10:
                return Solve(values, cost, iterations, _stationary(linear, order))
        small = float((np.abs(delta.vector()) / trust).max()) < config.step_tolerance
        converged = damping <= 1.0 and small and cost - new_cost <= config.tolerance * max(new_cost, 1.0)
        values, cost, damping = candidate, new_cost, damping / 10.0 if damping > 1e-2 else 0.0
    return Solve(values, cost, iterations, converged)


def _step(linear: Any, order: gtsam.Ordering, damping: float) -> Any:
    if damping:
        linear = linear.clone()
        for i in range(order.size()):
            name = order.at(i)
            scale = _TRUST[chr(gtsam.symbolChr(name))]
            model = gtsam.noiseModel.Unit.Create(len(scale))
            linear.push_back(gtsam.JacobianFactor(name, np.diag(np.sqrt(damping) / scale), np.zeros(len(scale)), model))
    try:
        return linear.optimize(order)
    except RuntimeError:
        return linear.optimize(order, gtsam.EliminateQR)


def _stationary(linear: Any, order: gtsam.Ordering) -> bool:
    """Whether the undamped step is negligible: nothing lowers the cost because it is lowest already."""
    return bool(np.abs(_step(linear, order, 0.0).vector()).max() < 1e-4)


@dataclass
class Batch:
    """Collects steps; `estimate` solves them.

    warm : values of an earlier pass, taken for every state they hold; unsure : the first state is a mere guess
    """

    config: BatchConfig = field(default_factory=BatchConfig)
    warm: Any = None
    t0_ns: int = 0
    unsure: bool = False
    steps: list[Step] = field(default_factory=list)
    values: Any = field(default_factory=gtsam.Values)
    _settled: int = 0
    _growth: float = 2.0
    _anchor: Any = None

    def latest(self) -> State | None:
        """Latest state: of the warm values, of the last settled stretch, or predicted since then."""
        if not self.steps:
            return None
        last = self.steps[-1]
        return state_at(self.values, last.index, last.t_ns)

    def update(self, step: Step) -> None:
        """Take one step; settle the latest stretch when it is long enough."""
        self.steps.append(step)
        if self.warm is not None:
            self._take_warm(step)
            return
        self.values.insert(step.values())
        since = step.t_s - self.steps[self._settled].t_s
        if since >= self._stretch():
            self._settle(since)

    def _take_warm(self, step: Step) -> None:
        i = step.index
        self.values.insert(key("X", i), self.warm.atPose3(key("X", i)))
        self.values.insert(key("V", i), self.warm.atVector(key("V", i)))
        self.values.insert(key("B", i), self.warm.atConstantBias(key("B", i)))

    def _stretch(self) -> float:
        return min(self._growth, self.config.settle_s) if self.unsure else self.config.settle_s

    def _settle(self, since: float) -> None:
        """Solve the steps since the last settled one, held there by its marginals.

        Where the first state is unsure its stretch grows by doubling from the beginning: an unknown gyro bias turns a
        dead-reckoned guess away before there are enough fixes to stop it.
        """
        stretch = self.steps[self._settled :]
        first = self._settled == 0
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for step in stretch if first else stretch[1:]:
            for _, factor in step.factors:
                graph.push_back(factor)
        indices = [step.index for step in stretch]
        for i in indices:
            values.insert(key("X", i), self.values.atPose3(key("X", i)))
            values.insert(key("V", i), self.values.atVector(key("V", i)))
            values.insert(key("B", i), self.values.atConstantBias(key("B", i)))
        if not first:
            graph.push_back(self._anchor)
        elif since < HOLD_S:
            graph.push_back(_hold(self.steps[0]))
        order = elimination_order(indices)
        try:
            solve = minimise(
                graph,
                values,
                order,
                BatchConfig(max_iterations=40, tolerance=1e-3, step_tolerance=1.0),
                lambda candidate: _shot(stretch, candidate),
            )
            self.values.update(solve.values)
            if self._stretch() < self.config.settle_s:
                self._growth *= 2.0
                return
            tree = graph.linearize(solve.values).eliminateMultifrontal(order, gtsam.EliminateQR)
            self._anchor = _anchor(tree, solve.values, indices[-1])
            self._settled = len(self.steps) - 1
        except (RuntimeError, SolverError):
            return  # not observable yet: a longer stretch is tried at the next step

    def graph(self) -> Any:
        """All factors taken so far."""
        graph = gtsam.NonlinearFactorGraph()
        for step in self.steps:
            for _, factor in step.factors:
                graph.push_back(factor)
        return graph

    def estimate(self) -> Estimate:
        """Solve everything.

        Raises
        ------
        SolverError
            Not observable, not finite or not converged; names time, state and sensors.
        """
        graph, indices = self.graph(), [step.index for step in self.steps]
        order = elimination_order(indices)
        try:
            solve = minimise(graph, self.values, order, self.config)
            tree = _eliminate(graph.linearize(solve.values), order)
            covariance = nav_covariances(tree, solve.values, indices)
        except RuntimeError as error:
            raise self._explain(error) from error
        check_covariance(covariance, self.steps, self.t0_ns)
        self.values = solve.values
        return Estimate(
            values=solve.values,
            indices=indices,
            t_ns=np.array([step.t_ns for step in self.steps], dtype=np.int64),
            covariance=covariance,
            factors=[item for step in self.steps for item in step.factors],
            iterations=solve.iterations,
            converged=solve.converged,
            cost=solve.cost,
        )

    def _explain(self, error: RuntimeError) -> SolverError:
        t_ns = {step.index: step.t_ns for step in self.steps}
        touching = {step.index: {tag.sensor for tag, _ in step.factors} for step in self.steps}
        return indeterminate(error, t_ns, self.t0_ns, touching)


def _hold(step: Step) -> Any:
    """Keeps the attitude of the first keyframe near its guess: seconds of noisy fixes say nothing of it."""
    model = gtsam.noiseModel.Isotropic.Sigma(3, 0.2)
    return gtsam.PoseRotationPrior3D(key("X", step.index), step.predicted.attitude(), model)


def _shot(steps: Sequence[Step], values: Any) -> Any:
    """The states that the first one foretells, all with its bias."""
    state = state_at(values, steps[0].index, steps[0].t_ns)
    nav, bias = state.nav, state.bias
    shot = gtsam.Values(values)
    for step in steps[1:]:
        if step.foretell is None:
            return values
        nav = step.foretell(nav, bias)
        shot.update(key("X", step.index), nav.pose())
        shot.update(key("V", step.index), nav.velocity())
        shot.update(key("B", step.index), bias)
    return shot


def _eliminate(linear: Any, order: gtsam.Ordering) -> Any:
    try:
        return linear.eliminateMultifrontal(order)
    except RuntimeError:
        return linear.eliminateMultifrontal(order, gtsam.EliminateQR)


def _anchor(tree: Any, values: Any, index: int) -> Any:
    """Prior factors that stand for everything before keyframe `index`."""
    graph = gtsam.NonlinearFactorGraph()
    pose, velocity, bias = (key(letter, index) for letter in ("X", "V", "B"))

    def model(name: int) -> Any:
        return gtsam.noiseModel.Gaussian.Covariance(tree.marginalCovariance(name))

    graph.add(gtsam.PriorFactorPose3(pose, values.atPose3(pose), model(pose)))
    graph.add(gtsam.PriorFactorVector(velocity, values.atVector(velocity), model(velocity)))
    graph.add(gtsam.PriorFactorConstantBias(bias, values.atConstantBias(bias), model(bias)))
    return graph


def check_covariance(covariance: Any, steps: Sequence[Step], t0_ns: int) -> None:
    """Observability: every variance finite and positive, position known better than a planet is wide.

    Raises
    ------
    SolverError
        Names the first keyframe at fault.
    """
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    bad = ~np.isfinite(variances).all(axis=1) | (variances <= 0).any(axis=1) | (variances[:, 3:6] > 1e12).any(axis=1)
    if bad.any():
        step = steps[int(np.flatnonzero(bad)[0])]
        sensors = ", ".join(sorted({tag.sensor for tag, _ in step.factors})) or "nothing"
        raise SolverError(
            f"t = {(step.t_ns - t0_ns) / 1e9:.2f} s",
            f"position or attitude is not determined there (keyframe {step.index}, touched by {sensors})",
            "an absolute measurement nearby",
            "add position fixes, control points or standstills, or give --initial",
        )


__all__ = ["Batch", "BatchConfig", "Solve", "Tag", "check_covariance", "minimise"]

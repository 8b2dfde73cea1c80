"""All updates at once; segments are solved as they come, so that no initial value is a mere dead reckoning."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError, SolverError
from smartnav_graph.graph.states import KEYFRAME_LETTERS, State, key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.smoothers.estimate import (
    Estimate,
    Posterior,
    chronological_order,
    copy_state,
    estimate_of,
    indeterminate,
    posterior,
    session_states,
    state_at,
    undetermined,
)
from smartnav_graph.smoothers.minimise import COARSE, Solve, SolveConfig, minimise
from smartnav_graph.smoothers.whole_graph import WholeGraph


@dataclass(frozen=True)
class BatchConfig:
    """settle_s : time after which the latest updates are solved by themselves, so that later windows start from a
    solved state; longest_settle_s : time to which it grows as the gyro bias becomes known.
    """

    settle_s: float = 30.0
    longest_settle_s: float = 240.0

    def __post_init__(self) -> None:
        if not 0 < self.settle_s <= self.longest_settle_s:
            raise ConfigError(
                "config [batch]",
                f"settle_s = {self.settle_s}, longest_settle_s = {self.longest_settle_s}",
                "0 < settle_s <= longest_settle_s",
            )


# Growing stretches shorter than this hold the first attitude.
HOLD_S = 10.0
# How far (m) the first guess of a place may be off, beside which fixes of metres count alone.
PLACE_M = 1e3
# A stretch that costs more than this a keyframe fits badly, and is solved again in parts that double from so many.
BAD_COST = 2.5
# A stretch that costs less than this a keyframe is a good enough guess as it is.
GOOD_COST = 1.7
GROW_FROM = 4
# Position variance (m^2) beyond which nothing holds the trajectory; minutes of dead reckoning reach 1e14.
LARGEST_VARIANCE = 1e18
# How much longer a stretch that is not observable is before it is tried again.
LONGER = 1.1
# Share of the first stretch that a later one is at least: a few fixes must lie in it.
SHORTEST_STRETCH = 0.3
# Turn (rad) that the gyro bias may add to a dead-reckoned guess.
LARGEST_TURN = 0.1
# Factor on the covariance that a settled stretch hands to the next: a linearised covariance is optimistic.
ANCHOR_SLACK = 1.5


@dataclass
class Batch:
    """Collects updates; `estimate` solves them.

    initial_values : of an earlier pass, taken for every state they hold; coarse_start : the first state is an initial
    guess; first_s : length of the segment that the first state was found on, solved as a whole; final : this may be the
    solution, otherwise a later pass goes on from it: windows are not preintegrated again where the bias has moved
    """

    config: BatchConfig = field(default_factory=BatchConfig)
    solve: SolveConfig = field(default_factory=SolveConfig)
    initial_values: gtsam.Values | None = None
    t0_ns: int = 0
    coarse_start: bool = False
    first_s: float = 0.0
    final: bool = True
    updates: list[GraphUpdate] = field(default_factory=list)
    values: gtsam.Values = field(default_factory=gtsam.Values)
    _settled: int = 0
    _stretch_s: float = 0.0
    _retry_s: float = 0.0
    _settle_s: float = 0.0
    _anchor: gtsam.NonlinearFactorGraph = field(default_factory=gtsam.NonlinearFactorGraph)
    _recent: gtsam.Values = field(default_factory=gtsam.Values)

    def __post_init__(self) -> None:
        if self.initial_values is not None:
            self.values = gtsam.Values(self.initial_values)
        self._stretch_s = (
            min(2.0, self.config.settle_s) if self.coarse_start else max(self.config.settle_s, self.first_s)
        )

    def latest(self) -> State | None:
        """Latest state: of the initial values, of the last solved segment, or predicted since then."""
        if not self.updates:
            return None
        return state_at(self.values, self.updates[-1].index, self.updates[-1].t_ns)

    def update(self, update: GraphUpdate) -> None:
        """Take one update; solve the latest segment when it is long enough."""
        self.updates.append(update)
        for name, state in update.session.items():
            if not self.values.exists(name):
                self.values.insert(name, state.initial)
        if self.initial_values is not None:
            for name, initial in update.chain.items():
                if not self.values.exists(name):
                    self.values.insert(name, initial)
            return
        new = update.values()
        self.values.insert(new)
        self._recent.insert(new)
        self._share(update, self._recent)
        since = update.t_s - self.updates[self._settled].t_s
        if since >= max(self._stretch_s, self._retry_s):
            begin = time.perf_counter()
            self._settle(since)
            self._settle_s += time.perf_counter() - begin

    def _share(self, update: GraphUpdate, values: gtsam.Values) -> None:
        """Give `values` the present session states of an update, where it lacks them."""
        for name in update.session:
            if not values.exists(name):
                values.insert(name, self.values.atVector(name))

    def _settle(self, since: float) -> None:
        """Solve the updates since the last segment, held there by its marginals.

        Where the first state is a guess its segment grows by doubling from the beginning: an unknown gyro bias turns a
        dead-reckoned guess away before there are enough fixes to stop it.
        """
        stretch = self.updates[self._settled :]
        growing = self.coarse_start and self._settled == 0 and self._stretch_s < self.config.settle_s
        try:
            solve = self._solve_stretch(stretch, self._recent, since)
            if solve.cost > BAD_COST * len(stretch) and len(stretch) > GROW_FROM:
                solve = min(solve, self._lengthened(stretch, since), key=lambda s: s.cost)
            if not growing:
                graph = self._stretch_graph(stretch, since)
                tree = _eliminate(graph.linearize(solve.values), self._order(stretch))
                self._anchor = _anchor(tree, solve.values, stretch[-1])
                self._settled = len(self.updates) - 1
        except (RuntimeError, SolverError):
            self._retry_s = LONGER * since  # not observable yet
            return
        self._retry_s = 0.0
        self.values.update(solve.values)
        self._recent = solve.values
        if growing:
            self._stretch_s = min(2.0 * self._stretch_s, self.config.settle_s)
        else:
            self._recent = gtsam.Values()
            copy_state(self.updates[-1], self.values, self._recent)
            self._stretch_s = self._next_stretch(tree)

    def _next_stretch(self, tree: gtsam.GaussianBayesTree) -> float:
        """As long as the gyro bias is unlikely to turn the guess by more than `LARGEST_TURN`."""
        bias = np.diag(tree.marginalCovariance(key("B", self.updates[-1].index)))[3:]
        shortest, longest = SHORTEST_STRETCH * self.config.settle_s, self.config.longest_settle_s
        return float(np.clip(LARGEST_TURN / np.sqrt(bias.max()), shortest, longest))

    def _stretch_graph(self, stretch: Sequence[GraphUpdate], since: float) -> WholeGraph:
        """Factors of a stretch, held at its beginning."""
        first = stretch[0] is self.updates[0]
        graph = WholeGraph.of(stretch if first else stretch[1:])
        if not first:
            graph.native.push_back(self._anchor)
            return graph
        graph.native.push_back(_place(self.updates[0]))
        if since < HOLD_S:
            graph.native.push_back(_hold(self.updates[0]))
        return graph

    def _order(self, stretch: Sequence[GraphUpdate]) -> gtsam.Ordering:
        """Keyframes of a stretch, then the session states that its factors touch: not those of its first update, which
        the anchor replaces."""
        touched = stretch if stretch[0] is self.updates[0] else stretch[1:]
        return gtsam.Ordering([*(name for update in stretch for name in update.names()), *session_states(touched)])

    def _solve_stretch(self, stretch: Sequence[GraphUpdate], values: gtsam.Values, since: float) -> Solve:
        graph, order = self._stretch_graph(stretch, since), self._order(stretch)
        enough = 0.0 if self.coarse_start else GOOD_COST * len(stretch)
        return minimise(graph, values, order, COARSE, partial(_reintegrated, stretch), enough)

    def _lengthened(self, stretch: Sequence[GraphUpdate], since: float) -> Solve:
        """Solve a stretch from its beginning in doubling parts, each predicted from the part before."""
        values, size, solve = gtsam.Values(), GROW_FROM, None
        copy_state(stretch[0], self._recent, values)
        while solve is None or size < len(stretch):
            size = min(2 * size, len(stretch))
            part = stretch[:size]
            for update in part:
                if not values.exists(key("X", update.index)):
                    copy_state(update, self._recent, values)
                    self._share(update, values)
            known = 0 if solve is None else size // 2 - 1
            solve = self._solve_stretch(part, _reintegrated(part[known:], values), since)
            values = solve.values
        return solve

    def _refresh(self, values: gtsam.Values) -> bool:
        """Preintegrate again where the bias has left its linearisation point; whether any window did."""
        fresh = [
            update.refreshed(values.atConstantBias(key("B", before.index))) for before, update in pairwise(self.updates)
        ]
        return any(fresh)

    def estimate(self) -> Estimate:
        """Solve everything.

        Raises
        ------
        SolverError
            Not observable, not finite or not converged; names time, state and sensors.
        """
        begin = time.perf_counter()
        try:
            graph, solve = self._solved(self.solve)
            solved = time.perf_counter()
            marginals = posterior(graph, solve.values, self.updates)
            estimate = estimate_of(self.updates, solve, marginals)
        except RuntimeError as error:
            raise indeterminate(error, self.updates, self.t0_ns) from error
        check_covariance(estimate.covariance, self.updates, self.t0_ns)
        seconds = {"solve": self._settle_s + solved - begin, "covariance": time.perf_counter() - solved}
        return replace(estimate, seconds=seconds)

    def provisional(self) -> Estimate:
        """Solve everything coarsely, without any covariance (zeros); errors as `estimate`."""
        begin = time.perf_counter()
        try:
            _, solve = self._solved(COARSE)
        except RuntimeError as error:
            raise indeterminate(error, self.updates, self.t0_ns) from error
        self._settle_s += time.perf_counter() - begin
        none = np.zeros((len(self.updates), 15, 15))
        blank = {name: np.zeros((len(state.initial),) * 2) for name, state in session_states(self.updates).items()}
        return estimate_of(self.updates, solve, Posterior(none, none[1:], blank), none)

    def renewed(self, renew: Callable[[GraphUpdate], None]) -> None:
        """Change what the updates add; a session state that comes with it begins at its prior mean."""
        for update in self.updates:
            renew(update)
            for name, state in update.session.items():
                if not self.values.exists(name):
                    self.values.insert(name, state.initial)

    def _solved(self, precision: SolveConfig) -> tuple[WholeGraph, Solve]:
        """Everything solved from the present values, which then are the solution."""
        graph, order = WholeGraph.of(self.updates), chronological_order(self.updates)
        if self.initial_values is not None:
            _keep_only(self.values, order)
        reintegrate = partial(_reintegrated, self.updates) if self.coarse_start else None
        solve = minimise(graph, self.values, order, precision, reintegrate)
        if self.final and self._refresh(solve.values):
            graph = WholeGraph.of(self.updates)
            solve = minimise(graph, solve.values, order, precision)
        self.values = solve.values
        return graph, solve


def _keep_only(values: gtsam.Values, order: gtsam.Ordering) -> None:
    """Erase states of an earlier pass that this one does not have."""
    names = {order.at(i) for i in range(order.size())}
    for name in values.keys():  # noqa: SIM118  gtsam.Values is no mapping
        if name not in names:
            values.erase(name)


def _hold(update: GraphUpdate) -> gtsam.NonlinearFactor:
    """Keeps the attitude of the first keyframe near its guess: seconds of noisy fixes say nothing of it."""
    model = gtsam.noiseModel.Isotropic.Sigma(3, 0.2)
    return gtsam.PoseRotationPrior3D(key("X", update.index), update.predicted.attitude(), model)


def _place(update: GraphUpdate) -> gtsam.NonlinearFactor:
    """Keeps the first keyframe within kilometres of its guess: before the first fix nothing else says where it is, and
    a solve would leave it a million of them away."""
    model = gtsam.noiseModel.Isotropic.Sigma(3, PLACE_M)
    return gtsam.GPSFactor(key("X", update.index), update.predicted.position(), model)


def _reintegrated(updates: Sequence[GraphUpdate], values: gtsam.Values) -> gtsam.Values:
    """The states predicted from the first one, all with its bias."""
    state = state_at(values, updates[0].index, updates[0].t_ns)
    nav, bias = state.nav, state.bias
    reintegrated = gtsam.Values(values)
    for update in updates[1:]:
        if update.predict is None:
            return values
        nav = update.predict(nav, bias)
        reintegrated.update(key("X", update.index), nav.pose())
        reintegrated.update(key("V", update.index), nav.velocity())
        reintegrated.update(key("B", update.index), bias)
    return reintegrated


def _eliminate(linear: gtsam.GaussianFactorGraph, order: gtsam.Ordering) -> gtsam.GaussianBayesTree:
    try:
        return linear.eliminateMultifrontal(order)
    except RuntimeError:
        return linear.eliminateMultifrontal(order, gtsam.EliminateQR)


def _anchor(tree: gtsam.GaussianBayesTree, values: gtsam.Values, update: GraphUpdate) -> gtsam.NonlinearFactorGraph:
    """Prior factors in place of everything up to `update`."""
    graph = gtsam.NonlinearFactorGraph()
    pose, velocity, bias = (key(letter, update.index) for letter in KEYFRAME_LETTERS)

    def model(name: int) -> gtsam.noiseModel.Gaussian:
        return gtsam.noiseModel.Gaussian.Covariance(ANCHOR_SLACK * tree.marginalCovariance(name))

    graph.add(gtsam.PriorFactorPose3(pose, values.atPose3(pose), model(pose)))
    graph.add(gtsam.PriorFactorConstantBias(bias, values.atConstantBias(bias), model(bias)))
    for name in (velocity, *update.chain):
        graph.add(gtsam.PriorFactorVector(name, values.atVector(name), model(name)))
    return graph


def check_covariance(covariance: Floats, updates: Sequence[GraphUpdate], t0_ns: int) -> None:
    """Observability: every variance finite and positive, position known better than `LARGEST_VARIANCE`.

    Raises
    ------
    SolverError
        Names the first keyframe at fault.
    """
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    bad = (
        ~np.isfinite(variances).all(axis=1)
        | (variances <= 0).any(axis=1)
        | (variances[:, 3:6] > LARGEST_VARIANCE).any(axis=1)
    )
    if bad.any():
        raise undetermined(updates[int(np.flatnonzero(bad)[0])], t0_ns)

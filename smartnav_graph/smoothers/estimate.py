"""States and covariances out of GTSAM values, and the linear algebra that all smoothers share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Indices
from smartnav_graph.core.display import Summarised
from smartnav_graph.core.errors import SolverError
from smartnav_graph.graph.states import KEYFRAME_LETTERS, SessionState, State, dims_of, key
from smartnav_graph.graph.update import FactorBatch, FactorId, GraphUpdate
from smartnav_graph.smoothers.covariance import marginals
from smartnav_graph.smoothers.minimise import Solve
from smartnav_graph.smoothers.whole_graph import Snapshot, StackedFactors, WholeGraph, stacks_of


@dataclass(frozen=True)
class SessionValue:
    """A session state found: value (d,), covariance (d, d), mean and sigma (d,) of its prior; held: a constant of this
    solve."""

    name: str
    key: int
    value: Floats
    covariance: Floats
    prior_mean: Floats
    prior_sigma: Floats
    held: bool

    @property
    def sigma(self) -> Floats:
        """Standard deviation of each component."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Posterior:
    """Marginals of a solved graph, on GTSAM's tangents (pose on the body side).

    joint : (n, 15, 15) of each keyframe; following : (n - 1, 15, 15) of each with the next; session : (d, d) by key
    counts : rows of each factor of the graph; residual (r,), whitened, and fitted (r,), the diagonal of J P J^T, of all
    rows; see `redundancy`
    """

    joint: Floats
    following: Floats
    session: Mapping[int, Floats]
    counts: Indices = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    residual: Floats = field(default_factory=lambda: np.zeros(0))
    fitted: Floats = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class Estimate(Summarised):
    """What a smoother ends with.

    values : gtsam.Values at the solution; indices, t_ns : keyframes, in time order
    covariance : (n, 15, 15) rotation, position, velocity (nav axes), accelerometer and gyroscope bias (body axes)
    marginals : the same on GTSAM's tangents, with more
    session : session states by name, held ones too
    factors, blocks : every native factor with its tag, and every block; iterations, converged, cost : of the last solve
    seconds : wall time by stage
    """

    values: gtsam.Values
    indices: Sequence[int]
    t_ns: NDArray[np.int64]
    covariance: Floats
    factors: Sequence[tuple[FactorId, Any]]
    blocks: Sequence[FactorBatch]
    iterations: int
    converged: bool
    cost: float
    marginals: Posterior
    session: Mapping[str, SessionValue] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)

    def facts(self) -> dict[str, str]:
        """Keyframes, factors, iterations, cost."""
        ended = "converged" if self.converged else "not converged"
        factors = len(self.factors) + sum(len(block.keys) for block in self.blocks)
        return {
            "keyframes": str(len(self.indices)),
            "factors": str(factors),
            "iterations": f"{self.iterations}, {ended}",
            "cost": f"{self.cost:.6g}",
        }

    @property
    def held(self) -> Mapping[int, Floats]:
        """Session states that are constants, by key."""
        return {state.key: state.value for state in self.session.values() if state.held}

    def offset_s(self, sensor: str) -> float:
        """Time offset of a sensor, zero where it has none."""
        found = self.session.get(f"{sensor}_time_offset_s")
        return 0.0 if found is None else float(found.value[0])

    def session_value(self, name: str, size: int) -> Floats:
        """Value (size,) of a session state, zeros where there is none."""
        found = self.session.get(name)
        return np.zeros(size) if found is None else found.value

    def keyframes_at(self, t_ns: NDArray[np.int64], merge_ns: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Keyframe (k,) at each stamp (k,), the next one where it has none within `merge_ns`, and which have one."""
        place = np.clip(np.searchsorted(self.t_ns, t_ns - merge_ns), 0, len(self.t_ns) - 1)
        return place, np.abs(self.t_ns[place] - t_ns) <= merge_ns

    def stacks(self, sensor: str) -> list[StackedFactors]:
        """The blocks of one sensor, joined; see `StackedFactors.linearize` for their residuals."""
        return [stack for stack in self.all_stacks if stack.sensor == sensor]

    @cached_property
    def all_stacks(self) -> Sequence[StackedFactors]:
        """The blocks of all sensors, joined, in the order of the graph."""
        return stacks_of(self.blocks, self.held)

    @cached_property
    def snapshot(self) -> Snapshot:
        """The solution as arrays, for what the stacks are linearised to there."""
        return Snapshot(self.values, self.held)

    @cached_property
    def _states(self) -> tuple[Floats, Floats, Floats, Floats]:
        return states_of(self.values, self.indices)

    def states(self) -> tuple[Floats, Floats, Floats, Floats]:
        """nav_R_body (n, 3, 3), nav_t_body (n, 3), nav_v_body (n, 3), bias (n, 6) accelerometer then gyroscope."""
        return self._states


def state_at(values: gtsam.Values, index: int, t_ns: int) -> State:
    """The navigation state and bias of one keyframe."""
    pose = values.atPose3(key("X", index))
    return State(
        index, t_ns, gtsam.NavState(pose, values.atVector(key("V", index))), values.atConstantBias(key("B", index))
    )


def copy_state(update: GraphUpdate, source: gtsam.Values, target: gtsam.Values) -> None:
    """Copy the variables of one update from gtsam.Values to gtsam.Values."""
    x, v, b = (key(letter, update.index) for letter in KEYFRAME_LETTERS)
    target.insert(x, source.atPose3(x))
    target.insert(v, source.atVector(v))
    target.insert(b, source.atConstantBias(b))
    for name, initial in update.chain.items():
        target.insert(name, source.atVector(name) if source.exists(name) else initial)


def states_of(values: gtsam.Values, indices: Sequence[int]) -> tuple[Floats, Floats, Floats, Floats]:
    """Arrays of the keyframe states; see `Estimate.states`."""
    poses = [values.atPose3(key("X", i)).matrix() for i in indices]
    stacked = np.array(poses).reshape(-1, 4, 4)
    velocity = np.array([values.atVector(key("V", i)) for i in indices]).reshape(-1, 3)
    bias = np.array([values.atConstantBias(key("B", i)).vector() for i in indices]).reshape(-1, 6)
    return stacked[:, :3, :3], stacked[:, :3, 3], velocity, bias


def values_of(indices: Sequence[int], R: Floats, p: Floats, v: Floats, bias: Floats) -> gtsam.Values:
    """gtsam.Values of keyframe states; the inverse of `states_of`."""
    values = gtsam.Values()
    for index, *nav, b in zip(indices, R, p, v, bias, strict=True):
        state = State.of(index, 0, (nav[0], nav[1], nav[2]), b)
        values.insert(key("X", index), state.nav.pose())
        values.insert(key("V", index), state.nav.velocity())
        values.insert(key("B", index), state.bias)
    return values


def state_distance(one: Sequence[Floats], other: Sequence[Floats]) -> tuple[float, float]:
    """Largest distance m and rotation angle deg between keyframe states (see `Estimate.states`)."""
    Ra, pa, Rb, pb = *one[:2], *other[:2]
    trace = np.einsum("nij,nij->n", Ra, Rb)
    sine = np.linalg.norm(Ra - Rb, axis=(1, 2)) / np.sqrt(8.0)  # of half the angle: exact where the cosine is flat
    angle = np.where(trace > 0, 2.0 * np.arcsin(np.clip(sine, 0, 1)), np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return float(np.linalg.norm(pa - pb, axis=1).max()), float(np.degrees(angle.max()))


def session_states(updates: Iterable[GraphUpdate]) -> dict[int, SessionState]:
    """The free session states that updates touch, by key."""
    return {name: state for update in updates for name, state in update.session.items()}


def chronological_order(updates: Sequence[GraphUpdate]) -> gtsam.Ordering:
    """Keyframes as they come, then what they all share: the cheapest elimination of a chain."""
    return gtsam.Ordering([*(name for update in updates for name in update.names()), *session_states(updates)])


def posterior(graph: WholeGraph, values: gtsam.Values, updates: Sequence[GraphUpdate]) -> Posterior:
    """Marginals of a graph linearised at `values`.

    Raises
    ------
    RuntimeError
        A state is not determined.
    """
    linear, session = graph.linearize(values), session_states(updates)
    counts = graph.row_counts(linear)
    found = marginals(linear, [update.names() for update in updates], list(session), int(counts.sum()))
    at = np.cumsum([0, *(len(state.initial) for state in session.values())])
    blocks = [found.session[a:b, a:b] for a, b in pairwise(at.tolist())]
    parts = dict(zip(session, blocks, strict=True))
    return Posterior(found.joint, found.following, parts, counts, found.residual, found.fitted)


def latest_covariance(net: gtsam.GaussianBayesNet, names: Sequence[int]) -> Floats:
    """Joint covariance of the states that a Bayes net eliminates last, in the order of `names`, on GTSAM's tangents.

    Raises
    ------
    RuntimeError
        A state is not determined.
    """
    dims = dims_of(np.array(names, dtype=np.uint64))
    ends = np.cumsum(dims)
    at = {name: slice(end - dim, end) for name, dim, end in zip(names, dims.tolist(), ends.tolist(), strict=True)}
    R, missing, place = np.zeros((ends[-1],) * 2), set(names), net.size()
    while missing:  # one that nothing connects with the rest may come before it
        place -= 1
        conditional = net.at(place)
        name, *parents = conditional.keys()
        if name not in missing:
            continue
        missing.discard(name)
        own, rest, column = conditional.R(), conditional.S(), 0
        if len(own) < dims[names.index(name)] or not np.isfinite(own).all() or (np.diag(own) == 0.0).any():
            raise RuntimeError(f"(Symbol: {gtsam.Symbol(name).string()})")
        R[at[name], at[name]] = own
        for parent in parents:
            width = at[parent].stop - at[parent].start
            R[at[name], at[parent]] = rest[:, column : column + width]
            column += width
    inverse = np.linalg.inv(R)
    return np.asarray(inverse @ inverse.T)


def session_values(
    updates: Sequence[GraphUpdate], values: gtsam.Values, marginals: Posterior
) -> dict[str, SessionValue]:
    """What was found of every session state, by name."""
    found = {}
    for update in updates:
        for name, state in update.session.items():
            if state.name not in found:
                value, cov = values.atVector(name), marginals.session[name]
                found[state.name] = SessionValue(state.name, name, value, cov, state.initial, state.sigma, False)
        for name, state in update.constants.items():
            none, value = np.zeros((len(state.initial),) * 2), update.held[name]
            found[state.name] = SessionValue(state.name, name, value, none, state.initial, state.sigma, True)
    return found


def estimate_of(
    updates: Sequence[GraphUpdate], solve: Solve, marginals: Posterior, covariance: Floats | None = None
) -> Estimate:
    """The estimate of a solved graph; its covariance is that of `marginals` where none is given."""
    indices = [update.index for update in updates]
    if covariance is None:
        covariance = to_nav_axes(marginals.joint, states_of(solve.values, indices)[0])
    return Estimate(
        values=solve.values,
        indices=indices,
        t_ns=np.array([update.t_ns for update in updates], dtype=np.int64),
        covariance=covariance,
        factors=[item for update in updates for item in update.factors],
        blocks=[block for update in updates for block in update.blocks],
        iterations=solve.iterations,
        converged=solve.converged,
        cost=solve.cost,
        session=session_values(updates, solve.values, marginals),
        marginals=marginals,
    )


def to_nav_axes(joint: Floats, nav_R_body: Floats) -> Floats:
    """Rotate the pose part of joint covariances (n, 15, 15) from body to nav axes."""
    turn = np.zeros_like(joint)
    turn[:, :3, :3] = turn[:, 3:6, 3:6] = nav_R_body
    turn[:, range(6, 15), range(6, 15)] = 1.0
    covariance = turn @ joint @ turn.transpose(0, 2, 1)
    return 0.5 * (covariance + covariance.transpose(0, 2, 1))


_NEAR = re.compile(r"Symbol: (\w)(\d+)")
_WHAT = {"X": "position or attitude", "V": "velocity", "B": "an inertial bias"}


def indeterminate(error: Exception, updates: Iterable[GraphUpdate], t0_ns: int) -> SolverError:
    """GTSAM's complaint about an under-determined state, in words: which, when, what touches it, what is missing."""
    text = str(error).strip()
    found = _NEAR.search(text)
    if found is None:
        return SolverError("solve", text.splitlines()[0] if text else "failed", "a solvable graph")
    what = _WHAT.get(found[1].upper(), found[1].upper())
    update = next((update for update in updates if update.index == int(found[2])), None)
    if update is None:
        return SolverError("solve", f"{what} ({found[1]}{found[2]}) is not determined", "a measurement of it")
    return undetermined(update, t0_ns, what)


def undetermined(update: GraphUpdate, t0_ns: int, what: str = _WHAT["X"]) -> SolverError:
    """The fault of a keyframe that nothing holds."""
    names = ", ".join(sorted(update.sensors())) or "nothing"
    return SolverError(
        f"t = {(update.t_ns - t0_ns) / 1e9:.2f} s",
        f"{what} is not determined there (keyframe {update.index}, touched by {names})",
        "an absolute measurement nearby",
        "add position fixes, control points or standstills, or give --initial",
    )

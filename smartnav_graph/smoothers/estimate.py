"""States and covariances out of GTSAM values, and the linear algebra that all smoothers share."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.errors import SolverError
from smartnav_graph.graph import KEYFRAME_LETTERS, STATES, Block, State, Step, Tag, key

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """What a smoother ends with.

    values : gtsam.Values at the solution; indices, t_ns : keyframes, in time order
    covariance : (n, 15, 15) rotation, position, velocity (nav axes), accelerometer and gyroscope bias (body axes)
    factors, blocks : every native factor with its tag, and every block; iterations, converged, cost : of the last solve
    seconds : wall time by stage
    """

    values: Any
    indices: Sequence[int]
    t_ns: NDArray[np.int64]
    covariance: Floats
    factors: Sequence[tuple[Tag, Any]]
    blocks: Sequence[Block]
    iterations: int
    converged: bool
    cost: float
    seconds: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def _states(self) -> tuple[Floats, Floats, Floats, Floats]:
        return states_of(self.values, self.indices)

    def states(self) -> tuple[Floats, Floats, Floats, Floats]:
        """nav_R_body (n, 3, 3), nav_t_body (n, 3), nav_v_body (n, 3), bias (n, 6) accelerometer then gyroscope."""
        return self._states


def state_at(values: Any, index: int, t_ns: int) -> State:
    """The navigation state and bias of one keyframe."""
    pose = values.atPose3(key("X", index))
    return State(
        index, t_ns, gtsam.NavState(pose, values.atVector(key("V", index))), values.atConstantBias(key("B", index))
    )


def copy_state(step: Step, source: Any, target: Any) -> None:
    """Copy the variables of one step from gtsam.Values to gtsam.Values."""
    x, v, b = (key(letter, step.index) for letter in KEYFRAME_LETTERS)
    target.insert(x, source.atPose3(x))
    target.insert(v, source.atVector(v))
    target.insert(b, source.atConstantBias(b))
    for name, initial in step.chain.items():
        target.insert(name, source.atVector(name) if source.exists(name) else initial)


def states_of(values: Any, indices: Sequence[int]) -> tuple[Floats, Floats, Floats, Floats]:
    """Arrays of the keyframe states; see `Estimate.states`."""
    poses = [values.atPose3(key("X", i)).matrix() for i in indices]
    stacked = np.array(poses).reshape(-1, 4, 4)
    velocity = np.array([values.atVector(key("V", i)) for i in indices]).reshape(-1, 3)
    bias = np.array([values.atConstantBias(key("B", i)).vector() for i in indices]).reshape(-1, 6)
    return stacked[:, :3, :3], stacked[:, :3, 3], velocity, bias


def largest_difference(one: Estimate, other: Estimate) -> tuple[float, float]:
    """Largest distance m and rotation angle deg over the keyframes of two estimates of the same problem."""
    (Ra, pa, _, _), (Rb, pb, _, _) = one.states(), other.states()
    trace = np.einsum("nij,nij->n", Ra, Rb)
    sine = np.linalg.norm(Ra - Rb, axis=(1, 2)) / np.sqrt(8.0)  # of half the angle: exact where the cosine is flat
    angle = np.where(trace > 0, 2.0 * np.arcsin(np.clip(sine, 0, 1)), np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return float(np.linalg.norm(pa - pb, axis=1).max()), float(np.degrees(angle.max()))


def chronological_order(steps: Sequence[Step]) -> gtsam.Ordering:
    """Keyframes as they come: the cheapest elimination of a chain."""
    order = gtsam.Ordering()
    for step in steps:
        for name in step.names():
            order.push_back(name)
    return order


def eliminated(graph: Any, values: Any, steps: Sequence[Step]) -> Any:
    """Bayes net of a graph linearised at `values`, in chronological order; QR is exact where states are weakly held."""
    return graph.linearize(values).eliminateSequential(chronological_order(steps), gtsam.EliminateQR)


def nav_covariances(net: Any, steps: Sequence[Step], values: Any) -> Floats:
    """Joint covariance (n, 15, 15) of every keyframe from a chain eliminated in chronological order, in nav axes.

    Each keyframe is conditioned on the next, R x_k + S x_k+1 = d; backwards in time
    P_k = R^-1 R^-T + K P_k+1 K^T with K = R^-1 S. One small product a keyframe, and stable where nothing holds the
    trajectory (a dead reckoning of minutes), where GTSAM's shortcuts of the Bayes tree give up.

    Source: Rauch, Tung, Striebel (1965), in square-root information form (Bierman 1977, ch. X).

    Raises
    ------
    RuntimeError
        A keyframe is not determined.
    """
    conditionals = {net.at(i).keys()[0]: net.at(i) for i in range(net.size())}
    joint = np.empty((len(steps), 15, 15))
    later, later_at = np.zeros((0, 0)), dict[int, slice]()
    for row in reversed(range(len(steps))):
        at = _slices(steps[row])
        size = max(part.stop for part in at.values())
        R, S = np.zeros((size, size)), np.zeros((size, len(later)))
        for name, part in at.items():
            conditional = conditionals[name]
            if conditional.R().shape != R[part, part].shape:
                raise RuntimeError(f"(Symbol: {chr(gtsam.symbolChr(name))}{steps[row].index})")
            R[part, part] = conditional.R()
            rest, column = conditional.S(), 0
            for parent in conditional.keys()[1:]:
                block = at.get(parent) or later_at[parent]
                width = block.stop - block.start
                (R if parent in at else S)[part, block] = rest[:, column : column + width]
                column += width
        if not np.isfinite(R).all() or (np.diag(R) == 0.0).any():
            raise RuntimeError(f"(Symbol: X{steps[row].index})")
        inverse = np.linalg.inv(R)
        gain = inverse @ S
        later, later_at = inverse @ inverse.T + gain @ later @ gain.T, at
        joint[row] = later[:15, :15]
    return to_nav_axes(joint, states_of(values, [step.index for step in steps])[0])


def _slices(step: Step) -> dict[int, slice]:
    """Where each state of a step stands in its joint vector; pose, velocity and bias come first."""
    at, start = {}, 0
    for name in step.names():
        size = STATES[chr(gtsam.symbolChr(name))].dim
        at[name] = slice(start, start + size)
        start += size
    return at


def to_nav_axes(joint: Floats, nav_R_body: Floats) -> Floats:
    """Rotate the pose part of joint covariances (n, 15, 15) from body to nav axes."""
    turn = np.zeros_like(joint)
    turn[:, :3, :3] = turn[:, 3:6, 3:6] = nav_R_body
    turn[:, range(6, 15), range(6, 15)] = 1.0
    covariance = turn @ joint @ turn.transpose(0, 2, 1)
    return 0.5 * (covariance + covariance.transpose(0, 2, 1))


_NEAR = re.compile(r"Symbol: (\w)(\d+)")


def indeterminate(error: Exception, t_ns: dict[int, int], t0_ns: int, touching: dict[int, set[str]]) -> SolverError:
    """GTSAM's complaint about an under-determined state, in words: which, when, what touches it, what is missing."""
    text = str(error)
    found = _NEAR.search(text)
    if found is None:
        return SolverError("solve", text.strip().splitlines()[0] if text.strip() else "failed", "a solvable graph")
    letter, index = found[1].upper(), int(found[2])
    names = {"X": "position or attitude", "V": "velocity", "B": "an inertial bias"}
    when = (t_ns[index] - t0_ns) / 1e9 if index in t_ns else float("nan")
    sensors = ", ".join(sorted(touching.get(index, set()))) or "nothing"
    return SolverError(
        f"t = {when:.2f} s",
        f"{names.get(letter, letter)} is not determined there (keyframe {index}, touched by {sensors})",
        "an absolute measurement nearby",
        "add position fixes, control points or standstills, or give --initial",
    )

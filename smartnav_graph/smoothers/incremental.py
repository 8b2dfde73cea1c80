"""One step at a time: iSAM2 over everything, or over a lag with the rest marginalised.

QR factorisation, because Cholesky gives up on yaw that is only weakly known (Kaess et al. 2012, iSAM2, IJRR 31(2)).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.errors import ConfigError, SolverError
from smartnav_graph.graph import KEYFRAME_LETTERS, STATES, SessionState, State, Step, key, kind_of
from smartnav_graph.smoothers.estimate import (
    Estimate,
    eliminated,
    indeterminate,
    posterior,
    session_values,
    states_of,
    to_nav_axes,
)
from smartnav_graph.smoothers.whole_graph import WholeGraph, custom_factor, session_prior

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ReplayConfig:
    """smoother : fixed-lag or isam2; lag_s; relinearize : factor on the step sizes that move a linearisation point;
    polish : solve everything once more at the end."""

    smoother: str = "fixed-lag"
    lag_s: float = 10.0
    relinearize: float = 1.0
    polish: bool = True

    def __post_init__(self) -> None:
        if self.smoother not in ("fixed-lag", "isam2"):
            raise ConfigError("--smoother", f"{self.smoother!r}", "fixed-lag or isam2")
        if not (self.lag_s > 0 and self.relinearize > 0):
            raise ConfigError("config [replay]", f"lag_s = {self.lag_s}", "> 0 s")


def isam2_params(factor: float) -> gtsam.ISAM2Params:
    """iSAM2 with QR and relinearisation at every step that needs it."""
    thresholds = gtsam.ISAM2ThresholdMap()
    for letter, kind in STATES.items():
        thresholds.insert((letter, factor * kind.moved))
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1
    return params


class Incremental:
    """iSAM2 or fixed-lag smoother behind the one interface."""

    def __init__(self, config: ReplayConfig, t0_ns: int) -> None:
        self.config, self.t0_ns = config, t0_ns
        params = isam2_params(config.relinearize)
        self._fixed_lag = config.smoother == "fixed-lag"
        self._engine: Any = (
            gtsam.IncrementalFixedLagSmoother(config.lag_s, params) if self._fixed_lag else gtsam.ISAM2(params)
        )
        self.steps: list[Step] = []
        self.dropped: Counter[str] = Counter()
        self._session: dict[int, SessionState] = {}
        self._left = gtsam.Values()
        self._inside: deque[Step] = deque()

    def latest(self) -> State | None:
        """State at the last keyframe, with everything known so far."""
        if not self.steps:
            return None
        return self._state(self.steps[-1])

    def _state(self, step: Step) -> State:
        i, engine = step.index, self._engine
        pose = engine.calculateEstimatePose3(key("X", i))
        velocity = engine.calculateEstimateVector(key("V", i))
        return State(i, step.t_ns, gtsam.NavState(pose, velocity), engine.calculateEstimateConstantBias(key("B", i)))

    def update(self, step: Step) -> None:
        """Take one step.

        Raises
        ------
        SolverError
            The new state is not determined; names time, state and sensors.
        """
        if not self._fixed_lag:
            # a state that touches every step makes each of iSAM2's updates as long as the whole session
            step.hold({state.name: state.initial for state in step.session.values()})
        self._make_room(step)
        self._drop_late(step)
        values, graph = step.values(), gtsam.NonlinearFactorGraph()
        for _, factor in step.factors:
            graph.push_back(factor)
        for block in step.blocks:
            for row in np.flatnonzero(block.used):
                graph.push_back(custom_factor(block, int(row), step.held))
        for name, state in step.session.items():
            if name not in self._session:
                values.insert(name, state.initial)
                graph.push_back(session_prior(state))
        self._session |= step.session
        try:
            if self._fixed_lag:
                self._engine.update(graph, values, dict.fromkeys([*step.names(), *self._session], step.t_s))
            else:
                self._engine.update(graph, values)
        except RuntimeError as error:
            t_ns = {s.index: s.t_ns for s in [*self.steps, step]}
            touching = {s.index: s.sensors() for s in [*self.steps, step]}
            raise indeterminate(error, t_ns, self.t0_ns, touching) from error
        self.steps.append(step)
        self._inside.append(step)

    def _drop_late(self, step: Step) -> None:
        """Leave out, and count, rows that speak of keyframes which have left the lag."""
        if not (self._fixed_lag and self._inside):
            return
        oldest = self._inside[0].index
        kept = []
        for block in step.blocks:
            late = [min(_keyframes(keys), default=oldest) < oldest for keys in block.keys]
            if any(late):
                self.dropped[block.sensor] += sum(late)
                block = replace(block, used=[u and not gone for u, gone in zip(block.used, late, strict=True)])
            kept.append(block)
        step.blocks = kept

    def _make_room(self, step: Step) -> None:
        """Keep the last estimate of the states that the coming update marginalises."""
        while self._fixed_lag and self._inside and self._inside[0].t_s < step.t_s - self.config.lag_s:
            self._keep(self._inside.popleft(), self._left)

    def _keep(self, step: Step, values: Any) -> None:
        """Copy the present estimate of a step's variables."""
        state = self._state(step)
        values.insert(key("X", step.index), state.nav.pose())
        values.insert(key("V", step.index), state.nav.velocity())
        values.insert(key("B", step.index), state.bias)
        for name in step.chain:
            values.insert(name, self._engine.calculateEstimateVector(name))

    def known(self) -> State:
        """State of the latest keyframe with its covariance."""
        return replace(self._state(self.steps[-1]), covariance=self._covariance())

    def _covariance(self) -> Floats:
        """(15, 15) of the latest keyframe, nav axes; blocks of pose, velocity and bias."""
        i = self.steps[-1].index
        joint = np.zeros((1, 15, 15))
        at = 0
        for letter, size in (("X", 6), ("V", 3), ("B", 6)):
            joint[0, at : at + size, at : at + size] = self._engine.marginalCovariance(key(letter, i))
            at += size
        R = self._engine.calculateEstimatePose3(key("X", i)).rotation().matrix()
        return np.asarray(to_nav_axes(joint, R[None])[0])

    def values(self) -> Any:
        """Best estimate of every keyframe (gtsam.Values): as it left the lag, or as it is now."""
        if not self._fixed_lag:
            return self._engine.calculateBestEstimate()
        values = gtsam.Values(self._left)
        for step in self._inside:
            self._keep(step, values)
        for name in self._session:
            values.insert(name, self._engine.calculateEstimateVector(name))
        return values

    def estimate(self, count: int | None = None) -> Estimate:
        """The first `count` keyframes (all by default) at `values`, with the covariance of their graph linearised
        there."""
        steps = self.steps[:count]
        if not steps:
            raise SolverError("replay", "no keyframe was processed", "at least one")
        graph, values, indices = WholeGraph.of(steps), self.values(), [step.index for step in steps]
        marginals = posterior(eliminated(graph, values, steps), steps)
        return Estimate(
            values=values,
            indices=indices,
            t_ns=np.array([step.t_ns for step in steps], dtype=np.int64),
            covariance=marginals.nav(states_of(values, indices)[0]),
            factors=[item for step in steps for item in step.factors],
            blocks=[block for step in steps for block in step.blocks],
            iterations=len(steps),
            converged=True,
            cost=graph.error(values),
            session=session_values(steps, values, marginals),
            marginals=marginals,
        )


def _keyframes(keys: Sequence[int]) -> list[int]:
    """Indices of the keyframes among the states of a row."""
    return [gtsam.symbolIndex(name) for name in keys if kind_of(name).letter in KEYFRAME_LETTERS]

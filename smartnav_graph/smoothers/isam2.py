"""iSAM2 over everything.

QR factorisation, because Cholesky gives up on yaw that is only weakly known. Session states are held unless told
otherwise: one that touches every step makes each update as long as the whole session.

Source: Kaess, Johannsson, Roberts, Ila, Leonard, Dellaert (2012), iSAM2, IJRR 31(2).
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from smartnav_graph.graph import KEYFRAME_LETTERS, STATES, SessionState, State, Step, key
from smartnav_graph.smoothers.incremental import Effort, Incremental, ReplayConfig, scalars
from smartnav_graph.smoothers.whole_graph import custom_factor, session_prior

Floats = NDArray[np.float64]


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


class Isam2(Incremental):
    """iSAM2 behind the one interface."""

    def __init__(self, config: ReplayConfig, t0_ns: int) -> None:
        super().__init__(config, t0_ns)
        self._engine = gtsam.ISAM2(isam2_params(config.relinearize))
        self._session: dict[int, SessionState] = {}

    def _take(self, step: Step) -> None:
        if self.config.hold:
            step.hold({state.name: state.initial for state in step.session.values()})
        graph, values = gtsam.NonlinearFactorGraph(), step.values()
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
        done = self._engine.update(graph, values)
        self.effort = Effort(done.getVariablesReeliminated(), done.getVariablesRelinearized())

    def _state(self, step: Step) -> State:
        i, engine = step.index, self._engine
        pose = engine.calculateEstimatePose3(key("X", i))
        velocity = engine.calculateEstimateVector(key("V", i))
        return State(i, step.t_ns, gtsam.NavState(pose, velocity), engine.calculateEstimateConstantBias(key("B", i)))

    def _marginal(self, step: Step) -> Floats:
        """Blocks of pose, velocity and bias alone: the engine gives no more."""
        return np.asarray(
            block_diag(*(self._engine.marginalCovariance(key(letter, step.index)) for letter in KEYFRAME_LETTERS))
        )

    def session_now(self) -> dict[str, tuple[float, float]]:
        """Present value of each scalar of the free session states; a sigma would take longer than an update."""
        found: dict[str, tuple[float, float]] = {}
        for name, state in self._session.items():
            value = self._engine.calculateEstimateVector(name)
            found |= scalars(state, value, np.full(len(value), np.nan))
        return found

    def values(self) -> Any:
        """Best estimate of every state so far (gtsam.Values)."""
        return self._engine.calculateBestEstimate()

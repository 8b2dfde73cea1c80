"""iSAM2 over everything.

QR factorisation, because Cholesky gives up on yaw that is only weakly known. Session states are held by
default: one that touches every update makes each update as long as the whole session.

Source: Kaess, Johannsson, Roberts, Ila, Leonard, Dellaert (2012), iSAM2, IJRR 31(2).
"""

from __future__ import annotations

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.graph.states import KEYFRAME_LETTERS, STATES, SessionState, State, key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.smoothers.incremental import Effort, Incremental, ReplayConfig, scalars
from smartnav_graph.smoothers.whole_graph import custom_factor, session_prior


def isam2_params(factor: float) -> gtsam.ISAM2Params:
    """iSAM2 with QR and relinearisation at every update that needs it."""
    thresholds = gtsam.ISAM2ThresholdMap()
    for letter, kind in STATES.items():
        thresholds.insert((letter, factor * kind.relinearize_threshold))
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

    def _take(self, update: GraphUpdate) -> None:
        if self.config.hold:
            update.hold({state.name: state.initial for state in update.session.values()})
        graph, values = gtsam.NonlinearFactorGraph(), update.values()
        for _, factor in update.factors:
            graph.push_back(factor)
        for block in update.blocks:
            for row in np.flatnonzero(block.used):
                graph.push_back(custom_factor(block, int(row), update.held))
        for name, state in update.session.items():
            if name not in self._session:
                values.insert(name, state.initial)
                graph.push_back(session_prior(state))
        self._session |= update.session
        done = self._engine.update(graph, values)
        self.effort = Effort(done.getVariablesReeliminated(), done.getVariablesRelinearized())

    def _state(self, update: GraphUpdate) -> State:
        i, engine = update.index, self._engine
        pose = engine.calculateEstimatePose3(key("X", i))
        velocity = engine.calculateEstimateVector(key("V", i))
        return State(i, update.t_ns, gtsam.NavState(pose, velocity), engine.calculateEstimateConstantBias(key("B", i)))

    def _marginal(self, update: GraphUpdate) -> Floats:
        """Blocks of pose, velocity and bias alone: the engine gives no more."""
        from scipy.linalg import block_diag

        return np.asarray(
            block_diag(*(self._engine.marginalCovariance(key(letter, update.index)) for letter in KEYFRAME_LETTERS))
        )

    def session_now(self) -> dict[str, tuple[float, float]]:
        """Present value of each scalar of the free session states; a sigma would take longer than an update."""
        found: dict[str, tuple[float, float]] = {}
        for name, state in self._session.items():
            value = self._engine.calculateEstimateVector(name)
            found |= scalars(state, value, np.full(len(value), np.nan))
        return found

    def values(self) -> gtsam.Values:
        """Best estimate of every state so far (gtsam.Values)."""
        return self._engine.calculateBestEstimate()

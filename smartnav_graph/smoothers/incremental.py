"""Smoothers that take one update at a time: what they share, and their options."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, replace
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError, SolverError
from smartnav_graph.graph.states import SessionState, State
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.smoothers.estimate import (
    Estimate,
    estimate_of,
    indeterminate,
    posterior,
    to_nav_axes,
)
from smartnav_graph.smoothers.minimise import Solve
from smartnav_graph.smoothers.whole_graph import WholeGraph


@dataclass(frozen=True)
class ReplayConfig:
    """smoother : the smoother, ``fixed-lag`` or ``isam2``; lag_s : lag of the fixed-lag smoother; relinearize :
    factor on the step sizes that call for a new linearisation, a ratio; hold : in isam2, keep clock offsets, lever
    arms and the like at their prior means; polish : solve everything once more at the end.
    """

    smoother: str = "fixed-lag"
    lag_s: float = 10.0
    relinearize: float = 1.0
    hold: bool = True
    polish: bool = True

    def __post_init__(self) -> None:
        if self.smoother not in ("fixed-lag", "isam2"):
            raise ConfigError("--smoother", f"{self.smoother!r}", "fixed-lag or isam2")
        if not (self.lag_s > 0 and self.relinearize > 0):
            raise ConfigError("config [replay]", f"lag_s = {self.lag_s}", "> 0 s")


class Effort(NamedTuple):
    """What an update took: states solved for, and linearised anew (each time counts)."""

    solved: int = 0
    relinearised: int = 0


class Incremental(ABC):
    """A smoother that is right after every update.

    dropped : rows older than its lag, by sensor; effort : of the last update
    """

    def __init__(self, config: ReplayConfig, t0_ns: int) -> None:
        self.config, self.t0_ns = config, t0_ns
        self.updates: list[GraphUpdate] = []
        self.dropped: Counter[str] = Counter()
        self.effort = Effort()
        self._latest: State | None = None

    @abstractmethod
    def _take(self, update: GraphUpdate) -> None:
        """Solve with one update more; RuntimeError where a state is not determined."""

    @abstractmethod
    def _state(self, update: GraphUpdate) -> State:
        """Present estimate at one keyframe."""

    @abstractmethod
    def _marginal(self, update: GraphUpdate) -> Floats:
        """(15, 15) covariance of the latest keyframe on GTSAM's tangents."""

    @abstractmethod
    def values(self) -> gtsam.Values:
        """Best estimate of every state so far (gtsam.Values)."""

    @abstractmethod
    def session_now(self) -> dict[str, tuple[float, float]]:
        """Present value and sigma of each scalar of the free session states, by name; NaN for a sigma not at hand."""

    def recent(self) -> tuple[NDArray[np.int64], Floats]:
        """Stamps (m,) and present positions (m, 3) of the keyframes of the last `lag_s`, in time order."""
        found = []
        for update in reversed(self.updates):
            if update.t_s < self.updates[-1].t_s - self.config.lag_s:
                break
            found.append((update.t_ns, self._state(update).nav.position()))
        t_ns, position = zip(*reversed(found), strict=True)
        return np.array(t_ns, dtype=np.int64), np.array(position)

    def update(self, update: GraphUpdate) -> None:
        """Take one update.

        Raises
        ------
        SolverError
            The new state is not determined; names time, state and sensors.
        """
        try:
            self._take(update)
        except RuntimeError as error:
            raise indeterminate(error, [*self.updates, update], self.t0_ns) from error
        self.updates.append(update)
        self._latest = None

    def latest(self) -> State | None:
        """State at the last keyframe with its covariance, after everything taken so far."""
        if self._latest is None and self.updates:
            state, joint = self._state(self.updates[-1]), self._marginal(self.updates[-1])
            R = state.nav.attitude().matrix()
            self._latest = replace(state, covariance=to_nav_axes(joint[None], R[None])[0])
        return self._latest

    def estimate(self, count: int | None = None) -> Estimate:
        """The first `count` keyframes (all by default) at `values`, with the covariance of their graph linearised
        there."""
        updates = self.updates[:count]
        if not updates:
            raise SolverError("replay", "no keyframe was processed", "at least one")
        graph, values = WholeGraph.of(updates), self.values()
        marginals = posterior(graph, values, updates)
        return estimate_of(updates, Solve(values, graph.error(values), len(updates), converged=True), marginals)


def scalars(state: SessionState, value: Floats, sigma: Floats) -> dict[str, tuple[float, float]]:
    """Value and sigma of each scalar of a session state; a number behind the name of those of a vector."""
    names = [state.name] if len(value) == 1 else [f"{state.name}_{i}" for i in range(len(value))]
    return {name: (float(v), float(s)) for name, v, s in zip(names, value, sigma, strict=True)}

"""One interface, three smoothers: `latest()`, `update(update)`, `estimate()`."""

from __future__ import annotations

from typing import Protocol

from smartnav_graph.graph.states import State
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.fixed_lag import FixedLag
from smartnav_graph.smoothers.incremental import Incremental, ReplayConfig
from smartnav_graph.smoothers.isam2 import Isam2


class Smoother(Protocol):
    """Takes updates in time order and knows no sensor. t0_ns : time zero of the session"""

    t0_ns: int

    def latest(self) -> State | None:
        """State at the last keyframe, None before the first."""
        ...

    def update(self, update: GraphUpdate) -> None:
        """Take one update."""
        ...

    def estimate(self) -> Estimate:
        """States of all keyframes with their covariance, after everything taken so far."""
        ...


def incremental(config: ReplayConfig, t0_ns: int) -> Incremental:
    """The smoother that a replay asks for."""
    return (FixedLag if config.smoother == "fixed-lag" else Isam2)(config, t0_ns)

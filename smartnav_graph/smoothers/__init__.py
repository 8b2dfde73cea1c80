"""One interface, three smoothers: `latest()`, `update(step)`, `estimate()`."""

from __future__ import annotations

from typing import Protocol

from smartnav_graph.graph import State, Step
from smartnav_graph.smoothers.estimate import Estimate


class Smoother(Protocol):
    """Takes steps in time order and knows no sensor."""

    def latest(self) -> State | None:
        """State at the last keyframe, None before the first."""
        ...

    def update(self, step: Step) -> None:
        """Take one step."""
        ...

    def estimate(self) -> Estimate:
        """States of all keyframes with their covariance, after everything taken so far."""
        ...

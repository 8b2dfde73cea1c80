"""A problem solved, as everything that tells of it takes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from smartnav_graph.graph import Memory
from smartnav_graph.problem import Problem
from smartnav_graph.revise import FixResiduals, fix_residuals, position_builders
from smartnav_graph.smoothers.estimate import Estimate


@dataclass(frozen=True)
class Outcome:
    """The estimate of a problem and the memory it was made with."""

    problem: Problem
    estimate: Estimate
    memory: Memory

    @cached_property
    def fixes(self) -> Mapping[str, FixResiduals]:
        """Residuals of each stream of positions at its keyframes, by sensor."""
        windows = self.problem.windows
        return {
            builder.name: fix_residuals(builder, windows, self.estimate, self.memory)
            for builder in position_builders(self.problem.builders)
        }

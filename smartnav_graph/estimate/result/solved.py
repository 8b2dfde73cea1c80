"""A problem solved: what results are made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from smartnav_graph.estimate.problem import Problem
from smartnav_graph.estimate.reweight.outliers import FixResiduals, fix_residuals, position_builders
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.smoothers.estimate import Estimate


@dataclass(frozen=True)
class SolvedProblem:
    """The estimate of a problem and the pass state it was made with."""

    problem: Problem
    estimate: Estimate
    pass_state: PassState

    @cached_property
    def fixes(self) -> Mapping[str, FixResiduals]:
        """Residuals of each stream of positions at its keyframes, by sensor."""
        windows = self.problem.windows
        return {
            builder.name: fix_residuals(builder, windows, self.estimate, self.pass_state)
            for builder in position_builders(self.problem.builders)
        }

"""Reasons why a run is not good, and what the tests of the verdict look at."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from smartnav_graph.estimate.result.assemble import SolvedProblem, Withheld
from smartnav_graph.estimate.result.chi2 import Chi2
from smartnav_graph.estimate.result.score_tests import Unmodelled

LEVELS = ("good", "doubtful", "contradictory")


@dataclass(frozen=True)
class Reason:
    """Why a run is not good. start_s, end_s since time zero, None for all of it; size : of the fault, in the unit of
    the text."""

    level: str
    sensor: str
    text: str
    remedy: str
    size: float | None = None
    start_s: float | None = None
    end_s: float | None = None

    def to_dict(self) -> dict[str, object]:
        """As in summary.json."""
        return {name: round(value, 4) if isinstance(value, float) else value for name, value in vars(self).items()}


@dataclass(frozen=True)
class VerdictInputs:
    """What the tests look at."""

    solved: SolvedProblem
    fit: Chi2
    withheld: Mapping[str, Withheld]
    together: bool
    unmodelled: Unmodelled | None = None


Test = Callable[[VerdictInputs], Iterator[Reason]]

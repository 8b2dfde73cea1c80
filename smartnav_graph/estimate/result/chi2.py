"""Chi-square per degree of freedom of every sensor, each by its own redundancy (`smoothers.redundancy`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from smartnav_graph.estimate.result.assemble import SolvedProblem
from smartnav_graph.estimate.reweight.image_pair_outliers import Account
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.estimate.reweight.track_outliers import POINT_DOF
from smartnav_graph.factors import builder_of
from smartnav_graph.factors.coplanarity import SHARED, SMART
from smartnav_graph.graph.robust import expected_weighted_square
from smartnav_graph.graph.solution import Solution
from smartnav_graph.smoothers.redundancy import CALIBRATION, redundancies

# Redundancy below which a sum of squares has no information on a sensor's noise.
LEAST_REDUNDANCY = 1.0
# Factors of many measurements, matches or observations of tracks, each of which has a residual. Those in
# use are inside their gate and count in full: under their loss the sum would be too small. Not so beside an error that
# the matches of a pair share: it is in their residuals, and not in those of the rows.
IMAGES = ("image_pairs", SMART)


@dataclass(frozen=True)
class SensorFit:
    """The factors of one builder: residuals (their number), redundancy, and the sum of squares of their whitened
    residuals, in units of what a row under its loss has on average where its sigma is right."""

    residuals: int = 0
    redundancy: float = 0.0
    square: float = 0.0


@dataclass(frozen=True)
class Chi2:
    """Sums of squares and redundancy by builder, priors too; cost : of the whole graph."""

    cost: float
    parts: Mapping[str, SensorFit]

    @property
    def dof(self) -> float:
        """Residuals of the whole graph, priors too, less its unknowns."""
        return sum(part.redundancy for part in self.parts.values())

    def per_dof(self) -> dict[str, float]:
        """``overall`` and every sensor that has redundancy; 1 is expected."""
        found = {"overall": 2.0 * self.cost / max(self.dof, 1.0)}
        found |= {name: part.square / part.redundancy for name, part in self._sensors(enough=True)}
        return {name: round(value, 5) for name, value in found.items()}

    def reasons(self) -> dict[str, str]:
        """Why a sensor has no chi-square."""
        return {
            name: f"redundancy {abs(part.redundancy):.2f} of {part.residuals} residuals: the solution follows them"
            for name, part in self._sensors(enough=False)
        }

    def _sensors(self, *, enough: bool) -> Iterable[tuple[str, SensorFit]]:
        for name, part in self.parts.items():
            if name not in ("prior", CALIBRATION) and (part.redundancy >= LEAST_REDUNDANCY) == enough:
                yield name, part


def chi2_of(solved: SolvedProblem, solution: Solution, tracks: Account | None) -> Chi2:
    """Of a solved problem and the residuals of its keyframes."""
    parts: dict[str, SensorFit] = {}
    for name, found in redundancies(solved.estimate).items():
        count, square = found.residuals, found.square / _expected(solved, name)
        if name in IMAGES:
            rows = solution.residuals.of(name) & solution.residuals.used
            count, whole = int(rows.sum()), float((solution.residuals.whitened[rows] ** 2).sum())
            square = square if solved.pass_state.noise_scales.get(SHARED) else whole
        count -= _unknown_heights(solved, name)
        if name == SMART and tracks is not None:
            count -= POINT_DOF * tracks.used
        sensor = solved.problem.label(builder_of(name))
        before = parts.get(sensor, SensorFit())
        parts[sensor] = SensorFit(
            residuals=before.residuals + count,
            redundancy=before.redundancy + count - found.fitted,
            square=before.square + square,
        )
    return Chi2(solved.estimate.cost, parts)


def _unknown_heights(solved: SolvedProblem, name: str) -> int:
    """Rows in use of a stream of positions that have no height: a residual that is zero, and measures nothing."""
    found, builders = solved.fixes.get(name), position_builders(solved.problem.builders)
    if found is None:
        return 0
    rows = found.rows[solved.pass_state.used(name, found.rows)]
    return sum(int((~b.measures_height[rows]).sum()) for b in builders if b.name == name)


def _expected(solved: SolvedProblem, name: str) -> float:
    """Average weighted square of a residual under the losses of one kind of factor."""
    loss = {builder.name: builder.config.loss for builder in position_builders(solved.problem.builders)}.get(name)
    if loss is not None:
        return expected_weighted_square("huber", 3) if loss == "huber" else 1.0
    stacks = solved.estimate.stacks(name)
    if not stacks:
        return 1.0
    dims = [stack.linearize(solved.estimate.snapshot)[0].shape[1] for stack in stacks]
    expected = [expected_weighted_square(stack.loss, dim) for stack, dim in zip(stacks, dims, strict=True)]
    return float(np.average(expected, weights=[len(stack.keys) for stack in stacks]))

"""Every rejected measurement by itself: when, which sensor, how far off."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from smartnav_graph.estimate.problem import Problem
from smartnav_graph.estimate.result.assemble import SolvedProblem
from smartnav_graph.smoothers.estimate import Estimate

Rejection = Mapping[str, Any]

# Weight below which a redescending loss has left a row out of a run that gates nothing (replay without polish).
LEFT_OUT = 0.1
MOST = 10_000  # rejections listed one by one


def rejections(solved: SolvedProblem) -> list[Rejection]:
    """Rejected rows in time order: t_s since time zero, sensor, row of its stream, size_sigma (norm of the whitened
    residual) and, for positions, size_m. The largest `MOST` where there are more."""
    found = _positions(solved)
    known = {(one["sensor"], one["row"]) for one in found}
    found += [one for one in _rows(solved.problem, solved.estimate) if (one["sensor"], one["row"]) not in known]
    found = sorted(found, key=lambda one: -float(one["size_sigma"]))[:MOST]
    return sorted(found, key=lambda one: (one["t_s"], one["sensor"]))


def _positions(solved: SolvedProblem) -> list[Rejection]:
    found: list[Rejection] = []
    problem, estimate = solved.problem, solved.estimate
    for name, residuals in solved.fixes.items():
        stream = getattr(problem.session, name, None)
        out = np.flatnonzero(~solved.pass_state.used(name, residuals.rows))
        metres, sigmas = np.linalg.norm(residuals.residual, axis=1), np.sqrt(residuals.square)
        for k in out:
            row = int(residuals.rows[k])
            t_ns = int(estimate.t_ns[residuals.keyframe[k]] if stream is None else stream.t_ns[row])
            found.append(_entry(problem, t_ns, name, row, float(sigmas[k])) | {"size_m": round(float(metres[k]), 3)})
    return found


def _rows(problem: Problem, estimate: Estimate) -> list[Rejection]:
    """Rows of blocks that were not used, or that a redescending loss left out."""
    found: list[Rejection] = []
    for sensor in sorted({block.sensor for block in estimate.blocks}):
        for stack in estimate.stacks(sensor):
            size = stack.sizes(estimate.snapshot)
            left_out = ~stack.used
            if stack.loss == "cauchy":
                left_out |= stack.weight(size[:, None]) < LEFT_OUT
            found += [
                _entry(problem, int(stack.t_ns[k]), sensor, int(stack.rows[k]), float(size[k]))
                for k in np.flatnonzero(left_out)
            ]
    return found


def _entry(problem: Problem, t_ns: int, sensor: str, row: int, sigmas: float) -> dict[str, Any]:
    t_s = float(problem.session.seconds(t_ns))
    return {"t_s": round(t_s, 4), "sensor": sensor, "row": row, "size_sigma": round(sigmas, 2)}

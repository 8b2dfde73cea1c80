"""Batch smoothing of a session from end to end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np

from smartnav_graph.core import figures, frames
from smartnav_graph.core.display import Summarised
from smartnav_graph.core.errors import SolverError
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.alignment.initial_state import InitialState
from smartnav_graph.estimate.alignment.initialiser import find_initial_state
from smartnav_graph.estimate.alignment.inputs import first_stretch
from smartnav_graph.estimate.alignment.positions_only import first_position
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.passes import StageTimes, causal_start, solve_passes
from smartnav_graph.estimate.problem import Problem, prepare
from smartnav_graph.estimate.result.assemble import (
    SolvedProblem,
    Withheld,
    resample,
    score_holdout,
    to_solution,
    used_counts,
)
from smartnav_graph.estimate.result.diagnostics import Diagnostics, Updates
from smartnav_graph.estimate.result.heading import heading_known, with_unknown_heading
from smartnav_graph.estimate.result.score_tests import unmodelled
from smartnav_graph.estimate.result.summary import run_facts, summarise
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.factors.coplanarity import CoplanarityBuilder
from smartnav_graph.factors.prior import PriorBuilder
from smartnav_graph.factors.smart import SmartBuilder
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState
from smartnav_graph.graph.solution import Solution
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.session import Session
from smartnav_graph.smoothers.estimate import Estimate

# Passes of the second stage that the sigma of the first heading takes.
SECOND_STAGE_PASSES = 2


@dataclass(frozen=True)
class Run(Summarised):
    """Everything one run gives. `summary` is what summary.json holds; `causal_windows` are those that a replay went
    through, one a row of `causal`; `estimate` is the solved graph behind `solution`, made with
    `pass_state`."""

    problem: Problem
    solution: Solution
    summary: Mapping[str, Any]
    causal: Solution | None = None
    withheld: Mapping[str, Withheld] = field(default_factory=dict)
    causal_windows: Sequence[Window] = ()
    diagnostics: Diagnostics | None = None
    estimate: Estimate | None = None
    pass_state: PassState = field(default_factory=PassState)

    def facts(self) -> dict[str, str]:
        """Verdict, mode, size, uncertainty, errors at withheld rows."""
        return run_facts(self.summary)

    def plot_residuals(self) -> figures.AxesList:
        """Whitened residuals of every sensor over time, rejected rows marked, as axes of matplotlib.

        Raises
        ------
        SmartnavError
            matplotlib is not installed.
        """
        return self.solution.residuals.plot(self.solution.t0_ns)

    @property
    def session(self) -> Session:
        """As it was solved; without the stream of a motion model."""
        session = self.problem.session
        return session.replace(imu=None) if self.problem.positions_only else session


def initialise(problem: Problem, longest_s: float | None = None) -> InitialState:
    """First state of a problem; `longest_s` bounds the stretch it is found on (replay)."""
    if problem.positions_only:
        return first_position(problem)

    blind = _without_images(problem)

    def solve(
        prior: PriorBuilder, count: int, pass_state: PassState, initial_values: gtsam.Values | None
    ) -> tuple[Estimate, PassState]:
        windows = blind.windows[:count]
        return solve_passes(blind, windows, prior, pass_state, initial_values=initial_values, coarse_start=True)[:2]

    return _with_second_stage(blind, find_initial_state(first_stretch(problem, longest_s), solve))


def _without_images(problem: Problem) -> Problem:
    """The problem without image pairs and tracks: they are tested against a trajectory, which the start is not yet."""
    kept = [one for one in problem.builders if not isinstance(one, CoplanarityBuilder | SmartBuilder)]
    return replace(problem, builders=kept)


def _with_second_stage(problem: Problem, initial: InitialState) -> InitialState:
    """The start with a sigma of its heading that covers what the first stage leaves out: the heading is found once more
    with clock offsets and correlated errors of the fixes as states, and what it changes by counts as an error."""
    if initial.method not in ("dynamic", "static") or not problem.session.positions():
        return initial
    end_ns = problem.windows[0].t1_ns + round(initial.stretch_s * NS)
    windows = [window for window in problem.windows if window.t1_ns <= end_ns]
    correlated = frozenset(
        b.name for b in position_builders(problem.builders) if b.has_correlated_error(initial.pass_state)
    )
    pass_state = replace(initial.pass_state, stage=LAST_STAGE, correlated=correlated)
    run = replace(problem.config.run, passes=SECOND_STAGE_PASSES)
    short = replace(problem, config=replace(problem.config, run=run))
    try:
        estimate, _, _ = solve_passes(short, windows, initial.prior, pass_state, first_s=initial.stretch_s)
    except SolverError:
        return initial
    device = problem.session.device
    heading = frames.heading_pitch_roll_deg(estimate.states()[0][0], device.forward, device.up)[0, 0]
    sigma = float(np.degrees(np.sqrt(estimate.covariance[0, 2, 2])))
    change = float((heading - initial.heading_deg + 180.0) % 360.0 - 180.0)
    return initial.with_sigma(float(np.hypot(max(sigma, initial.sigma_heading_deg), change)))


def smooth(session: Session, config: Config | None = None, *, progress: Progress = silent) -> Run:
    """Batch smoothing of a recorded session.

    Raises
    ------
    SessionError, ConfigError, SolverError
        Bad input, or a problem that cannot be solved; the message says what to do.
    """
    clock = StageTimes()
    progress("preparing", 0, 0)
    problem = prepare(session, config or Config(), progress=progress)
    clock.lap("prepare")
    progress("finding the start", 0, 0)
    initial = initialise(problem)
    initial_values, pass_state = initial.initial_values, initial.pass_state
    if not problem.session.absolute():
        initial_values, pass_state = causal_start(problem, problem.windows, initial.prior, pass_state, progress)
    clock.lap("initialise")
    estimate, pass_state, passes = solve_passes(
        problem,
        problem.windows,
        initial.prior,
        pass_state,
        initial_values=initial_values,
        first_s=initial.stretch_s,
        progress=progress,
        clock=clock,
    )
    clock.lap("build")
    _refuse_empty(problem, pass_state)
    return _finish(SolvedProblem(problem, estimate, pass_state), initial, clock, {"passes": passes})


def _finish(
    solved: SolvedProblem,
    initial: InitialState,
    clock: StageTimes,
    extra: Mapping[str, Any],
    causal: Solution | None = None,
    updates: Updates | None = None,
) -> Run:
    problem, estimate, pass_state = solved.problem, solved.estimate, solved.pass_state
    keyframes = to_solution(solved)
    # States that left a lag one after the other were never solved together: their residuals say nothing of the data.
    together = causal is None or "polish" in extra
    looked_at = unmodelled(solved) if together and not problem.positions_only else None
    if looked_at is not None:
        keyframes = replace(keyframes, covariance=keyframes.covariance + looked_at.covariance())
    known = heading_known(solved, initial.sigma_heading_deg)
    if not known:
        initial = initial.with_unknown_heading()
        keyframes = replace(keyframes, covariance=with_unknown_heading(keyframes.covariance))
        causal = None if causal is None else replace(causal, covariance=with_unknown_heading(causal.covariance))
    extra = {"heading_known": known and not problem.positions_only, **extra}
    withheld = score_holdout(problem, keyframes, estimate)
    solution = resample(problem, keyframes)
    clock.lap("assemble")
    summary = summarise(solved, initial, keyframes, withheld, clock.to_dict(), extra, looked_at)
    diagnostics = Diagnostics.of(problem, estimate, pass_state, updates)
    return Run(problem, solution, summary, causal, withheld, (), diagnostics, estimate, pass_state)


def _refuse_empty(problem: Problem, pass_state: PassState) -> None:
    counts = used_counts(problem, pass_state)
    if counts and not any(counts.values()):
        rows = ", ".join(f"{name} {len(pass_state.rejected.get(name, ()))}" for name in counts)
        raise SolverError(
            "solve",
            f"every absolute measurement was rejected ({rows})",
            "measurements of the same motion as the inertial data",
            "check clock and units with `smartnav info`, or use --gnss.loss huber",
        )

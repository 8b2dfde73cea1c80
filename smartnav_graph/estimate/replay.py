"""Replay: one window at a time, causal, with an optional final batch solution."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from smartnav_graph.core.progress import Progress, silent, watched
from smartnav_graph.estimate.alignment.initial_state import InitialState
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.passes import StageTimes, run_pass, solve_passes
from smartnav_graph.estimate.problem import TOO_LATE, Problem, batch_problem, prepare
from smartnav_graph.estimate.result.assemble import SolvedProblem, carried_over, causal_solution
from smartnav_graph.estimate.result.diagnostics import UpdateLog
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.estimate.run import Run, _finish, initialise
from smartnav_graph.graph.pass_state import INITIALISATION_S, LAST_STAGE, PassState, Phase
from smartnav_graph.session.session import Session
from smartnav_graph.smoothers import incremental
from smartnav_graph.smoothers.estimate import Estimate, state_distance, states_of
from smartnav_graph.smoothers.incremental import ReplayConfig

# A polish that moves a state further than this starts again from what it found.
FAR_M, FAR_DEG = 0.1, 1.0
# Share of the usual steps after which iSAM2 linearises states anew, with image pairs.
EARLIER = 0.1


def replay(session: Session, config: Config | None = None, *, progress: Progress = silent) -> Run:
    """One window at a time, causal except for the initialisation (at most 30 s); an interrupt keeps what is done.

    Raises
    ------
    SessionError, ConfigError, SolverError
        As `smooth`.
    """
    clock = StageTimes()
    progress("preparing", 0, 0)
    problem = prepare(session, config or Config(), causal=True, progress=progress)
    clock.lap("prepare")
    progress("finding the start", 0, 0)
    initial = initialise(problem, longest_s=INITIALISATION_S)
    clock.lap("initialise")
    smoother = incremental(_smoother_config(problem), problem.session.t0_ns)
    builders, log = [initial.prior.with_position(), *problem.builders], UpdateLog(smoother)
    windows, pass_state = watched("replay", problem.windows, progress), _causal(problem, initial)
    pass_state = run_pass(smoother, windows, builders, pass_state, log.take, interruptible=True)
    clock.lap("replay")
    count = len(log.states)
    interrupted = count < len(problem.windows)
    if interrupted and count < 2:
        raise KeyboardInterrupt
    last_ns = log.states[-1].t_ns if interrupted else None
    problem = _counted(replace(problem, windows=problem.windows[:count]), smoother.dropped)
    estimate, causal, updates = smoother.estimate(count), causal_solution(problem, log.states), log.updates()
    causal_windows = problem.windows
    lookahead_s = max((builder.lookahead_s for builder in problem.builders), default=0.0)
    extra: dict[str, Any] = {
        "mode": f"replay {problem.config.replay.smoother}" + (", interrupted" if interrupted else ""),
        "update_ms": {name: float(f(log.latency_ms)) for name, f in _LATENCY.items()},
        "delay_s": max(initial.stretch_s, lookahead_s),
        "lookahead_s": lookahead_s,
    }
    if problem.config.replay.polish:
        try:
            problem, estimate, pass_state, extra["polish"] = _polished(problem, estimate, initial, last_ns, progress)
        except KeyboardInterrupt:
            extra["mode"] += ", polish interrupted"
        clock.lap("polish")
    run = _finish(SolvedProblem(problem, estimate, pass_state), initial, clock, extra, causal, updates)
    return replace(run, causal_windows=causal_windows)


def _smoother_config(problem: Problem) -> ReplayConfig:
    """In iSAM2 the matches of a pair keep the weights under their loss of the state that they were last linearised at:
    with image pairs states are linearised anew after smaller steps."""
    config = problem.config.replay
    earlier = config.smoother == "isam2" and problem.pairs is not None
    return replace(config, relinearize=config.relinearize * EARLIER) if earlier else config


def _causal(problem: Problem, initial: InitialState) -> PassState:
    correlated = frozenset(
        b.name for b in position_builders(problem.builders) if b.has_correlated_error(initial.pass_state)
    )
    return replace(initial.pass_state, phase=Phase.CAUSAL, correlated=correlated, stage=LAST_STAGE)


def _counted(problem: Problem, too_late: Mapping[str, int]) -> Problem:
    """The problem with the rows counted that were older than the lag."""
    streams = problem.session.streams()
    counts = {name: count for name, count in too_late.items() if count and name in streams}
    return problem.with_dropped(TOO_LATE, counts)


def _polished(
    problem: Problem, estimate: Estimate, initial: InitialState, available_ns: int | None, progress: Progress
) -> tuple[Problem, Estimate, PassState, dict[str, float]]:
    """Everything once more by batch, every row at its measurement time, and how far that moved the estimate.

    What is linearised at earlier states (preintegrated windows, delayed fixes) is built again where they moved far.
    """
    whole = batch_problem(problem, available_ns)
    initial_values = estimate.values if whole is problem else carried_over(problem, estimate, whole.windows)
    pass_state, total = initial.pass_state, 0
    change: dict[str, float] = {}
    while True:
        found, pass_state, passes = solve_passes(
            whole, whole.windows, initial.prior, pass_state, initial_values=initial_values, progress=progress
        )
        metres, degrees = state_distance(states_of(initial_values, found.indices), found.states())
        change = change or {"largest_change_m": metres, "largest_change_deg": degrees}
        total += passes
        if (metres < FAR_M and degrees < FAR_DEG) or total >= whole.config.run.passes:
            return whole, found, pass_state, {**change, "passes": total}
        initial_values = found.values


_LATENCY: Mapping[str, Callable[[Sequence[float]], Any]] = {
    "median": np.median,
    "p99": lambda values: np.percentile(values, 99),
    "max": np.max,
}

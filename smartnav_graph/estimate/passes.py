"""Batch passes over all windows, until a pass changes nothing any more."""

from __future__ import annotations

import gc
import itertools
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

from smartnav_graph.core.progress import Progress, silent, watched
from smartnav_graph.estimate.problem import Problem
from smartnav_graph.estimate.reweight.image_pair_outliers import check_pairs, lost
from smartnav_graph.estimate.reweight.update import BENT_M, WIDE_M, extra_passes, update_pass_state, widen_robust_scale
from smartnav_graph.factors.coplanarity import COMPRESSED, CoplanarityBuilder
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.factors.prior import PriorBuilder
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState, Phase
from smartnav_graph.graph.update import Builder, build_update, one_of
from smartnav_graph.graph.windows import Window
from smartnav_graph.smoothers import Smoother, incremental
from smartnav_graph.smoothers.batch import Batch
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.incremental import ReplayConfig
from smartnav_graph.smoothers.minimise import FIRST


class Clock:
    """Wall seconds by stage."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = dict.fromkeys(("prepare", "initialise", "preintegrate", "build"), 0.0)
        self._start = self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to `stage`."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + now - self._last
        self._last = now

    def spend(self, stage: str, seconds: float) -> None:
        """Add `seconds` to `stage` and take them from whatever the next lap is called."""
        self.stages[stage] = self.stages.get(stage, 0.0) + seconds
        self._last += seconds

    def to_dict(self) -> dict[str, float]:
        """Seconds by stage and in all."""
        return {**self.stages, "total": time.perf_counter() - self._start}


def one_pass(
    smoother: Smoother, windows: Iterable[Window], builders: Sequence[Builder], pass_state: PassState, problem: Problem
) -> None:
    """Every window through the smoother."""
    with _no_collection():
        for window in windows:
            smoother.update(build_update(window, smoother.latest(), builders, pass_state, problem.session.t0_ns))


def _check_pairs_again(smoother: Batch, builders: Sequence[Builder], pass_state: PassState) -> PassState:
    """Judge image pairs again and again at what they lead to, all else as it is; the memory with what was found."""
    pairs = one_of(builders, CoplanarityBuilder)
    while pairs is not None and 0 < pass_state.tests(pairs.name) < COMPRESSED:
        pass_state = check_pairs(builders, smoother.provisional(), pass_state)
        smoother.renewed(partial(pairs.renew, pass_state=pass_state))
    return pass_state


@contextmanager
def _no_collection() -> Iterator[None]:
    """Pause Python's garbage collector: a pass makes thousands of small objects that stay, and no cycles."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()


def solve_passes(
    problem: Problem,
    windows: Sequence[Window],
    prior: PriorBuilder,
    pass_state: PassState,
    *,
    initial_values: Any = None,
    coarse_start: bool = False,
    first_s: float = 0.0,
    progress: Progress = silent,
    clock: Clock | None = None,
) -> tuple[Estimate, PassState, int]:
    """Batch passes until there is nothing more to learn.

    `initial_values` are values of an earlier solve; `coarse_start` says that the first state is a mere guess;
    `first_s` how long a stretch it was found on.

    Returns
    -------
    estimate, the memory it was made with, and the number of passes
    """
    most = problem.config.run.passes + extra_passes(problem.builders)
    precision = FIRST if coarse_start else problem.config.solve
    builders, first, diverged = [prior, *problem.builders], initial_values, False
    if pass_state.phase is Phase.ROBUST and not coarse_start:
        pass_state = widen_robust_scale(problem.builders, pass_state)
    for count in itertools.count(1):
        most += pass_state.narrowing
        stage = f"pass {count} of at most {most}"
        smoother = Batch(problem.config.batch, precision, initial_values, problem.session.t0_ns, coarse_start, first_s)
        one_pass(smoother, watched(stage, windows, progress), builders, pass_state, problem)
        progress(f"{stage}, solving", 0, 0)
        pass_state = _check_pairs_again(smoother, problem.builders, pass_state)
        estimate = smoother.estimate()
        if clock is not None:
            _account(clock, estimate, problem.builders)
        learnt, done = update_pass_state(problem.builders, windows, estimate, pass_state)
        if done or count == most or (coarse_start and learnt.stage > pass_state.stage):
            return estimate, pass_state, count
        # Least squares bent by outliers is a poor start for a redescending loss: settled stretch by stretch it stays
        # near the truth, and a burst stands out against what is foretold. Where it loses its way, least squares it is.
        if pass_state.phase is Phase.ROBUST and not (estimate.converged or coarse_start or diverged):
            pass_state = replace(pass_state, phase=Phase.PLAIN, robust_floor_m=0.0, rejected={})
            initial_values, diverged, most = first, True, most + 2
            continue
        initial_values = estimate.values
        if pass_state.phase is Phase.PLAIN and learnt.phase is Phase.ROBUST and learnt.stage == 0 and not coarse_start:
            initial_values, learnt = (
                (initial_values if diverged else first),
                widen_robust_scale(problem.builders, learnt, BENT_M if diverged else WIDE_M),
            )
        if learnt.stage > pass_state.stage and lost(problem.builders, estimate):
            initial_values, learnt = _window_by_window(problem, windows, builders, learnt, progress)
        pass_state = learnt
    raise AssertionError("unreachable")


def _window_by_window(
    problem: Problem, windows: Sequence[Window], builders: Sequence[Builder], pass_state: PassState, progress: Progress
) -> tuple[Any, PassState]:
    """Values to begin from, and what they teach, where inertial data alone stray too far: as a replay has it, the
    trajectory never leaves what standstills and images hold."""
    smoother, t0_ns = incremental(ReplayConfig(), problem.session.t0_ns), problem.session.t0_ns
    first, previous = replace(pass_state, phase=Phase.CAUSAL, outlier_tests={}), None
    with _no_collection():
        for window in watched("window by window", windows, progress):
            smoother.update(build_update(window, previous, builders, first, t0_ns))
            previous = smoother.known()
    judged = replace(pass_state, outlier_tests={})
    if pass_state.stage < LAST_STAGE:
        return smoother.values(), judged
    estimate = smoother.estimate()
    return estimate.values, check_pairs(builders, estimate, judged)


def _forget(builders: Sequence[Builder]) -> None:
    """Start the builders' own clocks anew."""
    for builder in builders:
        if isinstance(builder, ImuBuilder):
            builder.spent()


def _account(clock: Clock, estimate: Estimate, builders: Sequence[Builder]) -> None:
    """Time of one pass by stage: what is neither preintegration nor algebra is building."""
    for stage, seconds in estimate.seconds.items():
        clock.spend(stage, seconds)
    for builder in builders:
        if isinstance(builder, ImuBuilder):
            clock.spend("preintegrate", builder.spent())
    clock.lap("build")

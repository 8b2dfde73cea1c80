"""The one loop: `run_pass` takes every window through a smoother. Batch repeats it until a pass changes nothing.

    solve_passes    run_pass -> estimate -> update_pass_state -> next_pass, until that is None

Replay is one `run_pass` through an incremental smoother (`replay`).
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from smartnav_graph.core.errors import SolverError
from smartnav_graph.core.progress import Progress, silent, watched
from smartnav_graph.estimate.problem import Problem
from smartnav_graph.estimate.reweight.image_pair_outliers import check_pairs, images_diverged
from smartnav_graph.estimate.reweight.update import extra_passes, update_pass_state, widen_robust_scale
from smartnav_graph.factors.coplanarity import COMPRESSED, CoplanarityBuilder
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.factors.prior import PriorBuilder
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState, Phase
from smartnav_graph.graph.update import Builder, GraphUpdate, build_update, one_of
from smartnav_graph.graph.windows import Window
from smartnav_graph.smoothers import Smoother, incremental
from smartnav_graph.smoothers.batch import Batch
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.incremental import ReplayConfig
from smartnav_graph.smoothers.minimise import FIRST

# How far (m) the first robust pass starts from the truth: as prediction between fixes is off, and as outliers bend
# least squares.
PREDICTION_ERROR_M, LEAST_SQUARES_ERROR_M = 3.0, 30.0
# Passes granted for another least squares solution where the robust pass diverged.
RESTART_PASSES = 2


def run_pass(
    smoother: Smoother,
    windows: Iterable[Window],
    builders: Sequence[Builder],
    pass_state: PassState,
    on_update: Callable[[GraphUpdate, float], None] | None = None,
    *,
    interruptible: bool = False,
) -> PassState:
    """One pass: build the update of every window and give it to the smoother.

    Parameters
    ----------
    on_update : called after each update with it and the reading of `time.perf_counter` before it
    interruptible : an interrupt ends the pass instead of being raised

    Returns
    -------
    the pass state with what the builders selected in a causal pass
    """
    builders = [builder.begin() for builder in builders]
    try:
        with _no_collection():
            for window in windows:
                begin = time.perf_counter()
                update = build_update(window, smoother.latest(), builders, pass_state, smoother.t0_ns)
                smoother.update(update)
                if on_update is not None:
                    on_update(update, begin)
    except KeyboardInterrupt:
        if not interruptible:
            raise
    except np.linalg.LinAlgError as error:
        raise SolverError(
            "solve",
            f"no trajectory of a device agrees with the measurements ({error})",
            "fixes and inertial data of one motion",
            "look for jumps of the fixes, and for units and axes, with `smartnav info`",
        ) from error
    for builder in builders:
        pass_state = builder.end(pass_state)
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


@dataclass(frozen=True)
class Pass:
    """One batch pass, before it is run.

    limit : number of the last pass allowed
    initial_values : of this pass; first_values : of the first pass (None: predicted and anchored segment by segment)
    coarse_start : the first state is only an initial guess
    start_error_m : how far a robust pass starts from the truth, zero where the scale of its loss stays
    causal_start : find the initial values window by window, as in replay
    restarted : least squares was solved again after a robust pass diverged
    """

    pass_state: PassState
    limit: int
    number: int = 1
    initial_values: gtsam.Values | None = None
    first_values: gtsam.Values | None = None
    coarse_start: bool = False
    start_error_m: float = 0.0
    causal_start: bool = False
    restarted: bool = False

    @property
    def title(self) -> str:
        """What is shown as progress."""
        return f"pass {self.number} of at most {self.limit}"


def next_pass(
    pass_: Pass, estimate: Estimate, updated: PassState, *, done: bool, diverged: bool = False
) -> Pass | None:
    """The pass after `pass_`, or None where its estimate is final.

    estimate : of `pass_`; updated : its pass state as the estimate changes it; done : nothing changed; diverged : the
    trajectory between images is too uncertain for the image pairs that would join now
    """
    state, second_stage = pass_.pass_state, updated.stage > pass_.pass_state.stage
    if done or pass_.number == pass_.limit or (pass_.coarse_start and second_stage):
        return None
    following = replace(
        pass_,
        number=pass_.number + 1,
        pass_state=updated,
        initial_values=estimate.values,
        start_error_m=0.0,
        causal_start=diverged,
    )
    if pass_.coarse_start:
        return following
    if updated.trusted != state.trusted:  # not the fixes were wrong, but the solution
        return replace(following, initial_values=pass_.first_values, limit=pass_.limit + RESTART_PASSES)
    # Least squares bent by outliers is a poor start for a redescending loss. Predicted and solved segment by segment,
    # the trajectory stays near the truth and a burst of outliers is obvious. Where that diverges: least squares again.
    if state.phase is Phase.ROBUST and not (estimate.converged or pass_.restarted):
        plain = replace(state, phase=Phase.PLAIN, robust_floor_m=0.0, rejected={})
        limit = pass_.limit + RESTART_PASSES
        return replace(
            following,
            pass_state=plain,
            initial_values=pass_.first_values,
            limit=limit,
            causal_start=False,
            restarted=True,
        )
    if state.phase is Phase.PLAIN and updated.phase is Phase.ROBUST and updated.stage == 0:
        if pass_.restarted:
            return replace(following, start_error_m=LEAST_SQUARES_ERROR_M)
        return replace(following, initial_values=pass_.first_values, start_error_m=PREDICTION_ERROR_M)
    return following


def solve_passes(
    problem: Problem,
    windows: Sequence[Window],
    prior: PriorBuilder,
    pass_state: PassState,
    *,
    initial_values: gtsam.Values | None = None,
    coarse_start: bool = False,
    first_s: float = 0.0,
    progress: Progress = silent,
    clock: StageTimes | None = None,
) -> tuple[Estimate, PassState, int]:
    """Batch passes until nothing changes.

    Parameters
    ----------
    initial_values : of an earlier solve
    coarse_start : the first state is only an initial guess
    first_s : length of the segment that it was found on

    Returns
    -------
    estimate, the pass state it was made with, and the number of passes
    """
    limit = problem.config.run.passes + extra_passes(problem.builders)
    robust = pass_state.phase is Phase.ROBUST and not coarse_start
    error_m = PREDICTION_ERROR_M if robust else 0.0
    pass_ = Pass(pass_state, limit, 1, initial_values, initial_values, coarse_start, error_m)
    builders = [prior, *problem.builders]
    while True:
        pass_ = _ready(pass_, problem, windows, prior, progress)
        final = not coarse_start and may_be_last(pass_, problem.builders)
        smoother = Batch(
            problem.config.batch,
            problem.config.solver if final else FIRST,
            pass_.initial_values,
            problem.session.t0_ns,
            coarse_start,
            first_s,
            final,
        )
        before_s = _preintegration_s(problem)
        run_pass(smoother, watched(pass_.title, windows, progress), builders, pass_.pass_state)
        progress(f"{pass_.title}, solving", 0, 0)
        pass_ = replace(pass_, pass_state=_check_pairs_again(smoother, problem.builders, pass_.pass_state))
        estimate = smoother.estimate()
        if clock is not None:
            clock.pass_done(estimate, _preintegration_s(problem) - before_s)
        updated, done = update_pass_state(problem.builders, windows, estimate, pass_.pass_state)
        joins = bool(updated.outlier_tests) and not pass_.pass_state.outlier_tests
        diverged = joins and images_diverged(problem.builders, estimate, updated)
        following = next_pass(pass_, estimate, updated, done=done, diverged=diverged)
        if following is None:
            return estimate, pass_.pass_state, pass_.number
        pass_ = following
        del smoother, estimate  # their matrices are large: no two at a time


def may_be_last(pass_: Pass, builders: Iterable[Builder]) -> bool:
    """Whether the solution may be that of this pass: the second stage has begun, or there is none."""
    first = pass_.pass_state.stage < LAST_STAGE and any(b.has_second_stage(pass_.pass_state) for b in builders)
    return not first or pass_.number == pass_.limit


def _ready(pass_: Pass, problem: Problem, windows: Sequence[Window], prior: PriorBuilder, progress: Progress) -> Pass:
    """The pass with its initial values and the scale of its loss; a scale that will shrink grants one pass more."""
    state, values = pass_.pass_state, pass_.initial_values
    if pass_.start_error_m > 0.0:
        state = widen_robust_scale(problem.builders, state, pass_.start_error_m)
    if pass_.causal_start:
        values, state = causal_start(problem, windows, prior, state, progress)
    return replace(pass_, pass_state=state, initial_values=values, limit=pass_.limit + state.narrowing)


def _check_pairs_again(smoother: Batch, builders: Sequence[Builder], pass_state: PassState) -> PassState:
    """Test image pairs against coarse solutions with them, all else as it is, until they are all decided."""
    pairs = one_of(builders, CoplanarityBuilder)
    while pairs is not None and 0 < pass_state.tests(pairs.name) < COMPRESSED:
        pass_state = check_pairs(builders, smoother.provisional(), pass_state)
        smoother.renewed(partial(pairs.begin().renew, pass_state=pass_state))
    return pass_state


def causal_start(
    problem: Problem, windows: Sequence[Window], prior: PriorBuilder, pass_state: PassState, progress: Progress
) -> tuple[gtsam.Values, PassState]:
    """Initial values found window by window, as in replay, and the pass state after that: where dead reckoning drifts
    too far, standstills and images bound its errors on the way."""
    smoother = incremental(ReplayConfig(), problem.session.t0_ns)
    causal = replace(pass_state, phase=Phase.CAUSAL, outlier_tests={}, selections={})
    builders = [prior.with_position(), *problem.builders]
    run_pass(smoother, watched("window by window", windows, progress), builders, causal)
    pass_state = replace(pass_state, outlier_tests={}, selections={})
    if pass_state.stage < LAST_STAGE:
        return smoother.values(), pass_state
    estimate = smoother.estimate()
    return estimate.values, check_pairs(builders, estimate, pass_state)


def _preintegration_s(problem: Problem) -> float:
    imu = one_of(problem.builders, ImuBuilder)
    return 0.0 if imu is None else imu.cache.seconds


class StageTimes:
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

    def pass_done(self, estimate: Estimate, preintegration_s: float) -> None:
        """Time of one pass by stage: what is neither preintegration nor algebra is building."""
        for stage, seconds in {**estimate.seconds, "preintegrate": preintegration_s}.items():
            self.spend(stage, seconds)
        self.lap("build")

    def to_dict(self) -> dict[str, float]:
        """Seconds by stage and in all."""
        return {**self.stages, "total": time.perf_counter() - self._start}

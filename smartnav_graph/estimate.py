"""The loop, for batch and for replay: windows -> steps -> smoother -> solution.

for _ in range(passes):                       # replay: one, causal
    for window in windows:
        smoother.update(build_step(window, smoother.latest(), builders, memory))
    memory, done = revise(smoother.estimate(), memory)
"""

from __future__ import annotations

import gc
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.assemble import Withheld, carried_over, causal_solution, densify, score, to_solution, used_counts
from smartnav_graph.config import Config
from smartnav_graph.errors import SolverError
from smartnav_graph.factors.coplanarity import COMPRESSED, CoplanarityBuilder
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.factors.prior import PriorBuilder
from smartnav_graph.first_state import initialiser_of
from smartnav_graph.graph import LAST_STAGE, Builder, Memory, State, Window, build_step, one_of
from smartnav_graph.outcome import Outcome
from smartnav_graph.pair_gate import lost, settled
from smartnav_graph.problem import TOO_LATE, Problem, prepare, recut
from smartnav_graph.progress import Progress, silent, watched
from smartnav_graph.revise import BENT_M, WIDE_M, extra_passes, position_builders, revise, widened
from smartnav_graph.session import Session
from smartnav_graph.smoothers import Smoother, incremental
from smartnav_graph.smoothers.batch import Batch
from smartnav_graph.smoothers.estimate import Estimate, distance, states_of
from smartnav_graph.smoothers.incremental import ReplayConfig
from smartnav_graph.smoothers.minimise import FIRST
from smartnav_graph.solution import Solution
from smartnav_graph.start import Given, Initial
from smartnav_graph.summary import summarise
from smartnav_graph.trace import Trace, UpdateLog, Updates

Floats = NDArray[np.float64]
Times = NDArray[np.int64]


# A polish that moves a state further than this starts anew from what it found.
FAR_M, FAR_DEG = 0.1, 1.0


@dataclass(frozen=True)
class Run:
    """Everything one run gives. `summary` is what summary.json holds; `causal_windows` are those that a replay went
    through, one a row of `causal`; `estimate` is the solved graph behind `solution`."""

    problem: Problem
    solution: Solution
    summary: Mapping[str, Any]
    causal: Solution | None = None
    withheld: Mapping[str, Withheld] = field(default_factory=dict)
    causal_windows: Sequence[Window] = ()
    trace: Trace | None = None
    estimate: Estimate | None = None

    @property
    def session(self) -> Session:
        return self.problem.session


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
    smoother: Smoother, windows: Iterable[Window], builders: Sequence[Builder], memory: Memory, problem: Problem
) -> None:
    """Every window through the smoother."""
    with _no_collection():
        for window in windows:
            smoother.update(build_step(window, smoother.latest(), builders, memory, problem.session.t0_ns))


def _settled_pairs(smoother: Batch, builders: Sequence[Builder], memory: Memory) -> Memory:
    """Judge image pairs again and again at what they lead to, all else as it is; the memory with what was found."""
    pairs = one_of(builders, CoplanarityBuilder)
    while pairs is not None and 0 < memory.settled.get(pairs.name, 0) < COMPRESSED:
        memory = settled(builders, smoother.provisional(), memory)
        smoother.renewed(partial(pairs.renew, memory=memory))
    return memory


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
    memory: Memory,
    *,
    warm: Any = None,
    unsure: bool = False,
    first_s: float = 0.0,
    progress: Progress = silent,
    clock: Clock | None = None,
) -> tuple[Estimate, Memory, int]:
    """Batch passes until there is nothing more to learn.

    `warm` are values of an earlier solve; `unsure` says that the first state is a mere guess; `first_s` how long a
    stretch it was found on.

    Returns
    -------
    estimate, the memory it was made with, and the number of passes
    """
    most = problem.config.run.passes + extra_passes(problem.builders)
    precision = FIRST if unsure else problem.config.solve
    builders, first, astray = [prior, *problem.builders], warm, False
    if memory.phase == "robust" and not unsure:
        memory = widened(problem.builders, memory)
    for count in itertools.count(1):
        most += memory.narrowing
        stage = f"pass {count} of at most {most}"
        smoother = Batch(problem.config.batch, precision, warm, problem.session.t0_ns, unsure, first_s)
        one_pass(smoother, watched(stage, windows, progress), builders, memory, problem)
        progress(f"{stage}, solving", 0, 0)
        memory = _settled_pairs(smoother, problem.builders, memory)
        estimate = smoother.estimate()
        if clock is not None:
            _account(clock, estimate, problem.builders)
        learnt, done = revise(problem.builders, windows, estimate, memory)
        if done or count == most or (unsure and learnt.stage > memory.stage):
            return estimate, memory, count
        # Least squares bent by outliers is a poor start for a redescending loss: settled stretch by stretch it stays
        # near the truth, and a burst stands out against what is foretold. Where it loses its way, least squares it is.
        if memory.phase == "robust" and not (estimate.converged or unsure or astray):
            memory = replace(memory, phase="plain", control=0.0, rejected={})
            warm, astray, most = first, True, most + 2
            continue
        warm = estimate.values
        if memory.phase == "plain" and learnt.phase == "robust" and learnt.stage == 0 and not unsure:
            warm, learnt = (warm if astray else first), widened(problem.builders, learnt, BENT_M if astray else WIDE_M)
        if learnt.stage > memory.stage and lost(problem.builders, estimate):
            warm, learnt = _window_by_window(problem, windows, builders, learnt, progress)
        memory = learnt
    raise AssertionError("unreachable")


def _window_by_window(
    problem: Problem, windows: Sequence[Window], builders: Sequence[Builder], memory: Memory, progress: Progress
) -> tuple[Any, Memory]:
    """Values to begin from, and what they teach, where inertial data alone stray too far: as a replay has it, the
    trajectory never leaves what standstills and images hold."""
    smoother, t0_ns = incremental(ReplayConfig(), problem.session.t0_ns), problem.session.t0_ns
    first, previous = replace(memory, phase="causal", settled={}), None
    with _no_collection():
        for window in watched("window by window", windows, progress):
            smoother.update(build_step(window, previous, builders, first, t0_ns))
            previous = smoother.known()
    judged = replace(memory, settled={})
    if memory.stage < LAST_STAGE:
        return smoother.values(), judged
    estimate = smoother.estimate()
    return estimate.values, settled(builders, estimate, judged)


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


def initialise(problem: Problem, longest_s: float | None = None) -> Initial:
    """First state of a problem; `longest_s` bounds the stretch it may look at."""

    def solve(prior: PriorBuilder, count: int, memory: Memory, warm: Any = None) -> tuple[Estimate, Memory]:
        estimate, memory, _ = solve_passes(problem, problem.windows[:count], prior, memory, warm=warm, unsure=True)
        return estimate, memory

    given = Given.parse(problem.config.run.initial) if problem.config.run.initial else None
    return initialiser_of(problem, longest_s).run(solve, given)


def smooth(session: Session, config: Config | None = None, *, progress: Progress = silent) -> Run:
    """Batch smoothing of a recorded session.

    Raises
    ------
    SessionError, ConfigError, SolverError
        Bad input, or a problem that cannot be solved; the message says what to do.
    """
    clock = Clock()
    progress("preparing", 0, 0)
    problem = prepare(session, config or Config())
    clock.lap("prepare")
    progress("finding the start", 0, 0)
    initial = initialise(problem)
    warm, memory = initial.warm, initial.memory
    if not problem.session.absolute():
        builders = [initial.prior, *problem.builders]
        warm, memory = _window_by_window(problem, problem.windows, builders, memory, progress)
    _forget(problem.builders)
    clock.lap("initialise")
    estimate, memory, passes = solve_passes(
        problem,
        problem.windows,
        initial.prior,
        memory,
        warm=warm,
        first_s=initial.stretch_s,
        progress=progress,
        clock=clock,
    )
    clock.lap("build")
    _refuse_empty(problem, memory)
    return _finish(Outcome(problem, estimate, memory), initial, clock, {"passes": passes})


def _finish(
    outcome: Outcome,
    initial: Initial,
    clock: Clock,
    extra: Mapping[str, Any],
    causal: Solution | None = None,
    updates: Updates | None = None,
) -> Run:
    problem, estimate = outcome.problem, outcome.estimate
    keyframes = to_solution(outcome)
    withheld = score(problem, keyframes, estimate)
    solution = densify(problem, keyframes)
    clock.lap("assemble")
    summary = summarise(outcome, initial, keyframes, withheld, clock.to_dict(), extra)
    trace = Trace.of(problem, estimate, outcome.memory, updates)
    return Run(problem, solution, summary, causal, withheld, trace=trace, estimate=estimate)


def _refuse_empty(problem: Problem, memory: Memory) -> None:
    """All fixes rejected is no solution."""
    counts = used_counts(problem, memory)
    if counts and not any(counts.values()):
        rows = ", ".join(f"{name} {len(memory.rejected.get(name, ()))}" for name in counts)
        raise SolverError(
            "solve",
            f"every absolute measurement was rejected ({rows})",
            "measurements of the same motion as the inertial data",
            "check clock and units with `smartnav info`, or use --gnss.loss huber",
        )


def replay(session: Session, config: Config | None = None, *, progress: Progress = silent) -> Run:
    """One window at a time, causal but for the initialisation stretch (at most 30 s); an interrupt leaves what is done.

    Raises
    ------
    SessionError, ConfigError, SolverError
        As `smooth`.
    """
    clock = Clock()
    progress("preparing", 0, 0)
    problem = prepare(session, config or Config(), causal=True)
    clock.lap("prepare")
    progress("finding the start", 0, 0)
    initial = initialise(problem, longest_s=30.0)
    clock.lap("initialise")
    options = problem.config.replay
    smoother = incremental(options, problem.session.t0_ns)
    builders = [initial.prior.placed(), *problem.builders]
    wandering = frozenset(b.name for b in position_builders(problem.builders) if b.wanders(initial.memory))
    memory = replace(initial.memory, phase="causal", correlated=wandering, stage=LAST_STAGE)
    log = UpdateLog()
    states: list[State] = []
    interrupted = False
    try:
        with _no_collection():  # a pause of Python's would be a late update
            for window in watched("replay", problem.windows, progress):
                begin = time.perf_counter()
                previous = states[-1] if states else None
                step = build_step(window, previous, builders, memory, problem.session.t0_ns)
                smoother.update(step)
                states.append(smoother.known())
                log.take(step, smoother, time.perf_counter() - begin)
    except KeyboardInterrupt:
        interrupted = True
        if len(states) < 2:
            raise
    clock.lap("replay")
    problem = _counted(replace(problem, windows=problem.windows[: len(states)]), smoother.dropped)
    estimate = smoother.estimate(len(states))
    causal, windows, updates = causal_solution(problem, states), problem.windows, log.updates()
    extra: dict[str, Any] = {
        "mode": f"replay {options.smoother}" + (", interrupted" if interrupted else ""),
        "update_ms": {name: float(f(log.latency_ms)) for name, f in _LATENCY.items()},
        "delay_s": initial.stretch_s,
    }
    if options.polish:
        try:
            last = problem.windows[-1].t1_ns if interrupted else None
            problem, estimate, memory, extra["polish"] = _polished(problem, estimate, initial, last, progress)
        except KeyboardInterrupt:
            extra["mode"] += ", polish interrupted"
        clock.lap("polish")
    run = _finish(Outcome(problem, estimate, memory), initial, clock, extra, causal, updates)
    return replace(run, causal_windows=windows)


def _counted(problem: Problem, too_late: Mapping[str, int]) -> Problem:
    """The problem with the rows that came too late for the smoother."""
    streams = problem.session.streams()
    counts = {name: count for name, count in too_late.items() if count and name in streams}
    return problem.with_dropped(TOO_LATE, counts)


def _polished(
    problem: Problem, estimate: Estimate, initial: Initial, known_ns: int | None, progress: Progress
) -> tuple[Problem, Estimate, Memory, dict[str, float]]:
    """Everything once more by batch, every row at the time it speaks of, and how far that moved the estimate.

    What is made at the states before (preintegrated windows, delayed fixes) is made anew where they moved far.
    """
    whole = recut(problem, known_ns)
    warm = estimate.values if whole is problem else carried_over(problem, estimate, whole.windows)
    memory, total = initial.memory, 0
    told: dict[str, float] = {}
    while True:
        found, memory, passes = solve_passes(whole, whole.windows, initial.prior, memory, warm=warm, progress=progress)
        metres, degrees = distance(states_of(warm, found.indices), found.states())
        told = told or {"largest_change_m": metres, "largest_change_deg": degrees}
        total += passes
        if (metres < FAR_M and degrees < FAR_DEG) or total >= whole.config.run.passes:
            return whole, found, memory, {**told, "passes": total}
        warm = found.values


_LATENCY: Mapping[str, Callable[[Sequence[float]], Any]] = {
    "median": np.median,
    "p99": lambda values: np.percentile(values, 99),
    "max": np.max,
}

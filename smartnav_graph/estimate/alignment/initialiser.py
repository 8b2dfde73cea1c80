"""First stretch -> first state, without anything given.

The aligners (`ALIGNERS`) give candidates. Those on which most fixes of the stretch agree (`in_motion.starts_agreed`)
are refined by the factor graph of the first windows, and the one of least cost is taken; where the heading stays
unknown, the stretch is doubled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from smartnav_graph.core.errors import SolverError
from smartnav_graph.estimate.alignment.aligners import ALIGNERS
from smartnav_graph.estimate.alignment.first_stretch import Candidate, FirstStretch
from smartnav_graph.estimate.alignment.in_motion import Alignment, Known, starts_agreed
from smartnav_graph.estimate.alignment.initial_state import InitialState
from smartnav_graph.estimate.alignment.static import LEAST_RATE_SIGMA
from smartnav_graph.factors.prior import PriorBuilder
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.graph.states import State
from smartnav_graph.smoothers.estimate import Estimate

# Cost a keyframe above which a fit of the first stretch is bad (a good one has 1.5), and what a rejected fix costs:
# a start must not look good because it rejects what contradicts it.
GOOD_COST = 2.5
REJECTION_COST = 10.0
# A heading (deg) with a smaller sigma than this is known.
GOOD_HEADING_DEG = 10.0
# Squares of fixes count once in so many where starts are compared, as their errors are correlated, and in units of
# their mean, at least of this.
CORRELATED, LEAST_SCATTER = 4.0, 0.03
# Share of the keyframes whose fixes a good start may reject beyond those that disagreed with it before.
MORE_REJECTED = 0.05

# Solves the first windows (so many) from a prior, a pass state and values if there are any.
Solve = Callable[[PriorBuilder, int, PassState, gtsam.Values | None], tuple[Estimate, PassState]]


@dataclass(frozen=True)
class Refined:
    """A candidate refined by the graph; fits : the fixes kept fit it, and few were rejected that agreed before."""

    cost: float
    initial: InitialState
    fits: bool


def find_initial_state(first: FirstStretch, solve: Solve) -> InitialState:
    """The first state.

    Raises
    ------
    SolverError
        No absolute sensor, no given start and no rest: nothing to begin from. Or no candidate converges.
    """
    for aligner in ALIGNERS.values():
        for candidate in aligner.candidates(first) if aligner.alone else ():
            found = candidate.final or _whole_trajectory(first, candidate, solve)
            if found is not None:
                return found
    if not len(first.fixes):
        raise SolverError(
            "initialisation",
            "no absolute sensor (no position fix, no control point) and no rest at the start",
            "position fixes, control points, or a device at rest for a second",
            'add a gnss or control stream, or give --initial "e,n,u,heading_deg"',
        )
    return _search(first, solve)


def _whole_trajectory(first: FirstStretch, candidate: Candidate, solve: Solve) -> InitialState | None:
    """The start of a trajectory known roughly, where the fixes and the inertial data agree with it."""
    assert candidate.values is not None
    stretch = first.until(first.config.max_stretch_s)
    stretch = replace(stretch, count=min(stretch.count, candidate.count))
    found = _refine(stretch, candidate.state, first.pass_state, solve, candidate.values(stretch.count))
    if found is None or not found.fits:
        return None
    sentence = found.initial.sentence.replace("from the fixes", "from the steps, the fixes")
    whole = candidate.values(candidate.count) if candidate.count == len(first.windows) else None
    return replace(found.initial, sentence=sentence, initial_values=whole)


def _search(first: FirstStretch, solve: Solve) -> InitialState:
    """Refine the candidates in the order of agreement until one fits, on a longer stretch while its heading is open."""
    config, tried = first.config, 0
    stretch_s, before = config.stretch_s, list[State]()
    while True:
        stretch = first.until(stretch_s)
        last = stretch_s >= config.max_stretch_s or stretch.count >= len(first.windows)
        results: list[Refined] = []
        agreed = _by_agreement(stretch, before)
        for one in agreed:
            tried += 1
            found = _refine(stretch, _state(stretch, one), _without_outliers(stretch, one), solve)
            if found is not None:
                results.append(found)
                if found.fits and (not last or found.initial.sigma_heading_deg < GOOD_HEADING_DEG):
                    break
        if results:
            best = min(results, key=lambda result: result.cost).initial
            if last or best.sigma_heading_deg < GOOD_HEADING_DEG:
                return replace(_with_ambiguity(stretch, best, agreed), starts=tried)
            before = [best.prior.start]
        elif last:
            raise SolverError(
                "initialisation",
                f"no start converges on the first {stretch.count} keyframes",
                "inertial data and fixes of the same motion",
                'check units, axes and clocks with `smartnav info`, or give --initial "e,n,u,heading_deg"',
            )
        stretch_s *= 2.0


def _with_ambiguity(first: FirstStretch, initial: InitialState, agreed: Sequence[Alignment]) -> InitialState:
    """The start with a sigma of its heading that covers the other states on which the fixes agree nearly as well."""
    cost = np.array([one.cost for one in agreed])
    other = np.array([first.heading_deg(one.R) for one in agreed])
    off = (other - initial.heading_deg + 180.0) % 360.0 - 180.0
    scatter = np.clip(cost.min() / max(3.0 * len(first.known) - 9.0, 1.0), LEAST_SCATTER, 1.0)
    weight = np.exp(-0.5 * (cost - cost.min()) / (CORRELATED * scatter))
    return initial.with_sigma(float(np.hypot(initial.sigma_heading_deg, np.sqrt(weight @ off**2 / weight.sum()))))


def _state(first: FirstStretch, one: Alignment) -> State:
    return State.of(0, first.start_ns, (one.R, one.p, one.v), one.found[:6])


def _by_agreement(first: FirstStretch, before: Sequence[State]) -> list[Alignment]:
    """First states to try, those that most fixes agree on first.

    before : the best of a shorter stretch, tried first
    """
    states = list(before)
    for aligner in ALIGNERS.values():
        states += [] if aligner.alone else [candidate.state for candidate in aligner.candidates(first)]
    noise, rest, used = first.noise, first.rest, first.known
    mean, sigma = np.zeros(6), np.array([noise.accel_bias_sigma] * 3 + [noise.gyro_bias_sigma] * 3)
    if rest is not None:
        mean[3:], sigma[3:] = rest.gyro, max(rest.gyro_sigma, LEAST_RATE_SIGMA)
    known = Known(mean, sigma, noise, first.gravity, first.fix_sigma)
    starts = [(s.nav.attitude().matrix(), s.nav.position(), s.nav.velocity()) for s in states]
    bias = states[0].bias.vector() if before or first.field_start is not None else None
    windows, t_ns, fixes = first.windows[: first.count], first.fixes.t_ns[used], first.fixes.position[used]
    return starts_agreed(windows, t_ns, fixes, starts, known, bias)[: first.config.starts]


def _without_outliers(first: FirstStretch, alignment: Alignment) -> PassState:
    """The fixes that disagree as rejected; none where the start explains less than half of them."""
    used, sources = first.known, first.fixes.sources
    outside = used[alignment.outside]
    if not len(outside) or 2 * len(outside) > len(used) or not sources:
        return first.pass_state
    rejected: dict[str, set[int]] = {}
    for name, row in (source for i in outside if (source := sources[i]) is not None):
        rejected.setdefault(name, set()).add(row)
    return replace(
        first.pass_state, phase=Phase.GATED, rejected={name: frozenset(rows) for name, rows in rejected.items()}
    )


def _refine(
    first: FirstStretch, state: State, pass_state: PassState, solve: Solve, values: gtsam.Values | None = None
) -> Refined | None:
    """The start refined from `state`, None where it does not converge."""
    before = _rejections(pass_state)
    try:
        estimate, updated = solve(first.prior(state), first.count, pass_state, values)
    except SolverError:
        return None
    rejected = _rejections(updated)
    fits = estimate.cost < GOOD_COST * first.count and rejected <= before + max(1.0, MORE_REJECTED * first.count)
    return Refined(estimate.cost + REJECTION_COST * rejected, _initial_state(first, estimate, updated), fits)


def _rejections(pass_state: PassState) -> int:
    return sum(len(rows) for rows in pass_state.rejected.values())


def _initial_state(first: FirstStretch, estimate: Estimate, pass_state: PassState) -> InitialState:
    """The refined start: its values, under the weak prior (the fixes are used again by the smoother)."""
    R, p, v, bias = (rows[0] for rows in estimate.states())
    state, rest = State.of(0, first.start_ns, (R, p, v), bias), first.rest
    heading = first.heading_deg(R)
    sigma = min(float(np.degrees(np.sqrt(estimate.covariance[0, 2, 2]))), 180.0)
    source = "the fixes and the inertial data" if first.magnetic_heading is None else "the magnetometer and the fixes"
    vertical = (
        "no rest at the start" if rest is None else f"vertical and gyro bias from a rest of {rest.length_s:.1f} s"
    )
    sentence = (
        f"Heading {heading:.1f} deg +- {sigma:.1f} deg found from {source} of the first {first.length_s:.0f} s; "
        f"{vertical}."
    )
    if _rejections(pass_state):
        pass_state = replace(pass_state, phase=Phase.ROBUST)  # there will be more of them
    method = "dynamic" if rest is None else "static"
    return InitialState(first.prior(state), method, sentence, heading, sigma, first.length_s, 1, pass_state)

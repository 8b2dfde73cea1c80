"""A standstill is a hypothesis: once all else is settled it is dropped where the solution moves in it all the same.

The normalised square of zero velocity, |v|^2 / sigma^2, has a redundancy of three at most at each of its keyframes. A
standstill of which most keyframes lie far beyond that is none: its redescending loss leaves some weight, and its
constraint of no turn is wrong too. A foot has a new hypothesis at every step, and a loss for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.standstill import StandstillBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.update import Builder, one_of
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.detect.standstills import Standstills
from smartnav_graph.smoothers.estimate import Estimate

# The square that a good keyframe exceeds once in a million times, sigma a few times too small; the share of them.
LIMIT = 9.0 * float(chi_square.isf(1e-6, 3))
MOST = 0.5


def drop_standstills(
    builders: Sequence[Builder], windows: Sequence[Window], estimate: Estimate, pass_state: PassState
) -> PassState:
    """The pass state without the standstills in which the solution moves; itself where there is none."""
    builder = one_of(builders, StandstillBuilder)
    if builder is None or builder.rests.on_foot or not builder.config.zupt:
        return pass_state
    t_ns = np.array([window.t1_ns for window in windows], dtype=np.int64)
    sigma = np.array([builder.rests.speed_at(stamp) for stamp in t_ns.tolist()])
    square = (estimate.states()[2] ** 2).sum(axis=1) / sigma**2
    spans = builder.rests.spans()
    false = {begin for begin, end in spans if _moves(square[_inside(t_ns, begin, end)])}
    return replace(pass_state, refuted=pass_state.refuted | false) if false - pass_state.refuted else pass_state


def _inside(t_ns: Times, begin: int, end: int) -> slice:
    return slice(*np.searchsorted(t_ns, [begin, end + 1]))


def _moves(square: Floats) -> bool:
    return bool(len(square)) and float((square > LIMIT).mean()) > MOST


def refuted_text(rests: Standstills | None, pass_state: PassState, t0_ns: int) -> list[str]:
    """Warnings of the standstills that were dropped."""
    spans = [] if rests is None else [span for span in rests.spans() if span[0] in pass_state.refuted]
    return [
        f"standstill: the solution moves from {(begin - t0_ns) / NS:.1f} to {(end - t0_ns) / NS:.1f} s, although "
        "static.parquet, images or the inertial data show a standstill there: not used as one; check that period and "
        "the clocks of the sensors"
        for begin, end in spans
    ]

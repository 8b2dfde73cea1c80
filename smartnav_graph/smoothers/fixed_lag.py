"""The last seconds of the graph, solved again at every update; what is older is marginalised into a linear factor.

A window of seconds holds some ten to fifty keyframes: linearised as a whole, blocks by the stack, and eliminated in
time order, it costs a few milliseconds whatever has moved, session states included. By QR while position or attitude
is barely known: Cholesky gives up on them, or is wrong without a word. Once they are known it is five times as fast.

Source: Sibley, Matthies, Sukhatme (2010), Sliding window filter with application to planetary landing, J. Field
Robotics 27(5); Dong-Si, Mourikis (2011), Motion tracking with fixed-lag smoothing, ICRA.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.graph.states import KEYFRAME_LETTERS, SessionState, State, damping_scales, key, kind_of
from smartnav_graph.graph.update import FactorBatch, GraphUpdate
from smartnav_graph.smoothers.estimate import copy_state, latest_covariance, state_at
from smartnav_graph.smoothers.incremental import Effort, Incremental, ReplayConfig, scalars
from smartnav_graph.smoothers.whole_graph import WholeGraph, session_prior

Item = TypeVar("Item")

# Sigmas of position (m) and attitude (rad) beyond which QR is needed.
WEAK_M, WEAK_RAD = 100.0, 0.5
# Gauss-Newton iterations at most an update: the next one goes on from there.
MOST_ITERATIONS = 2
# Share of a state's damping scale that an iteration may move it by without a further one.
SETTLED = 0.05
# In place of the oldest keyframe where a factor touches session states alone: it never leaves.
NEVER = 1 << 62


class FixedLag(Incremental):
    """Sliding window behind the one interface.

    Live factors and blocks belong to the oldest keyframe they touch, which takes them along when it leaves.
    """

    def __init__(self, config: ReplayConfig, t0_ns: int) -> None:
        super().__init__(config, t0_ns)
        self._inside: deque[GraphUpdate] = deque()
        self._session: dict[int, SessionState] = {}
        self._held: dict[int, Floats] = {}
        self._factors: list[tuple[int, gtsam.NonlinearFactor]] = []
        self._blocks: list[tuple[int, FactorBatch]] = []
        self._live, self._left = gtsam.Values(), gtsam.Values()
        self._net = gtsam.GaussianBayesNet()
        self._weak = True

    def _take(self, update: GraphUpdate) -> None:
        self._marginalise_oldest(update)
        self._drop_late(update)
        self._insert(update)
        graph = WholeGraph((f for _, f in self._factors), (b for _, b in self._blocks), self._held)
        order = self._order()
        names = list(self._live.keys())
        damping_scale = damping_scales(np.array(names, dtype=np.uint64))
        for count in range(1, MOST_ITERATIONS + 1):
            self._net = _eliminated(graph.linearize(self._live), order, self._weak)
            delta = self._net.optimize()
            _check(delta, names)
            self._live = self._live.retract(delta)
            self.effort = Effort(len(names), count * len(names))
            if (np.abs(delta.vector()) < SETTLED * self.config.relinearize * damping_scale).all():
                break

    def _insert(self, update: GraphUpdate) -> None:
        """Make the update's states and factors live; a session state comes with its prior, once."""
        self._inside.append(update)
        self._live.insert(update.values())
        self._held |= update.held
        for name, state in update.session.items():
            if name not in self._session:
                self._live.insert(name, state.initial)
                self._factors.append((NEVER, session_prior(state)))
        self._session |= update.session
        self._factors += [(_oldest(factor.keys()), factor) for _, factor in update.factors]
        for block in update.blocks:
            self._blocks += _parted(block)

    def _drop_late(self, update: GraphUpdate) -> None:
        """Leave out, and count, rows of keyframes which have left the lag."""
        oldest = self._inside[0].index if self._inside else update.index
        kept = []
        for block in update.blocks:
            gone = [_oldest(keys) < oldest for keys in block.keys]
            if any(gone):
                self.dropped[block.sensor] += sum(gone)
                block = _only(block, [not late for late in gone])
            kept.append(block)
        update.blocks = kept

    def _marginalise_oldest(self, update: GraphUpdate) -> None:
        """Marginalise the keyframes that are older than the lag, and keep their last estimate."""
        leaving = []
        while self._inside and self._inside[0].t_s < update.t_s - self.config.lag_s:
            leaving.append(self._inside.popleft())
        if not leaving:
            return
        last = leaving[-1].index
        factors, self._factors = _split(self._factors, last)
        blocks, self._blocks = _split(self._blocks, last)
        order = gtsam.Ordering([name for gone in leaving for name in gone.names()])
        linear = WholeGraph(factors, blocks, self._held).linearize(self._live)
        _, rest = linear.eliminatePartialSequential(order, gtsam.EliminateQR)
        for i in range(rest.size()):
            factor = rest.at(i)
            if factor is not None and not factor.empty():
                self._factors.append((_oldest(factor.keys()), gtsam.LinearContainerFactor(factor, self._live)))
        for gone in leaving:
            copy_state(gone, self._live, self._left)
            for name in gone.names():
                self._live.erase(name)

    def _order(self) -> gtsam.Ordering:
        """Chronological, the latest keyframe last of all: its marginal is then the end of the elimination."""
        own = _own(self._inside[-1])
        names = [name for update in self._inside for name in update.names() if name not in own]
        return gtsam.Ordering([*names, *self._session, *own])

    def _state(self, update: GraphUpdate) -> State:
        return state_at(self._live, update.index, update.t_ns)

    def _marginal(self, update: GraphUpdate) -> Floats:
        joint = latest_covariance(self._net, _own(update))
        sigma = np.sqrt(np.diag(joint))
        self._weak = not (sigma[:3].max() < WEAK_RAD and sigma[3:6].max() < WEAK_M)
        return joint

    def session_now(self) -> dict[str, tuple[float, float]]:
        """Present value and sigma of each scalar of the free session states, by name."""
        found: dict[str, tuple[float, float]] = {}
        if self._session:
            names = [*self._session, *_own(self._inside[-1])]
            sigma, start = np.sqrt(np.diag(latest_covariance(self._net, names))), 0
            for name, state in self._session.items():
                value = self._live.atVector(name)
                found |= scalars(state, value, sigma[start : start + len(value)])
                start += len(value)
        return found

    def values(self) -> gtsam.Values:
        """Best estimate of every state so far (gtsam.Values): as it left the lag, or as it is now."""
        values = gtsam.Values(self._left)
        values.insert(self._live)
        return values


def _own(update: GraphUpdate) -> list[int]:
    return [key(letter, update.index) for letter in KEYFRAME_LETTERS]


def _eliminated(linear: gtsam.GaussianFactorGraph, order: gtsam.Ordering, weak: bool) -> gtsam.GaussianBayesNet:
    """Bayes net of a linear system; RuntimeError also where a state has no factor at all."""
    try:
        if not weak:
            try:
                return linear.eliminateSequential(order)
            except RuntimeError:
                pass  # QR decides
        return linear.eliminateSequential(order, gtsam.EliminateQR)
    except ValueError as error:
        missing = sorted({order.at(i) for i in range(order.size())} - set(linear.keys()))
        if not missing:
            raise
        raise RuntimeError(f"(Symbol: {gtsam.Symbol(missing[-1]).string()})") from error


def _oldest(keys: Iterable[int]) -> int:
    return min((gtsam.symbolIndex(name) for name in keys if kind_of(name).scope != "session"), default=NEVER)


def _split(items: Sequence[tuple[int, Item]], last: int) -> tuple[list[Item], list[tuple[int, Item]]]:
    """What keyframes up to `last` take along, and the rest."""
    return [item for oldest, item in items if oldest <= last], [pair for pair in items if pair[0] > last]


def _only(block: FactorBatch, mask: Sequence[bool]) -> FactorBatch:
    rows = [i for i, kept in enumerate(mask) if kept]
    return replace(
        block,
        keys=[block.keys[i] for i in rows],
        data=block.data[rows],
        rows=tuple(block.rows[i] for i in rows),
        used=tuple(block.used[i] for i in rows),
    )


def _parted(block: FactorBatch) -> list[tuple[int, FactorBatch]]:
    """A block in parts of rows that share their oldest keyframe; rows not used stay out."""
    oldest = [_oldest(keys) if used else None for keys, used in zip(block.keys, block.used, strict=True)]
    return [(index, _only(block, [o == index for o in oldest])) for index in dict.fromkeys(oldest) if index is not None]


def _check(delta: gtsam.VectorValues, names: Sequence[int]) -> None:
    """Refuse a step that is no number: a state is not determined."""
    if not np.isfinite(delta.vector()).all():
        bad = next(name for name in names if not np.isfinite(delta.at(name)).all())
        raise RuntimeError(f"(Symbol: {gtsam.Symbol(bad).string()})")

"""How a run came about, kept beside its solution: the graph's wiring, the image pairs, the updates of a replay."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.display import Summarised
from smartnav_graph.estimate.problem import Problem
from smartnav_graph.factors.coplanarity import CoplanarityBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, indices_of, letters_of
from smartnav_graph.graph.update import GraphUpdate, one_of
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.incremental import Incremental
from smartnav_graph.vision.pairs import Pairs

Ints = NDArray[np.int64]
Texts = NDArray[np.str_]


@dataclass(frozen=True)
class FactorGraphLayout:
    """Which factor touches which state.

    sensor (f,) : builder of each factor, in the order of keyframes
    factor (m,) : number of the factor of each touch; letter (m,), index (m,) of the state touched (`graph.STATES`)
    """

    sensor: Texts
    factor: Ints
    letter: Texts
    index: Ints

    @classmethod
    def of(cls, estimate: Estimate) -> FactorGraphLayout:
        """The wiring of a solved graph; rows that are not in use stay out."""
        found = [(tag.sensor, factor.keys()) for tag, factor in estimate.factors]
        for block in estimate.blocks:
            found += [(block.sensor, keys) for keys, used in zip(block.keys, block.used, strict=True) if used]
        keys = np.array([name for _, names in found for name in names], dtype=np.uint64)
        return cls(
            sensor=np.array([sensor for sensor, _ in found], dtype=np.str_),
            factor=np.repeat(np.arange(len(found)), [len(names) for _, names in found]),
            letter=letters_of(keys).view("S1").astype(np.str_),
            index=indices_of(keys),
        )


@dataclass(frozen=True)
class ImagePairs:
    """Image pairs of one camera and what became of them: `use` (m,) of the matches, `verdict` (n,) of the pairs, places
    in `factors.coplanarity.REASONS`."""

    pairs: Pairs
    use: NDArray[np.bool_]
    verdict: NDArray[np.intp]

    @classmethod
    def of(cls, problem: Problem, pass_state: PassState) -> ImagePairs | None:
        """Those of a run; None without images."""
        builder = one_of(problem.builders, CoplanarityBuilder)
        if builder is None:
            return None
        use, verdict = builder.used_matches(pass_state), builder.selection(pass_state).verdict
        return cls(builder.seen, use, verdict)


@dataclass(frozen=True)
class Updates:
    """One row an update of a replay.

    t_ns (k,) : keyframe that came in; solved, relinearised (k,) : states solved for and linearised anew;
    doubted (k,) : rows left out, or under a loss that lets go of them
    corrected (k,) m : how far the update moved the keyframes before; latency_ms (k,) : wall time
    edge (k + 1,) : rows of each update in past_ns (p,), past (p, 3) m, the keyframes of the window as it has them
    states : value and sigma (k, 2) of each scalar of a session state, by name, NaN before it is there
    """

    t_ns: Ints
    solved: Ints
    relinearised: Ints
    doubted: Ints
    corrected: Floats
    latency_ms: Floats
    edge: Ints
    past_ns: Ints
    past: Floats
    states: Mapping[str, Floats] = field(default_factory=dict)


class _Row(NamedTuple):
    """What `UpdateLog` keeps of an update; counts : stamp, states solved and linearised anew, rows doubted."""

    counts: tuple[int, int, int, int]
    corrected: float
    latency_ms: float
    window: tuple[Ints, Floats]
    states: Mapping[str, tuple[float, float]]


@dataclass
class UpdateLog:
    """Collects `Updates` and the latest state after each while a replay runs."""

    smoother: Incremental
    states: list[State] = field(default_factory=list)
    _rows: list[_Row] = field(default_factory=list)

    def take(self, update: GraphUpdate, begin_s: float) -> None:
        """Record what `update` led to; it was begun at `begin_s` (time.perf_counter)."""
        smoother, state = self.smoother, self.smoother.latest()
        assert state is not None
        self.states.append(state)
        latency_s, window = time.perf_counter() - begin_s, smoother.recent()
        corrected = _largest_move(self._rows[-1].window, window) if self._rows else 0.0
        counts = (update.t_ns, smoother.effort.solved, smoother.effort.relinearised, doubted_rows(update))
        self._rows.append(_Row(counts, corrected, 1e3 * latency_s, window, smoother.session_now()))

    @property
    def latency_ms(self) -> list[float]:
        """Time of each update, ms."""
        return [row.latency_ms for row in self._rows]

    def updates(self) -> Updates:
        """All updates taken in whole."""
        counts, corrected, latency, windows, states = zip(*self._rows, strict=True)
        t_ns, solved, relinearised, doubted = np.array(counts, dtype=np.int64).T
        names = dict.fromkeys(name for row in states for name in row)
        unknown = (np.nan, np.nan)
        return Updates(
            t_ns=t_ns,
            solved=solved,
            relinearised=relinearised,
            doubted=doubted,
            corrected=np.array(corrected),
            latency_ms=np.array(latency),
            edge=np.cumsum([0, *(len(t) for t, _ in windows)]),
            past_ns=np.concatenate([t for t, _ in windows]),
            past=np.concatenate([p for _, p in windows]),
            states={name: np.array([row.get(name, unknown) for row in states]) for name in names},
        )


def _largest_move(before: tuple[Ints, Floats], now: tuple[Ints, Floats]) -> float:
    """Largest distance (m) between two windows' positions of the keyframes that both have."""
    _, old, new = np.intersect1d(before[0], now[0], assume_unique=True, return_indices=True)
    if not len(old):
        return 0.0
    return float(np.linalg.norm(now[1][new] - before[1][old], axis=1).max())


def doubted_rows(update: GraphUpdate) -> int:
    """Rows of an update that are left out, or have Cauchy's loss because they contradict the prediction."""
    native = sum(_lets_go(factor) for _, factor in update.factors)
    return native + sum(
        len(block.used) if block.loss == "cauchy" else len(block.used) - sum(block.used) for block in update.blocks
    )


def _lets_go(factor: object) -> bool:
    model = factor.noiseModel() if isinstance(factor, gtsam.NoiseModelFactor) else None
    return isinstance(model, gtsam.noiseModel.Robust) and isinstance(model.robust(), gtsam.noiseModel.mEstimator.Cauchy)


@dataclass(frozen=True)
class Diagnostics(Summarised):
    """All of it. keyframe_ns (n,) : stamps of the keyframes; the index of a keyframe is its place."""

    keyframe_ns: Ints
    layout: FactorGraphLayout
    pairs: ImagePairs | None = None
    updates: Updates | None = None

    def facts(self) -> dict[str, str]:
        """What there is of a run."""
        there = {name: getattr(self, name) is not None for name in ("pairs", "updates")}
        return {"keyframes": str(len(self.keyframe_ns)), **{k: "kept" if v else "none" for k, v in there.items()}}

    @classmethod
    def of(
        cls, problem: Problem, estimate: Estimate, pass_state: PassState, updates: Updates | None = None
    ) -> Diagnostics:
        """The trace of a finished run."""
        return cls(estimate.t_ns, FactorGraphLayout.of(estimate), ImagePairs.of(problem, pass_state), updates)


def window_of(t_ns: Ints, keyframe_ns: Sequence[int] | Ints) -> Ints:
    """The keyframe (n,) at the end of the window that each stamp (n,) lies in, the last one beyond it."""
    place = np.searchsorted(np.asarray(keyframe_ns), t_ns, side="left")
    return np.minimum(place, len(keyframe_ns) - 1).astype(np.int64)

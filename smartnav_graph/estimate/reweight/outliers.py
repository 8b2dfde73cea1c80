"""Residuals of the fixes at a solution, and which of them are outliers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import rotate, skew
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.gauss_markov import correlated_sigma
from smartnav_graph.factors.gnss import PositionBuilder
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import Builder
from smartnav_graph.graph.windows import Window
from smartnav_graph.smoothers.estimate import Estimate


@dataclass(frozen=True)
class FixResiduals:
    """Residuals of one stream of positions at its keyframes.

    rows (m,); keyframe (m,) position in the estimate; residual (m, 3) nav m; sigma (m, 3) m as used;
    posterior (m, 3) variance of the predicted position, m^2; fitted (m, 3) share of each component's variance that the
    solution fits, of all its states, NaN where the row is not used; other (m, 3) m that may lie between a good fix and
    its neighbours besides: a clock not yet looked at, the change of a correlated error since the nearest rows in use
    """

    rows: NDArray[np.intp]
    keyframe: NDArray[np.intp]
    residual: Floats
    sigma: Floats
    posterior: Floats
    other: Floats
    fitted: Floats | None = None

    @property
    def square(self) -> Floats:
        """Squared whitened residuals (m,), summed over the components."""
        return np.asarray(((self.residual / self.sigma) ** 2).sum(axis=1))

    @property
    def redundancy(self) -> Floats:
        """Share (m, 3) of each component's variance that the solution left."""
        fitted = self.posterior / self.sigma**2
        if self.fitted is not None:
            fitted = np.where(np.isfinite(self.fitted), self.fitted, fitted)
        return np.asarray(np.clip(1.0 - fitted, 0.0, 1.0))


def fix_residuals(
    builder: PositionBuilder, windows: Sequence[Window], estimate: Estimate, pass_state: PassState
) -> FixResiduals:
    """Residuals of every row that has a keyframe, rejected or not."""
    pairs = [(k, int(row)) for k, w in enumerate(windows) for row in w.rows.get(builder.name, ())]
    keyframe = np.array([k for k, _ in pairs], dtype=np.intp)
    rows = np.array([row for _, row in pairs], dtype=np.intp)
    sigma = builder.scaled_sigma(pass_state)[rows]
    R, p, v, bias = (x[keyframe] for x in estimate.states())
    delay = estimate.offset_s(builder.name)
    measured = [builder.force(windows[k], *at) for k, *at in zip(keyframe, R, bias, strict=True)]
    a = rotate(R, np.array(measured).reshape(-1, 3) - bias[:, :3])
    a[:, 2] -= builder.gravity
    lever = builder.lever[rows] + estimate.session_value(f"{builder.name}_lever_arm_correction_m", 3)
    residual = p + v * delay + 0.5 * a * delay**2 + rotate(R, lever) - builder.position[rows]
    states = [builder.height_state(int(row)).get("O") for row in rows]
    residual[:, 2] += [0.0 if state is None else estimate.session_value(state.name, 1)[0] for state in states]
    if builder.name in pass_state.correlated:
        residual += np.array([estimate.values.atVector(key("C", estimate.indices[k])) for k in keyframe]).reshape(-1, 3)
    P = estimate.covariance[keyframe][:, :6, :6]
    there = np.concatenate([-skew(rotate(R, lever)), np.broadcast_to(np.eye(3), R.shape)], axis=2)  # of the antenna
    posterior = np.diagonal(there @ P @ there.transpose(0, 2, 1), axis1=1, axis2=2)
    by_error = _by_correlated_error(builder, rows, estimate.t_ns[keyframe] / NS, pass_state)
    other = _by_clock(builder, v, pass_state) + by_error
    return FixResiduals(rows, keyframe, residual, sigma, posterior, other)


def _by_clock(builder: PositionBuilder, v: Floats, pass_state: PassState) -> Floats:
    """What a clock offset tau puts (m, 1) between a fix and its neighbours, tau |v_k+1 - v_k-1| : a shift of all along
    the way is no contradiction. Nothing once tau is a state."""
    if pass_state.stage >= LAST_STAGE or not len(v):
        return np.zeros((len(v), 1))
    around = np.concatenate([v[:1], v, v[-1:]])
    change = np.linalg.norm(around[2:] - around[:-2], axis=1, keepdims=True)
    return np.asarray(builder.config.time_offset_sigma * change)


def _by_correlated_error(
    builder: PositionBuilder, rows: NDArray[np.intp], t_s: Floats, pass_state: PassState
) -> Floats:
    """Sigma (m, 3) m of what a correlated error that is a state may change between rows not in use and the nearest in
    use before and after; nothing for rows in use, whose error the state has."""
    out = np.zeros((len(rows), 3))
    if builder.name in pass_state.correlated:
        used = pass_state.used(builder.name, rows)
        before = t_s - np.maximum.accumulate(np.where(used, t_s, -np.inf))
        after = np.minimum.accumulate(np.where(used, t_s, np.inf)[::-1])[::-1] - t_s
        with np.errstate(divide="ignore"):
            apart = 1.0 / (1.0 / before[~used] + 1.0 / after[~used])
        share = -np.expm1(-2.0 * apart / builder.noise.correlated_time)
        out[~used] = np.sqrt(share)[:, None] * correlated_sigma(builder.noise)
    return out


def position_builders(builders: Iterable[Builder]) -> list[PositionBuilder]:
    """The builders of position fixes."""
    return [builder for builder in builders if isinstance(builder, PositionBuilder)]


@dataclass(frozen=True)
class Verdict:
    """Residuals of one sensor at the estimate: rows (m,), normalised squares (m,), and the largest square of good
    ones by the level of all and a probability; gnc: whether graduated non-convexity truncates its loss."""

    name: str
    rows: NDArray[np.intp]
    square: Floats
    dim: int
    limit: Callable[[float, float | None], Floats]
    gnc: bool = False

    def outside(self, probability: float | None = None) -> frozenset[int]:
        """Rows beyond the gate, at the robust level of all rows."""
        return frozenset(int(row) for row in self.rows[self.relative(probability) > 1.0])

    def relative(self, probability: float | None = None) -> Floats:
        """Squares (m,) in units of the gate's."""
        level = float(np.median(self.square)) / float(chi_square.ppf(0.5, self.dim))
        return np.asarray(self.square / self.limit(level, probability))


def verdicts(
    builders: Iterable[Builder], found: Mapping[str, FixResiduals], estimate: Estimate, pass_state: PassState
) -> list[Verdict]:
    """Every sensor whose outliers are looked for: positions, and whatever declares a `gate_probability`."""
    result = []
    for builder in builders:
        if isinstance(builder, PositionBuilder):
            if builder.gated and builder.name in found:
                result.append(_position_verdict(builder, found[builder.name], pass_state))
        elif builder.gate_probability is not None:
            result += _block_verdict(builder, estimate)
    return result


def _position_verdict(builder: PositionBuilder, found: FixResiduals, pass_state: PassState) -> Verdict:
    sigma = np.maximum(builder.scaled_sigma(pass_state)[found.rows], builder.least_gate_sigma)
    square = (found.residual**2 / (sigma**2 + found.other**2)).sum(axis=1)

    def limit(level: float, probability: float | None) -> Floats:
        return builder.limit(level, found.rows, probability)

    return Verdict(builder.name, found.rows, square, 3, limit, builder.config.loss == "gnc")


def _block_verdict(builder: Builder, estimate: Estimate) -> list[Verdict]:
    stacks = estimate.stacks(builder.name)
    if not stacks:
        return []
    white = [stack.linearize(estimate.snapshot)[0] for stack in stacks]
    square = np.concatenate([(rows**2).sum(axis=1) for rows in white])
    dim = white[0].shape[1]

    def limit(level: float, probability: float | None) -> Floats:
        share = probability or builder.gate_probability or 1.0
        return np.full(len(square), chi_square.ppf(share, dim) * max(1.0, level))

    rows = np.concatenate([stack.rows for stack in stacks])
    return [Verdict(builder.name, rows, square, dim, limit)]

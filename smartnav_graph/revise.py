"""What one pass teaches the next: which fixes to reject, and how noisy fixes without a sigma are.

Rejection: least squares first; where residuals stand out, a Cauchy pass finds the outliers, a chi-square gate decides,
and rows inside the gate are let in again. Noise: the variance component of a group of fixes, sum r^2 / redundancy,
with the redundancy read from the posterior covariance (Koch 1999, Parameter estimation, 3.6).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from smartnav_graph.factors.gnss import PositionBuilder
from smartnav_graph.graph import Builder, Memory, Window, key
from smartnav_graph.smoothers.estimate import Estimate

Floats = NDArray[np.float64]

# No fix is believed better than this, metres: clocks and lever arms are not.
LEAST_SIGMA = 0.03
LEAST_REDUNDANCY = 10.0
# Outliers are looked for when the worst fix of all would be so rare among good ones.
SURPRISE = 0.01
MEDIAN_CHI2_3 = float(chi2(3).median())


@dataclass(frozen=True)
class FixResiduals:
    """Residuals of one stream of positions at its keyframes.

    rows (m,); keyframe (m,) position in the estimate; residual (m, 3) nav m; sigma (m, 3) m as used;
    posterior (m, 3) variance of the predicted position, m^2
    """

    rows: NDArray[np.intp]
    keyframe: NDArray[np.intp]
    residual: Floats
    sigma: Floats
    posterior: Floats

    @property
    def square(self) -> Floats:
        return np.asarray(((self.residual / self.sigma) ** 2).sum(axis=1))


def fix_residuals(
    builder: PositionBuilder, windows: Sequence[Window], estimate: Estimate, memory: Memory
) -> FixResiduals:
    """Residuals of every row that has a keyframe, rejected or not."""
    pairs = [(k, int(row)) for k, w in enumerate(windows) for row in w.rows.get(builder.name, ())]
    keyframe = np.array([k for k, _ in pairs], dtype=np.intp)
    rows = np.array([row for _, row in pairs], dtype=np.intp)
    R, p, _, _ = estimate.states()
    residual = p[keyframe] + R[keyframe] @ builder.lever - builder.position[rows]
    if builder.name in memory.correlated:
        residual += np.array([estimate.values.atVector(key("C", estimate.indices[k])) for k in keyframe]).reshape(-1, 3)
    posterior = np.diagonal(estimate.covariance[keyframe][:, 3:6, 3:6], axis1=1, axis2=2)
    return FixResiduals(rows, keyframe, residual, builder.scaled_sigma(memory)[rows], posterior)


def position_builders(builders: Iterable[Builder]) -> list[PositionBuilder]:
    return [builder for builder in builders if isinstance(builder, PositionBuilder)]


def revise(
    builders: Iterable[Builder], windows: Sequence[Window], estimate: Estimate, memory: Memory
) -> tuple[Memory, bool]:
    """The memory for the next pass, and whether there is nothing more to learn."""
    found = {b.name: (b, fix_residuals(b, windows, estimate, memory)) for b in position_builders(builders)}
    found = {name: pair for name, pair in found.items() if len(pair[1].rows)}
    new = memory
    for builder, residuals in found.values():
        new = _rescaled(builder, residuals, new)
    gated = [(b, r) for b, r in found.values() if b.config.loss == "gate"]
    if memory.phase == "plain" and any(_outside(b, r, new, 1.0 - SURPRISE / len(r.rows)) for b, r in gated):
        return replace(new, phase="robust"), False
    outliers = {b.name: _outside(b, r, new) for b, r in gated}
    if memory.phase == "robust":
        return replace(new, phase="gated", rejected=outliers), False
    if memory.phase == "gated":
        new = replace(new, rejected=outliers)
    steady = all(abs(np.log(new.scale(name) / memory.scale(name))) < 0.1 for name in found)
    done = steady and new.rejected == memory.rejected
    wandering = frozenset(b.name for b, _ in found.values() if b.wanders(new))
    if done and wandering != memory.correlated:
        return replace(new, correlated=wandering), False
    return new, done


def _rescaled(builder: PositionBuilder, found: FixResiduals, memory: Memory) -> Memory:
    """Variance component of the rows without a sigma of their own; rows outside the gate do not count."""
    if builder.name in memory.correlated:
        return memory
    outside = _outside(builder, found, memory) | memory.rejected.get(builder.name, frozenset())
    used = ~builder.own_sigma[found.rows] & ~np.isin(found.rows, list(outside))
    gain = np.clip(found.posterior[used] / found.sigma[used] ** 2, 0.0, 1.0)
    redundancy = float((1.0 - gain).sum())
    if not builder.config.estimate_sigma or redundancy < LEAST_REDUNDANCY:
        return memory
    step = float(np.clip(np.sqrt(found.square[used].sum() / redundancy), 0.2, 5.0))
    least = LEAST_SIGMA / float(builder.sigma[found.rows[used]].min())
    scale = max(memory.scale(builder.name) * step, least)
    return replace(memory, noise_scales={**memory.noise_scales, builder.name: scale})


def _outside(
    builder: PositionBuilder, found: FixResiduals, memory: Memory, probability: float | None = None
) -> frozenset[int]:
    """Rows beyond the gate, at the robust level of all rows."""
    square = ((found.residual / builder.scaled_sigma(memory)[found.rows]) ** 2).sum(axis=1)
    outside = builder.gate(square, float(np.median(square)) / MEDIAN_CHI2_3, found.rows, probability)
    return frozenset(int(row) for row in found.rows[outside])

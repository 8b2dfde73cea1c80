"""What one pass teaches the next: which fixes to reject, and how noisy the sensors are.

Rejection: least squares first; where residuals stand out, a Cauchy pass finds the outliers, a chi-square gate decides,
and rows inside the gate are let in again. A redescending loss does not see what lies far beyond its sigma, and the way
to a fix of centimetres is foretold to metres: so the loss is as wide as that first, and narrowed pass by pass. Where
asked for, truncated least squares by graduated non-convexity stands
between the two, warm-started by the first. Noise: the variance component of a group of fixes, sum r^2 / redundancy,
with the redundancy read from the posterior covariance (Koch 1999, Parameter estimation, 3.6). What needs the
trajectory found first (time offsets, vehicle constraints, wandering errors) joins when nothing is left to learn
without it; session states that the data do not determine are held at their calibrated value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from smartnav_graph import graduated
from smartnav_graph.factors.gnss import PositionBuilder
from smartnav_graph.factors.observation import skew, turned
from smartnav_graph.factors.smart import SmartBuilder
from smartnav_graph.factors.vehicle import VehicleBuilder
from smartnav_graph.graph import LAST_STAGE, Builder, Memory, Window, key, one_of
from smartnav_graph.pair_gate import settled
from smartnav_graph.row_noise import row_scales
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.track_gate import ROUNDS, chosen
from smartnav_graph.variance import noise_scales

Floats = NDArray[np.float64]

# No fix is believed better than this, metres: clocks and lever arms are not.
LEAST_SIGMA = 0.03
LEAST_REDUNDANCY = 10.0
# Outliers are looked for when the worst fix of all would be so rare among good ones.
SURPRISE = 0.01
# Noise is found once the logarithm of its sigma changes by less than this: fixes, and inertial groups, whose walks
# rest on few degrees of freedom and creep.
STEADY = 0.1
STEADY_INERTIAL = 0.1


# Growth of the control a pass from a warm start, and the most passes that takes.
GROWTH = 4.0
GRADUATED_PASSES = 14

# Sigma (m) of fixes under a redescending loss: as far as a stretch between fixes is foretold, and as far as outliers
# bend least squares; and the share of it that the next pass has.
WIDE_M, BENT_M = 3.0, 30.0
NARROWER = 0.1

# A session state is held where the data leave more than this of its prior sigma.
OBSERVED = 0.7


@dataclass(frozen=True)
class FixResiduals:
    """Residuals of one stream of positions at its keyframes.

    rows (m,); keyframe (m,) position in the estimate; residual (m, 3) nav m; sigma (m, 3) m as used;
    posterior (m, 3) variance of the predicted position, m^2; clock (m, 1) m that a clock not yet looked at may put
    between a good fix and its neighbours
    """

    rows: NDArray[np.intp]
    keyframe: NDArray[np.intp]
    residual: Floats
    sigma: Floats
    posterior: Floats
    clock: Floats

    @property
    def square(self) -> Floats:
        return np.asarray(((self.residual / self.sigma) ** 2).sum(axis=1))

    @property
    def redundancy(self) -> Floats:
        """Share (m, 3) of each component's variance that the solution left."""
        return np.asarray(np.clip(1.0 - self.posterior / self.sigma**2, 0.0, 1.0))


def fix_residuals(
    builder: PositionBuilder, windows: Sequence[Window], estimate: Estimate, memory: Memory
) -> FixResiduals:
    """Residuals of every row that has a keyframe, rejected or not."""
    pairs = [(k, int(row)) for k, w in enumerate(windows) for row in w.rows.get(builder.name, ())]
    keyframe = np.array([k for k, _ in pairs], dtype=np.intp)
    rows = np.array([row for _, row in pairs], dtype=np.intp)
    sigma = builder.scaled_sigma(memory)[rows]
    R, p, v, bias = (x[keyframe] for x in estimate.states())
    delay = estimate.offset_s(builder.name)
    measured = [builder.force(windows[k], *at) for k, *at in zip(keyframe, R, bias, strict=True)]
    a = turned(R, np.array(measured).reshape(-1, 3) - bias[:, :3])
    a[:, 2] -= builder.gravity
    lever = builder.lever[rows] + estimate.session_value(f"{builder.name}_lever_arm_correction_m", 3)
    residual = p + v * delay + 0.5 * a * delay**2 + turned(R, lever) - builder.position[rows]
    if builder.name in memory.correlated:
        residual += np.array([estimate.values.atVector(key("C", estimate.indices[k])) for k in keyframe]).reshape(-1, 3)
    P = estimate.covariance[keyframe][:, :6, :6]
    there = np.concatenate([-skew(turned(R, lever)), np.broadcast_to(np.eye(3), R.shape)], axis=2)  # of the antenna
    posterior = np.diagonal(there @ P @ there.transpose(0, 2, 1), axis1=1, axis2=2)
    return FixResiduals(rows, keyframe, residual, sigma, posterior, _by_clock(builder, v, memory))


def _by_clock(builder: PositionBuilder, v: Floats, memory: Memory) -> Floats:
    """What a clock offset tau puts (m, 1) between a fix and its neighbours, tau |v_k+1 - v_k-1| : a shift of all along
    the way is no contradiction. Nothing once tau is a state."""
    if memory.stage >= LAST_STAGE or not len(v):
        return np.zeros((len(v), 1))
    around = np.concatenate([v[:1], v, v[-1:]])
    change = np.linalg.norm(around[2:] - around[:-2], axis=1, keepdims=True)
    return np.asarray(builder.config.time_offset_sigma * change)


def position_builders(builders: Iterable[Builder]) -> list[PositionBuilder]:
    return [builder for builder in builders if isinstance(builder, PositionBuilder)]


@dataclass(frozen=True)
class Verdict:
    """How one sensor's rows stand at the estimate: rows (m,), normalised squares (m,), and the largest square of good
    ones by the level of all and a probability; graduated: whether its loss is to be truncated by and by."""

    name: str
    rows: NDArray[np.intp]
    square: Floats
    dim: int
    limit: Callable[[float, float | None], Floats]
    graduated: bool = False

    def outside(self, probability: float | None = None) -> frozenset[int]:
        """Rows beyond the gate, at the robust level of all rows."""
        return frozenset(int(row) for row in self.rows[self.relative(probability) > 1.0])

    def relative(self, probability: float | None = None) -> Floats:
        """Squares (m,) in units of the gate's."""
        level = float(np.median(self.square)) / float(chi2(self.dim).median())
        return np.asarray(self.square / self.limit(level, probability))


def verdicts(
    builders: Iterable[Builder], found: Mapping[str, FixResiduals], estimate: Estimate, memory: Memory
) -> list[Verdict]:
    """Every sensor whose outliers are looked for: positions, and whatever declares a `gate_probability`."""
    result = []
    for builder in builders:
        if isinstance(builder, PositionBuilder):
            if builder.gated and builder.name in found:
                result.append(_position_verdict(builder, found[builder.name], memory))
        elif getattr(builder, "gate_probability", None):
            result += _block_verdict(builder, estimate)
    return result


def _position_verdict(builder: PositionBuilder, found: FixResiduals, memory: Memory) -> Verdict:
    sigma = np.maximum(builder.scaled_sigma(memory)[found.rows], builder.least_gate_sigma)
    square = (found.residual**2 / (sigma**2 + found.clock**2)).sum(axis=1)

    def limit(level: float, probability: float | None) -> Floats:
        return builder.limit(level, found.rows, probability)

    return Verdict(builder.name, found.rows, square, 3, limit, builder.config.loss == "gnc")


def _block_verdict(builder: Any, estimate: Estimate) -> list[Verdict]:
    stacks = estimate.stacks(builder.name)
    if not stacks:
        return []
    white = [stack.linearize(estimate.values)[0] for stack in stacks]
    square = np.concatenate([(rows**2).sum(axis=1) for rows in white])
    dim = white[0].shape[1]

    def limit(level: float, probability: float | None) -> Floats:
        return np.full(len(square), chi2(dim).ppf(probability or builder.gate_probability) * max(1.0, level))

    rows = np.concatenate([stack.rows for stack in stacks])
    return [Verdict(builder.name, rows, square, dim, limit)]


def revise(
    builders: Sequence[Builder], windows: Sequence[Window], estimate: Estimate, memory: Memory
) -> tuple[Memory, bool]:
    """The memory for the next pass, and whether there is nothing more to learn."""
    new, done = _revised(builders, windows, estimate, memory)
    if new.stage < LAST_STAGE:
        return new, done
    judged = settled(builders, estimate, new)
    judged = chosen(builders, estimate, judged) if judged is new else judged
    return judged, done and judged is new


def _revised(
    builders: Sequence[Builder], windows: Sequence[Window], estimate: Estimate, memory: Memory
) -> tuple[Memory, bool]:
    """The same by fixes and inertial data alone."""
    found = {b.name: (b, fix_residuals(b, windows, estimate, memory)) for b in position_builders(builders)}
    found = {name: pair for name, pair in found.items() if len(pair[1].rows)}
    new = memory
    for builder, residuals in found.values():
        new = _rescaled(builder, residuals, new)
    judged = verdicts(builders, {name: residuals for name, (_, residuals) in found.items()}, estimate, new)
    if memory.phase == "plain" and any(v.outside(1.0 - SURPRISE / len(v.rows)) for v in judged):
        return replace(new, phase="robust"), False
    if memory.narrowing:
        return replace(new, control=_narrower(found, memory.control)), False
    outliers = {v.name: v.outside() for v in judged}
    if memory.phase in ("robust", "graduated"):
        weighed = _graduated(judged, memory)
        if weighed is not None:
            return replace(weighed, noise_scales=new.noise_scales), False
        return replace(new, phase="gated", rejected=outliers, weights={}), False
    if memory.phase == "gated":
        new = replace(new, rejected=outliers)
    steady = all(abs(np.log(new.scale(name) / memory.scale(name))) < STEADY for name in found)
    tuned, calm = _inertial(builders, windows, estimate, memory, new, _level(found, memory))
    if memory.stage == LAST_STAGE:
        new, steady = tuned, steady and calm
    if not (steady and new.rejected == memory.rejected):
        return new, False
    grown = _grown(builders, estimate, tuned)
    return grown, grown == tuned


def widened(builders: Iterable[Builder], memory: Memory, metres: float = WIDE_M) -> Memory:
    """The memory of a robust pass from a start that is off by so many metres."""
    sigmas = [float(np.median(b.scaled_sigma(memory)[:, :2])) for b in position_builders(builders) if b.gated]
    return replace(memory, control=metres if min(sigmas, default=metres) < metres / 3 else 0.0)


def _narrower(found: Mapping[str, tuple[PositionBuilder, FixResiduals]], control: float) -> float:
    """The next least sigma (m) of fixes under the loss: a share of this one, less where most fixes agree better, none
    once it would be below what is known of them."""
    known = [(float(np.median(one.sigma[:, :2])), float(np.median(one.square))) for _, one in found.values()]
    level = chi2(3).median()
    wanted = min(NARROWER * control, 2.0 * max(sigma * np.sqrt(max(square / level, 1.0)) for sigma, square in known))
    return float(wanted) if wanted > min(sigma for sigma, _ in known) else 0.0


def _graduated(judged: Sequence[Verdict], memory: Memory) -> Memory | None:
    """The memory with the weights of the next control; None where every weight is settled, or none is asked for."""
    asked = [v for v in judged if v.graduated]
    if not asked:
        return None
    squares = {v.name: v.relative() for v in asked}
    if memory.phase == "robust":
        control = min(graduated.first_control(square, 1.0) for square in squares.values())
    else:
        control = GROWTH * memory.control
    found = {name: graduated.weights(square, 1.0, control) for name, square in squares.items()}
    if all(graduated.settled(weight) for weight in found.values()):
        return None
    weights = {v.name: dict(zip(v.rows.tolist(), found[v.name].tolist(), strict=True)) for v in asked}
    rejected = {v.name: v.outside() for v in judged if not v.graduated}
    return replace(memory, phase="graduated", rejected=rejected, weights=weights, control=control)


def extra_passes(builders: Iterable[Builder]) -> int:
    """Passes that a graduated loss, and tracks that follow on image pairs, need beyond those of the others."""
    builders = list(builders)
    graduated_too = any(b.config.loss == "gnc" for b in position_builders(builders))
    return GRADUATED_PASSES * graduated_too + ROUNDS * (one_of(builders, SmartBuilder) is not None)


def _grown(builders: Sequence[Builder], estimate: Estimate, memory: Memory) -> Memory:
    """The memory with what joins once the trajectory is found, and without what turned out not to be observable."""
    positions = position_builders(builders)
    wandering = frozenset(b.name for b in positions if b.wanders(memory))
    if memory.stage < LAST_STAGE:
        later = any(b.stage == LAST_STAGE or (hasattr(b, "grows") and b.grows(memory)) for b in builders)
        return replace(memory, stage=LAST_STAGE, correlated=wandering) if later else memory
    blind = {
        state.name: state.prior_mean
        for state in estimate.session.values()
        if not state.held and (state.sigma > OBSERVED * state.prior_sigma).all()
    }
    return replace(memory, held={**memory.held, **blind}, correlated=wandering)


def _level(found: Mapping[str, tuple[PositionBuilder, FixResiduals]], memory: Memory) -> float:
    """Normalised square of the fixes in use over their redundancy, at least 1."""
    square = redundancy = 0.0
    for name, (_, one) in found.items():
        used = memory.used(name, one.rows)
        square += float(one.square[used].sum())
        redundancy += float(one.redundancy[used].sum())
    return max(1.0, square / redundancy) if redundancy > 0.0 else 1.0


def _inertial(
    builders: Sequence[Builder],
    windows: Sequence[Window],
    estimate: Estimate,
    memory: Memory,
    new: Memory,
    level: float,
) -> tuple[Memory, bool]:
    """`new` with the inertial noise found, and whether that changed little. While some of the model is still missing,
    residuals hold more than noise: what they say is an upper bound. Beside fixes that wander it is a lower one: the
    solution follows slow errors of the sensor as it follows those of the fixes, and residuals tell the quick part.
    Beside images and constraints of a vehicle too: these are better, or kept to less, than their sigma says."""
    scales = noise_scales(builders, windows, estimate, memory, level)
    if any(builder.wanders(memory) for builder in position_builders(builders)):
        scales = {name: max(scale, 1.0) for name, scale in scales.items()}
    if memory.settled or one_of(builders, VehicleBuilder) is not None:
        scales = {name: max(scale, memory.scale(name)) for name, scale in scales.items()}
    if memory.stage < LAST_STAGE:
        scales = {name: min(scale, memory.scale(name)) for name, scale in scales.items()}
        return replace(new, noise_scales={**new.noise_scales, **scales}), True
    scales |= row_scales(builders, estimate, memory)
    change = [abs(np.log(scale / memory.scale(name))) for name, scale in scales.items()]
    return replace(new, noise_scales={**new.noise_scales, **scales}), max(change, default=0.0) < STEADY_INERTIAL


def _rescaled(builder: PositionBuilder, found: FixResiduals, memory: Memory) -> Memory:
    """Variance component of the rows without a sigma of their own; rows outside the gate do not count."""
    if builder.name in memory.correlated:
        return memory
    outside = _position_verdict(builder, found, memory).outside() | memory.rejected.get(builder.name, frozenset())
    used = ~builder.own_sigma[found.rows] & ~np.isin(found.rows, list(outside))
    redundancy = float(found.redundancy[used].sum())
    if not builder.config.estimate_sigma or redundancy < LEAST_REDUNDANCY:
        return memory
    step = float(np.clip(np.sqrt(found.square[used].sum() / redundancy), 0.2, 5.0))
    least = LEAST_SIGMA / float(builder.sigma[found.rows[used]].min())
    scale = max(memory.scale(builder.name) * step, least)
    return replace(memory, noise_scales={**memory.noise_scales, builder.name: scale})

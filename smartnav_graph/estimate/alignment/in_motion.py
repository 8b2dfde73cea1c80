"""The first state on which most of the first fixes agree: the inertial curve laid on them, outliers and all.

    fix_k = p0 + v0 t_k - g t_k^2 / 2 + R (c_k + C_k b)

c_k is the doubly integrated specific force in the first body frame, C_k its derivative by the unknowns b: the six
inertial biases, and a change of velocity and of attitude after every gap and every ten seconds of noise. Solved by
Gauss-Newton inside graduated non-convexity: a hundredth of the work of a factor graph, and neither single outliers nor
bursts among the first fixes bend it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp, skew
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.alignment.static import inertial_motion
from smartnav_graph.graph import gnc
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import ImuNoise

# Errors (m) that neither curve nor fix models: lever arms, clock offsets of 0.1 s, correlated errors.
UNMODELLED = 2.0
# Noise of the unmeasured motion inside a gap: m/s^2 and rad/s per sqrt(Hz).
GAP_ACCEL, GAP_GYRO = 0.25, 0.05
KICK_S = 10.0
LIMIT = float(chi_square.ppf(0.999, 3))  # of the squares of fixes that agree
GROWTH = 1.4  # of mu, an iteration
STEPS = 80
MOST_FIXES = 300
SHORT_S, LEAST_FIXES = 12.0, 6  # the first seconds
MOVED = 0.01  # rad/s, by which a rate may be off where the curve was integrated
ROUNDS = 3  # integrations, each at the bias found by the one before
BEST = 3  # states that the curve is integrated once more for
ALIKE = 0.2  # rad, between starts that lead to the same solution
FIRST_STEPS = 5
DAMPING = (1e-9, 1e-3, 1e-1, 1e1, 1e3)
LEAST_CURVATURE = 1e-6  # of a rotation that is not observable


@dataclass(frozen=True)
class Curve:
    """Inertial curve at the end of each window: place (n, 3) m in the first body frame; its derivative (n, 3, q) by
    what is not known of it, the biases about `bias` (6,) first; the prior sigma (q,) of that."""

    place: Floats
    by: Floats
    sigma: Floats
    bias: Floats

    def at(self, rows: NDArray[np.intp]) -> Curve:
        """The same at some of its rows."""
        return replace(self, place=self.place[rows], by=self.by[rows])


@dataclass(frozen=True)
class Alignment:
    """A first state: nav_R_body (3, 3), position and velocity (3,), what was found of the curve (q,), biases first;
    squares (m,) of the fixes' residuals."""

    R: Floats
    p: Floats
    v: Floats
    found: Floats
    square: Floats

    @property
    def outside(self) -> NDArray[np.bool_]:
        """Mask (m,) of the fixes that do not agree."""
        return self.square > LIMIT

    @property
    def cost(self) -> float:
        """Truncated sum of the squared residuals."""
        return gnc.truncated(self.square, LIMIT)


def _integrated(windows: Sequence[Window], bias: Floats) -> tuple[Floats, Floats]:
    return inertial_motion(windows, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))


def curve_of(windows: Sequence[Window], bias: Floats, noise: ImuNoise, bias_sigma: Floats) -> Curve:
    """The curve of windows integrated at `bias` (6,), known to `bias_sigma` (6,)."""
    place, speed = _integrated(windows, bias)
    step = np.array([1e-2] * 3 + [1e-4] * 3)
    by = [(_integrated(windows, bias + delta)[0] - place) / delta.max() for delta in np.diag(step)]
    t = np.array([w.t1_ns - windows[0].t0_ns for w in windows]) / NS
    sigmas = [bias_sigma]
    for k, kick in _kicks(windows, t, noise):
        since = np.maximum(t - t[k], 0.0)[:, None]
        rotate = skew(np.where(since > 0, place - place[k] - speed[k] * since, 0.0))
        by += [*(since * np.eye(3)[:, None]), *np.moveaxis(-rotate, 2, 0)]
        sigmas.append(np.repeat(kick, 3))
    return Curve(place, np.stack(by, axis=-1), np.concatenate(sigmas), bias)


def _kicks(windows: Sequence[Window], t: Floats, noise: ImuNoise) -> list[tuple[int, Floats]]:
    """Windows at whose end velocity and attitude may change, with the sigmas of that: after every gap, and as often as
    the noise in between is lumped together."""
    kicks, since = [], 0.0
    density = np.array([noise.accel_noise_density, noise.gyro_noise_density])
    for k, window in enumerate(windows[:-1]):
        if window.kind == "gap":
            kicks.append((k, np.sqrt(window.length_s) * np.array([GAP_ACCEL, GAP_GYRO])))
        elif t[k] - since >= KICK_S:
            kicks.append((k, np.sqrt(t[k] - since) * density))
            since = t[k]
    return kicks


@dataclass(frozen=True)
class AlignmentProblem:
    """Fixes (m, 3) at t (m,) s with one sigma m, the curve at each, and the mean (6,) of the biases."""

    curve: Curve
    fixes: Floats
    t: Floats
    sigma: float
    gravity: float
    bias_mean: Floats

    def _off(self, state: Alignment) -> Floats:
        """What was found of the curve (q,) beyond where it was integrated."""
        return np.concatenate([state.found[:6] - self.curve.bias, state.found[6:]])

    def residual(self, state: Alignment) -> tuple[Floats, Floats]:
        """Whitened residuals (m, 3), and their derivatives (m, 3, 9 + q) by R (nav), position, velocity, curve."""
        rotate = (self.curve.place + self.curve.by @ self._off(state)) @ state.R.T
        line = state.p + state.v * self.t[:, None]
        line[:, 2] -= 0.5 * self.gravity * self.t**2
        by = np.zeros((len(self.t), 3, 9 + len(state.found)))
        by[:, :, :3] = -skew(rotate)
        by[:, :, 3:6] = np.eye(3)
        by[:, :, 6:9] = np.eye(3) * self.t[:, None, None]
        by[:, :, 9:] = state.R @ self.curve.by
        weight = 1.0 / np.hypot(self.sigma, UNMODELLED)
        return (line + rotate - self.fixes) * weight, by * weight

    def start(self, R: Floats, p: Floats, v: Floats) -> Alignment:
        """A state of which the curve knows nothing yet."""
        found = np.concatenate([self.bias_mean, np.zeros(len(self.curve.sigma) - 6)])
        return self._scored(Alignment(R, p, v, found, self.t))

    def _scored(self, state: Alignment) -> Alignment:
        return replace(state, square=(self.residual(state)[0] ** 2).sum(axis=1))

    def _prior(self, state: Alignment) -> Floats:
        """Whitened distance (q,) of what was found from what was known."""
        mean = np.concatenate([self.bias_mean, np.zeros(len(state.found) - 6)])
        return np.asarray((state.found - mean) / self.curve.sigma)

    def _cost(self, state: Alignment, weight: Floats) -> float:
        return float(weight @ state.square + (self._prior(state) ** 2).sum())

    def better(self, state: Alignment, weight: Floats) -> Alignment:
        """One step down under row weights (m,), damped where Gauss-Newton goes too far."""
        residual, by = self.residual(state)
        root, q = np.sqrt(weight), len(state.found)
        prior = np.hstack([np.zeros((q, 9)), np.diag(1.0 / self.curve.sigma)])
        A = np.concatenate([(by * root[:, None, None]).reshape(-1, 9 + q), prior])
        b = np.concatenate([(residual * root[:, None]).ravel(), self._prior(state)])
        normal, gradient, before = A.T @ A, A.T @ b, self._cost(state, weight)
        for damping in DAMPING:
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal) + LEAST_CURVATURE), gradient)
            R = exp(step[:3]) @ state.R
            new = self._scored(Alignment(R, state.p + step[3:6], state.v + step[6:9], state.found + step[9:], self.t))
            if self._cost(new, weight) <= before:
                return new
        return state

    def thinned(self) -> AlignmentProblem:
        """With at most `MOST_FIXES` fixes."""
        rows = np.arange(0, len(self.t), -(-len(self.t) // MOST_FIXES))
        return replace(self, curve=self.curve.at(rows), fixes=self.fixes[rows], t=self.t[rows])

    def agree(self, R: Floats, p: Floats, v: Floats) -> Alignment:
        """The state nearest to a start on which most fixes agree."""
        found = _agree(self.thinned(), R, p, v)
        return self._scored(found)


def _agree(problem: AlignmentProblem, R: Floats, p: Floats, v: Floats) -> Alignment:
    state, weight = problem.start(R, p, v), np.ones(len(problem.t))
    for _ in range(FIRST_STEPS):
        state = problem.better(state, weight)
    mu = gnc.first_mu(state.square, LIMIT)
    for _ in range(STEPS):
        weight = gnc.weights(state.square, LIMIT, mu)
        for _ in range(2):
            state = problem.better(state, weight)
        if np.isinf(mu) or (mu > 1.0 and gnc.converged(weight)):
            break
        mu *= GROWTH
    return state


@dataclass(frozen=True)
class Known:
    """What is known before: mean and sigma (6,) of the biases, noise of the inertial data, gravity m/s^2, and one sigma
    of the fixes, m."""

    bias_mean: Floats
    bias_sigma: Floats
    noise: ImuNoise
    gravity: float
    fix_sigma: float


Start = tuple[Floats, Floats, Floats]  # attitude, position, velocity


@dataclass(frozen=True)
class _Stretch:
    """Windows, the fixes (m, 3) at t_ns (m,) in them, and what is known before."""

    windows: Sequence[Window]
    t_ns: NDArray[np.int64]
    fixes: Floats
    known: Known

    def align_in_motion(self, bias: Floats, starts: Sequence[Start]) -> list[Alignment]:
        """The state that most fixes agree on from each start, on the curve integrated at a bias (6,)."""
        known, ends = self.known, np.array([w.t1_ns for w in self.windows])
        curve = curve_of(self.windows, bias, known.noise, known.bias_sigma)
        rows = np.minimum(np.searchsorted(ends, self.t_ns), len(self.windows) - 1)
        t = (self.t_ns - ends[0]) / NS
        problem = AlignmentProblem(curve.at(rows), self.fixes, t, known.fix_sigma, known.gravity, known.bias_mean)
        return [problem.agree(*start) for start in starts]

    def initial_part(self) -> _Stretch | None:
        """The part in which even a bad rate turns the curve little; None where it holds too few fixes."""
        ends = np.array([w.t1_ns for w in self.windows])
        until = max(int(self.t_ns[0]), int(ends[0])) + round(SHORT_S * NS)
        short = int(np.searchsorted(ends, until, side="right"))
        early = self.t_ns <= ends[max(short - 1, 0)]
        if early.sum() < LEAST_FIXES or short >= len(self.windows):
            return None
        return _Stretch(self.windows[:short], self.t_ns[early], self.fixes[early], self.known)


def starts_agreed(
    windows: Sequence[Window],
    t_ns: NDArray[np.int64],
    fixes: Floats,
    starts: Sequence[Start],
    known: Known,
    bias: Floats | None = None,
) -> list[Alignment]:
    """The different states that most fixes (m, 3) at t_ns (m,) agree on, cheapest first, from starts (attitude,
    position, velocity). The curve is integrated at `bias` (6,), by default the mean known before, and at that of the
    first seconds, because a rate wrong by degrees a second bends it beyond what is linear; and for the best
    once more at the bias they found."""
    stretch, points = _Stretch(windows, t_ns, fixes, known), [known.bias_mean if bias is None else bias]
    first = _first_bias(stretch, starts)
    if _far(first, points):
        points.append(first)
    found = distinct([state for at in points for state in stretch.align_in_motion(at, starts)])
    again = []
    for state in found[:BEST]:
        for _ in range(ROUNDS - 1):
            if _far(state.found[:6], points):
                points.append(state.found[:6])
                state = stretch.align_in_motion(state.found[:6], [(state.R, state.p, state.v)])[0]
        again.append(state)
    return distinct([*again, *found[BEST:]])


def _far(bias: Floats, points: Sequence[Floats]) -> bool:
    """Whether a curve integrated at one of `points` (6,) is not to be trusted at another bias (6,)."""
    return all(np.abs(bias - point)[3:].max() > MOVED for point in points)


def _first_bias(stretch: _Stretch, starts: Sequence[Start]) -> Floats:
    bias, short = stretch.known.bias_mean, stretch.initial_part()
    if short is None:
        return bias
    for _ in range(ROUNDS):
        before = bias
        bias = min(short.align_in_motion(bias, starts), key=lambda state: state.cost).found[:6]
        if not _far(bias, [before]):
            break
    return bias


def distinct(states: Sequence[Alignment]) -> list[Alignment]:
    """The different ones of these states, cheapest first."""
    selected: list[Alignment] = []
    for state in sorted(states, key=lambda s: s.cost):
        alike = (
            np.array_equal(state.outside, other.outside) and np.trace(state.R.T @ other.R) > 1 + 2 * np.cos(ALIKE)
            for other in selected
        )
        if not any(alike):
            selected.append(state)
    return selected

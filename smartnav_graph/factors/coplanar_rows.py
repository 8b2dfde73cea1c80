"""Row models of coplanarity: a pair of images as one row, all of its matches in it.

Camera poses follow from those of the body at the two keyframes, R_i, p_i and R_j, p_j:

    C = body_R_cam Exp(a),  D = R_i^T R_j,  m = R_i^T (p_j - p_i) + D l
    c0_R_c1 = C^T D C,      c0_t_c1 = C^T (m - l),      l = body_t_cam

with the boresight correction a as a state (A) where asked, and the clock offset d of the camera (T): the images show
the poses d later, R Exp(w d) and p + v d. Where the focal length given is too long by the share f (I), all coordinates
are 1 + f times what it says. An error of the principal point is a boresight, but for what is far from the axis.

A match is one Sampson residual; its derivatives go by the six components of the relative pose. The normal equations of
a pair in them have six rows at most, which say the same as all of its matches: A^T A = sum w J^T J. A seventh row
without derivatives holds what they leave, so that the squares of a row sum up to the cost of its matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.so3 import exp, log, right_jacobian, rotate, skew
from smartnav_graph.graph.robust import loss_weights
from smartnav_graph.graph.update import Measured
from smartnav_graph.vision.epipolar import Sampson, by_scale, cross, essential, rays, sampson
from smartnav_graph.vision.pairs import Pairs

# Baselines (m) far below this say nothing: the speed of a hand that holds still, over a second.
BASELINE_FLOOR_M = 1e-6
# Parts of the normal equations smaller than this share of the largest are rounding.
ROUNDING = 1e-12
# Error of the rotation that all matches of a pair share, in units of that of the direction of the baseline.
TURN_SHARE = 0.03
# Power of 1 + f that the focal length multiplies each entry of E by, row by row.
FOCAL_POWER = np.array([2.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 1.0, 0.0])
# Columns of a row's data: number of the pair, body rate (3) rad/s at both keyframes.
COLUMNS = 7


@dataclass(frozen=True)
class Rig:
    """Camera in the body: body_R_cam (3, 3), body_t_cam (3,) m; boresight, timed, focal : which states are estimated;
    known_s : clock offset that the keyframes at the images have already."""

    body_R_cam: Floats
    body_t_cam: Floats
    boresight: bool = False
    timed: bool = False
    known_s: float = 0.0
    focal: bool = False

    @property
    def letters(self) -> tuple[str, ...]:
        """Kinds of the states that a row touches."""
        clock = ("V", "V", "T") if self.timed else ()
        return ("X", "X", *clock, *(("A",) if self.boresight else ()), *(("I",) if self.focal else ()))


class Relative(NamedTuple):
    """c0_R_c1 (m, 3, 3), c0_t_c1 (m, 3), and their derivatives (m, 6, n) [rotation, translation] by each state but the
    focal length."""

    R: Floats
    t: Floats
    by: list[Floats]


def relative(rig: Rig, states: Sequence[Floats], data: Floats) -> Relative:
    """Relative camera pose of each row."""
    first, second, *rest = states
    speeds: list[Floats] = []
    delay = np.zeros((len(data), 1))
    if rig.timed:
        *speeds, delay = rest[:3]
        delay = delay - rig.known_s
        rest = rest[3:]
    rate = data[:, 1:4], data[:, 4:7]
    poses = (
        [_later(pose, w, v, delay) for pose, w, v in zip((first, second), rate, speeds, strict=True)]
        if speeds
        else [
            first,
            second,
        ]
    )
    found, by_first, by_second, by_boresight = _between(rig, poses[0], poses[1], rest[0] if rig.boresight else None)
    by = [by_first, by_second]
    if rig.timed:
        moved = [_by_speed(j, pose) for j, pose in zip(by, poses, strict=True)]
        turns = [_by_turn(j, w) for j, w in zip(by, rate, strict=True)]
        by_clock = np.sum([turn + m @ v[:, :, None] for turn, m, v in zip(turns, moved, speeds, strict=True)], axis=0)
        back = [exp(-w * delay) for w in rate]
        by = [_before(j, turn) for j, turn in zip(by, back, strict=True)]
        by += [m * delay[:, :, None] for m in moved] + [by_clock]
    return Relative(found[0], found[1], [*by, *([by_boresight] if rig.boresight else [])])


def _later(pose: Floats, rate: Floats, speed: Floats, delay: Floats) -> Floats:
    """Poses (m, 4, 4) `delay` (m, 1) s later."""
    moved = pose.copy()
    moved[:, :3, :3] = pose[:, :3, :3] @ exp(rate * delay)
    moved[:, :3, 3] += speed * delay
    return moved


def _by_speed(by_pose: Floats, pose: Floats) -> Floats:
    """Derivative (m, 6, 3) by a displacement in nav axes."""
    return by_pose[:, :, 3:] @ pose[:, :3, :3].transpose(0, 2, 1)


def _by_turn(by_pose: Floats, rate: Floats) -> Floats:
    """Derivative (m, 6, 1) by the time a turn goes on."""
    return by_pose[:, :, :3] @ rate[:, :, None]


def _before(by_pose: Floats, back: Floats) -> Floats:
    """Derivative by the pose before it turned on: R Exp(u) Exp(w d) = R Exp(w d) Exp(back u), p + R u."""
    return np.concatenate([by_pose[:, :, :3] @ back, by_pose[:, :, 3:] @ back], axis=2)


def _between(
    rig: Rig, first: Floats, second: Floats, boresight: Floats | None
) -> tuple[tuple[Floats, Floats], Floats, Floats, Floats]:
    """Relative camera pose and its derivatives by both body poses and by the boresight."""
    C = np.broadcast_to(rig.body_R_cam, (len(first), 3, 3)) if boresight is None else rig.body_R_cam @ exp(boresight)
    back, lever = C.transpose(0, 2, 1), rig.body_t_cam
    Ri, Rj = first[:, :3, :3], second[:, :3, :3]
    D = Ri.transpose(0, 2, 1) @ Rj
    m = rotate(Ri.transpose(0, 2, 1), second[:, :3, 3] - first[:, :3, 3]) + D @ lever
    R, t = back @ D @ C, rotate(back, m - lever)
    by_first, by_second, by_a = (np.zeros((len(first), 6, n)) for n in (6, 6, 3))
    by_first[:, :3, :3] = -(D @ C).transpose(0, 2, 1)
    by_first[:, 3:, :3] = back @ skew(m)
    by_first[:, 3:, 3:] = -back
    by_second[:, :3, :3] = back
    by_second[:, 3:, :3] = -back @ D @ skew(np.broadcast_to(lever, m.shape))
    by_second[:, 3:, 3:] = back @ D
    by_a[:, :3] = np.eye(3) - R.transpose(0, 2, 1)
    by_a[:, 3:] = skew(t)
    if boresight is not None:
        by_a = by_a @ right_jacobian(boresight)
    return (R, t), by_first, by_second, by_a


class Matched:
    """Matches of many pairs, of which a row each is made. Data: `COLUMNS`.

    sigma : of a match, normalised coordinates; use (n, k) : padded mask of the matches in use, may change until the
    row is added; loss_scale : of the Cauchy loss, in sigmas; focal : correction of the focal length that the
    coordinates have already; shared : sigma (rad) of the direction of a baseline beside the noise of its matches
    """

    def __init__(
        self,
        pairs: Pairs,
        rig: Rig,
        sigma: float,
        use: Mask,
        loss_scale: float,
        *,
        focal: float = 0.0,
        shared: float = 0.0,
    ) -> None:
        self.rig, self.sigma, self.use, self.loss_scale, self.there = rig, sigma, use, loss_scale, pairs.there
        self.focal, self.shared = focal, shared
        self.letters = rig.letters
        x0, x1, shift = pairs.matches
        self.x0, self.x1, self.shift = x0.copy(), x1.copy(), None if shift is None else shift.copy()

    def see(self, rows: NDArray[np.intp], pairs: Pairs) -> None:
        """Put other coordinates in place of those of pairs (m,), which are `pairs` now."""
        width = pairs.there.shape[1]
        self.x0[rows, :width], self.x1[rows, :width], shift = pairs.matches
        if shift is not None:
            self.shift = np.zeros((*self.there.shape, 3)) if self.shift is None else self.shift
            self.shift[rows, :width] = shift

    def longer(self, states: Sequence[Floats]) -> Floats:
        """Correction (m, 1) of the focal length by the states, beside that of the coordinates."""
        return states[-1] - self.focal if self.rig.focal else np.zeros((len(states[0]), 1))

    def missed(self, there: Relative, rows: NDArray[np.intp], longer: Floats) -> tuple[Sampson, Floats]:
        """How far all matches of rows (m,) of pairs miss, and the derivative by the focal length."""
        scale, shift = 1.0 + longer[:, :, None], None if self.shift is None else self.shift[rows]
        pair = there.R, there.t, self.x0[rows] * scale, self.x1[rows] * scale
        found = sampson(*pair, BASELINE_FLOOR_M, shift)
        if not self.rig.focal:
            return found, np.zeros_like(found.residual)
        return found, by_scale(*pair, found.residual, BASELINE_FLOOR_M, shift) / scale[:, :, 0]

    def measured(self, states: Sequence[Floats], data: Floats) -> Measured:
        """The matches of the rows one by one; see `whole_graph.StackedFactors.measured`."""
        rows = data[:, 0].astype(np.intp)
        found, _ = self.missed(relative(self.rig, states, data), rows, self.longer(states))
        white = (found.residual / self.sigma)[self.there[rows]]
        weight = loss_weights(white**2, "cauchy", self.loss_scale)[0]
        return Measured(np.nonzero(self.there[rows])[0], white[:, None], weight, self.use[rows][self.there[rows]])


class PairRows(Matched):
    """Row model of pairs with every match under a loss of its own. Beside a shared error rows are whitened anew where
    they are linearised."""

    def linearize(self, states: Sequence[Floats], data: Floats) -> tuple[Floats, list[Floats]]:
        rows = data[:, 0].astype(np.intp)
        there = relative(self.rig, states, data)
        found, by_focal = self.missed(there, rows, self.longer(states))
        white = found.residual / self.sigma
        weight, cost = loss_weights(white**2, "cauchy", self.loss_scale)
        weight, cost = weight * self.use[rows], cost * self.use[rows]
        focal = [by_focal[..., None]] if self.rig.focal else []
        by = np.concatenate([found.by_rotation, found.by_translation, *focal], axis=-1) / self.sigma
        weighted = (by * weight[..., None]).transpose(0, 2, 1)
        root, residual = _condensed(weighted @ by, (weighted @ white[..., None])[..., 0], 2.0 * cost.sum(axis=1))
        if self.shared > 0.0:
            size = np.sqrt((there.t**2).sum(axis=1) + BASELINE_FLOOR_M**2)[:, None]
            to_direction = np.concatenate([np.ones((len(size), 3)), np.repeat(size, 3, axis=1)], axis=1)
            whitening = _whitening(root[:, :, :6] * to_direction[:, None, :], there.t / size, self.shared)
            root, residual = whitening @ root, rotate(whitening, residual)
        return residual, [root[:, :, :6] @ jacobian for jacobian in there.by] + ([root[:, :, 6:]] if focal else [])


def _condensed(normal: Floats, right: Floats, square: Floats) -> tuple[Floats, Floats]:
    """n + 1 rows equivalent to normal equations (m, n, n) with right side (m, n) and a sum of squares (m,)."""
    values, vectors = np.linalg.eigh(normal)
    n = normal.shape[1]
    kept = values > ROUNDING * np.maximum(values[:, -1:], 1e-300)
    scale = np.sqrt(np.where(kept, values, 0.0))
    root = np.zeros((len(normal), n + 1, n))
    root[:, :n] = scale[:, :, None] * vectors.transpose(0, 2, 1)
    residual = np.zeros((len(normal), n + 1))
    seen = (vectors.transpose(0, 2, 1) @ right[:, :, None])[:, :, 0]
    residual[:, :n] = np.where(kept, seen / np.where(kept, scale, 1.0), 0.0)
    residual[:, n] = np.sqrt(np.maximum(square - (residual**2).sum(axis=1), 0.0))
    return root, residual


class CompressedRows(Matched):
    """Row model of pairs whose inliers are settled: what all matches say of the nine entries of E in nine rows.

        W = sum w k k^T / s_0^2 = L L^T,   k = x0~ kron x1~,   r = L^T vec(E) / (sigma sqrt(vec(E)^T N vec(E)))

    s_0 of each match and its weight w under the loss are frozen where it was compressed; the common length of E is not:
    N = sum N_i / sum s_0i^2 with s_i^2 = vec(E)^T N_i vec(E). Exact but for the change of the weights relative to each
    other. Where the matches have shifts d of their own in the baseline, the constant x0~^T [d]x R x1~ of each, R where
    it was compressed, is a tenth column beside vec(E).

    The focal length multiplies the entries of E by 1, 1 + f or (1 + f)^2. Beside a shared error the rows are linear in
    rotation, direction and f from where they were compressed: entries of E are not, over degrees of a stiff pair.
    """

    def __init__(
        self,
        pairs: Pairs,
        rig: Rig,
        sigma: float,
        use: Mask,
        loss_scale: float,
        frozen: Relative,
        *,
        focal: float = 0.0,
        shared: float = 0.0,
    ) -> None:
        super().__init__(pairs, rig, sigma, use, loss_scale, focal=focal, shared=shared)
        a, b = rays(self.x0), rays(self.x1)
        E = essential(frozen.R, frozen.t)
        l0, l1 = b @ E.transpose(0, 2, 1), a @ E
        square = (l0[..., :2] ** 2).sum(axis=-1) + (l1[..., :2] ** 2).sum(axis=-1) + BASELINE_FLOOR_M**2
        k, missed = (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:2], 9), (a * l0).sum(axis=-1)
        if self.shift is not None:
            constant = (self.shift * cross(b @ frozen.R.transpose(0, 2, 1), a)).sum(axis=-1)
            k, missed = np.concatenate([k, constant[..., None]], axis=-1), missed + constant
        weight = use * loss_weights(missed**2 / square / sigma**2, "cauchy", loss_scale)[0]
        k = k * np.sqrt(weight / square)[..., None]
        values, vectors = np.linalg.eigh(k.transpose(0, 2, 1) @ k)
        self.root = np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.transpose(0, 2, 1)
        total = np.maximum((square * weight).sum(axis=1), 1e-300)
        self.length = _lengths(a, b, weight) / total[:, None, None]
        self.floor = BASELINE_FLOOR_M**2 * weight.sum(axis=1) / total
        self._linear: _Linear | None = None
        if shared > 0.0:
            self._linear = self._with_shared_error(shared, frozen)

    def linearize(self, states: Sequence[Floats], data: Floats) -> tuple[Floats, list[Floats]]:
        rows = data[:, 0].astype(np.intp)
        there, longer = relative(self.rig, states, data), self.longer(states)
        r, by, by_focal = self._missed(rows, there, longer)
        return r, [by @ jacobian for jacobian in there.by] + ([by_focal] if self.rig.focal else [])

    def _missed(self, rows: NDArray[np.intp], there: Relative, longer: Floats) -> tuple[Floats, Floats, Floats]:
        """Residuals (m, 9) of some pairs, and their derivatives (m, 9, 6) by the relative pose, (m, 9, 1) by f."""
        if self._linear is not None:
            return self._linear.missed(rows, there, longer)
        e, by_e = _vectorised(there.R, there.t)
        scale = (1.0 + longer) ** FOCAL_POWER
        by_longer = (FOCAL_POWER * scale / (1.0 + longer) * e)[:, :, None]
        e, by_e = scale * e, scale[:, :, None] * by_e
        N, root = self.length[rows], self.root[rows]
        Ne = rotate(N, e)
        square = (e * Ne).sum(axis=1) + self.floor[rows]  # nothing where no match is in use
        s = np.sqrt(np.where(square > 0, square, 1.0))[:, None]
        at_e, constant = root[:, :, :9], root[:, :, 9:].sum(axis=2)
        r = (rotate(at_e, e) + constant) / (self.sigma * s)
        by = at_e / (self.sigma * s[:, :, None]) - r[:, :, None] * (Ne / s**2)[:, None, :]
        return r, by @ by_e, by @ by_longer

    def _with_shared_error(self, sigma: float, frozen: Relative) -> _Linear:
        """The rows whitened beside an error that all matches of a pair share: of the direction of the baseline, `sigma`
        rad, and of the rotation, a share of it; see `_whitening`."""
        r, A, f = self._missed(np.arange(len(self.root)), frozen, np.zeros((len(self.root), 1)))
        size = np.maximum(np.linalg.norm(frozen.t, axis=1), BASELINE_FLOOR_M)[:, None]
        A[:, :, 3:] *= size[:, :, None]
        u = frozen.t / size
        whitening = _whitening(A, u, sigma)
        return _Linear(rotate(whitening, r), whitening @ A, whitening @ f, frozen.R, u)


def _whitening(A: Floats, u: Floats, sigma: float) -> Floats:
    """L^-1 (n, k, k) of rows with derivatives A (n, k, 6) by rotation and unit direction u (n, 3), beside errors of
    both that all matches of a pair share, `sigma` rad of the direction:

        Q = diag(s_R^2 1, sigma^2 (1 - u u^T)),   1 + A Q A^T = L L^T,   rows <- L^-1 rows
    """
    Q = np.zeros((len(u), 6, 6))
    Q[:, :3, :3] = (TURN_SHARE * sigma) ** 2 * np.eye(3)
    Q[:, 3:, 3:] = sigma**2 * (np.eye(3) - u[:, :, None] * u[:, None, :])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(np.eye(A.shape[1]) + A @ Q @ A.transpose(0, 2, 1))))


@dataclass(frozen=True)
class _Linear:
    """Rows r + A [log(R0^T R), t / |t| - u0] + f (longer) of pairs: r (n, 9), A (n, 9, 6), f (n, 9, 1), R0 (n, 3, 3),
    u0 (n, 3)."""

    r: Floats
    A: Floats
    f: Floats
    R: Floats
    u: Floats

    def missed(self, rows: NDArray[np.intp], there: Relative, longer: Floats) -> tuple[Floats, Floats, Floats]:
        """As `CompressedRows._missed`."""
        size = np.sqrt((there.t**2).sum(axis=1) + BASELINE_FLOOR_M**2)[:, None]
        u, turn = there.t / size, log(self.R[rows].transpose(0, 2, 1) @ there.R)
        A, by = self.A[rows], np.zeros((len(rows), 6, 6))
        by[:, :3, :3] = np.linalg.inv(right_jacobian(turn))
        by[:, 3:, 3:] = (np.eye(3) - u[:, :, None] * u[:, None, :]) / size[:, :, None]
        r = self.r[rows] + rotate(A, np.concatenate([turn, u - self.u[rows]], axis=1)) + rotate(self.f[rows], longer)
        return r, A @ by, self.f[rows]


def _lengths(a: Floats, b: Floats, weight: Floats) -> Floats:
    """sum N_i (n, 9, 9), s_i^2 = vec(E)^T N_i vec(E): E b has the squares of its first two rows, E^T a likewise."""
    bb = (b * weight[..., None]).transpose(0, 2, 1) @ b
    aa = (a * weight[..., None]).transpose(0, 2, 1) @ a
    flat = np.diag([1.0, 1.0, 0.0])
    n = len(a)
    first = np.einsum("ij,nkl->nikjl", flat, bb).reshape(n, 9, 9)
    second = np.einsum("nij,kl->nikjl", aa, flat).reshape(n, 9, 9)
    return np.asarray(first + second)


def _vectorised(R: Floats, t: Floats) -> tuple[Floats, Floats]:
    """vec(E) (m, 9), row by row, and its derivative (m, 9, 6) by rotation and translation."""
    cross_t = skew(t)
    by = np.empty((len(t), 3, 3, 6))
    for i, axis in enumerate(np.eye(3)):
        generator = skew(axis[None])[0]
        by[:, :, :, i] = cross_t @ R @ generator
        by[:, :, :, 3 + i] = generator @ R
    return (cross_t @ R).reshape(-1, 9), by.reshape(-1, 9, 6)

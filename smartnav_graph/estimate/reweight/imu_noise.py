"""Inertial noise found from kept data: variance components of accelerometer, gyroscope and the walks of their biases.

Each group a has its own part Q_a of the covariance Sigma of an inertial factor. With r its residual at the solution
and C the covariance of the solution carried into the residual,

    q_a = r^T Sigma^-1 Q_a Sigma^-1 r        redundancy_a = tr(Q_a Sigma^-1 (Sigma - C) Sigma^-1)

the first has the second as its expectation where the noise is right, so that

    sigma_a^2 <- (sigma_a^2 sum q_a + nu_0 sigma_0a^2) / (sum redundancy_a + nu_0)

settles at the restricted maximum likelihood, held softly at the noise sigma_0 that was known before. No residual is
split among sensors: parts that overlap share what they explain.

Source: Koch (1999), Parameter estimation, 3.6; Wood, Fasiolo (2017), Biometrics 73(4), 1071 (Fellner-Schall).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Floats
from smartnav_graph.factors import imu_intrinsics
from smartnav_graph.factors.imu import CLASS_WEIGHT, ImuBuilder, accel_part, integration_part
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.update import Builder
from smartnav_graph.graph.windows import Window
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.whole_graph import StackedFactors

# Redundancy below which a group is not estimated.
LEAST_REDUNDANCY = 4.0
# Most that a sigma moves in one pass.
MOST = 5.0
# No device is a factor of more than this from what is known of its class, or of more than the second from the noise
# between its samples, where that is larger.
WIDEST, WIDEST_OF_SAMPLES = 10.0, 5.0
# Factor on either beyond which something else may be what makes the noise appear so.
WORSE = 2.5
# Share of the largest scale from which it is reached, and the normalised square of fixes beside it that white noise
# does not explain.
AT_MOST, UNEXPLAINED = 0.99, 4.0
# Normalised square at which fixes contradict their sigma.
CONTRADICTION = 2.0
# A group of less redundancy is estimated all the same where noise as assumed has so large a square this rarely.
SURPRISE = 1e-4
# The iteration creeps where the solution follows the noise: steps of the sigma's logarithm are so much longer.
RELAXATION = 1.5
# Groups of noise and their fields in `calibration.model.ImuNoise`.
NOISE_NAMES = {
    "accel": "accel_noise_density",
    "gyro": "gyro_noise_density",
    "accel_walk": "accel_bias_walk",
    "gyro_walk": "gyro_bias_walk",
}
WALKS = {"accel_walk": slice(0, 3), "gyro_walk": slice(3, 6)}


class Component(NamedTuple):
    """Normalised sum of squares of one group and its redundancy, equal on average where its noise is right."""

    square: float
    redundancy: float

    @property
    def is_known(self) -> bool:
        """Whether the data say enough of this group: by their number, or by how far off they are."""
        limit = chi_square.ppf(1.0 - SURPRISE, max(self.redundancy, 1.0))
        return self.redundancy >= LEAST_REDUNDANCY or bool(self.square > limit)

    def scale(
        self, before: float, weight: float, most: float = WIDEST, level: float = 1.0, prior: float = 1.0
    ) -> float:
        """The next scale of the group's sigma, at most `most`.

        weight : what the noise known before (scale `prior`) counts for; level : normalised square of the fixes with
        sigmas of their own. Where they contradict these more than the group does, they bend the solution, and the noise
        is not to blame.
        """
        blamed = level < CONTRADICTION or self.square > level * self.redundancy
        square = self.square if blamed else min(self.square, self.redundancy)
        wanted = np.sqrt((before**2 * square + weight * prior**2) / (self.redundancy + weight))
        if abs(np.log(wanted / before)) < 0.2 / np.sqrt(2.0 * (self.redundancy + weight)):
            return before  # a fifth of what the data leave open
        step = np.clip((wanted / before) ** RELAXATION, 1.0 / MOST, MOST)
        return float(np.clip(before * step, 1.0 / WIDEST, most))


class _Factors(NamedTuple):
    """Inertial factors at the solution: whitened residual (m, 9), its covariance left = 1 - C (m, 9, 9), and
    root (m, 9, 9) with root^T root = Sigma^-1."""

    windows: Sequence[Window]
    residual: Floats
    left: Floats
    root: Floats

    def component(self, part: Floats) -> Component:
        """Of one part (m, 9, 9) of the covariances."""
        white = self.root @ part @ self.root.transpose(0, 2, 1)
        square = np.einsum("ni,nij,nj->", self.residual, white, self.residual)
        return Component(float(square), max(float(np.einsum("nij,nji->", white, self.left)), 0.0))


def components(
    builder: ImuBuilder, windows: Sequence[Window], estimate: Estimate, pass_state: PassState
) -> Mapping[str, Component]:
    """Variance components by group: accel, gyro, accel_walk, gyro_walk.

    White noise is that in motion: windows across gaps have the noise of a straight line, and a device at rest is
    quieter than the same device shaken.
    """
    found = _walks(builder, windows, estimate, pass_state)
    moving = np.array([k for k, w in enumerate(windows) if w.kind == "normal" and k > 0], dtype=np.intp)
    if len(moving):
        found |= _white(builder, _factors([windows[k] for k in moving], moving, estimate), pass_state)
    return found


class _Linear(NamedTuple):
    """Inertial rows by window: whitened residual (m, 9), derivatives by pose, velocity and bias before (m, 9, 15) and
    by pose and velocity after (m, 9, 9), and the whitening root (m, 9, 9)."""

    residual: Floats
    before: Floats
    after: Floats
    root: Floats


def _native(windows: Sequence[Window], estimate: Estimate) -> _Linear:
    by_time = {tag.t_ns: factor for tag, factor in estimate.factors if tag.sensor == "imu"}
    factors = [by_time[w.t1_ns] for w in windows]
    pairs = [factor.linearize(estimate.values).jacobian() for factor in factors]
    A = np.array([jacobian for jacobian, _ in pairs])  # pose, velocity; pose, velocity after; bias
    before = np.concatenate([A[:, :, :9], A[:, :, 18:]], axis=2)
    root = np.array([factor.noiseModel().R() for factor in factors])
    return _Linear(-np.array([b for _, b in pairs]), before, A[:, :, 9:18], root)


def _scaled(stack: StackedFactors, windows: Sequence[Window], estimate: Estimate) -> _Linear:
    """Of windows whose scale factors are states; that these move the residuals too is left out, they are few."""
    residual, (pose, velocity, pose_j, velocity_j, bias, _) = stack.linearize(estimate.snapshot)
    place = {block.t_ns: row for row, block in enumerate(stack.blocks)}
    rows = [place[w.t1_ns] for w in windows]
    before, after = np.concatenate([pose, velocity, bias], axis=2), np.concatenate([pose_j, velocity_j], axis=2)
    root = imu_intrinsics.MODEL.unpacked(stack.data)["root"].reshape(-1, 9, 9)
    return _Linear(residual[rows], before[rows], after[rows], root[rows])


def _factors(windows: Sequence[Window], rows: NDArray[np.intp], estimate: Estimate) -> _Factors:
    scaled = next((stack for stack in estimate.stacks("imu") if stack.model is imu_intrinsics.MODEL), None)
    residual, before, after, root = _scaled(scaled, windows, estimate) if scaled else _native(windows, estimate)
    marginals = estimate.marginals
    mixed = before @ marginals.following[rows - 1][:, :, :9] @ after.transpose(0, 2, 1)
    carried = before @ marginals.joint[rows - 1] @ before.transpose(0, 2, 1)
    carried += after @ marginals.joint[rows][:, :9, :9] @ after.transpose(0, 2, 1)
    carried += mixed + mixed.transpose(0, 2, 1)
    return _Factors(windows, residual, np.eye(9) - carried, root)


def _white(builder: ImuBuilder, factors: _Factors, pass_state: PassState) -> dict[str, Component]:
    """What is neither the accelerometer's nor the integration's is the gyroscope's."""
    density = builder.noise.accel_noise_density * pass_state.scale("accel")
    accel = factors.component(accel_part(factors.windows, density))
    other = factors.component(integration_part(factors.windows, builder.config.integration_sigma))
    redundancy = float(np.trace(factors.left, axis1=1, axis2=2).sum())
    square = float((factors.residual**2).sum())
    left = max(redundancy - accel.redundancy - other.redundancy, 0.0)
    gyro = Component(square - accel.square - other.square, left)
    return {"accel": accel, "gyro": gyro}


def _walks(
    builder: ImuBuilder, windows: Sequence[Window], estimate: Estimate, pass_state: PassState
) -> dict[str, Component]:
    step = np.diff(estimate.states()[3], axis=0)
    joint, following = (
        np.diagonal(p, axis1=1, axis2=2)[:, 9:] for p in (estimate.marginals.joint, estimate.marginals.following)
    )
    spread = joint[:-1] + joint[1:] - 2.0 * following
    variance = builder.walk_sigma(pass_state) ** 2 * np.array([[w.length_s] for w in windows[1:]])
    square, redundancy = step**2 / variance, np.clip(1.0 - spread / variance, 0.0, 1.0)
    return {
        name: Component(float(square[:, part].sum()), float(redundancy[:, part].sum())) for name, part in WALKS.items()
    }


def noise_scales(
    builders: Iterable[Builder],
    windows: Sequence[Window],
    estimate: Estimate,
    pass_state: PassState,
    level: float = 1.0,
) -> dict[str, float]:
    """Scales of the inertial noise as the kept data show them, of the groups that they say enough of; `level` is the
    normalised square of the fixes with sigmas of their own."""
    builder = next((b for b in builders if isinstance(b, ImuBuilder) and b.config.estimate_noise), None)
    if builder is None or len(windows) < 2:
        return {}
    known, prior = builder.sampling_scales(), builder.prior_scales()
    most = {name: _most(known.get(name, 0.0)) for name in NOISE_NAMES}
    weight = {name: CLASS_WEIGHT if name in prior else builder.weight for name in NOISE_NAMES}
    return {
        name: part.scale(pass_state.scale(name), weight[name], most[name], level, prior.get(name, 1.0))
        for name, part in components(builder, windows, estimate, pass_state).items()
        if part.is_known
    }


def _most(own: float) -> float:
    """The largest scale of a group whose samples show the scale `own`."""
    return max(WIDEST, WIDEST_OF_SAMPLES * own)


def worse_than_class(builder: ImuBuilder, pass_state: PassState, fixes_square: float = 1.0) -> dict[str, float]:
    """Scales of the white inertial noise found, where they are beyond its class and what the samples show; beside
    fixes of so large a normalised square that noise does not explain it, where they are as large as they may be."""
    share = AT_MOST if fixes_square > UNEXPLAINED else np.inf
    return {
        name: pass_state.scale(name)
        for name, own in builder.sampling_scales().items()
        if pass_state.scale(name) > min(WORSE * max(1.0, WIDEST_OF_SAMPLES * own), share * _most(own))
    }

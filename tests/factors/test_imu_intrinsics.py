"""Scale factors and misalignments as states: derivatives, agreement with GTSAM's factor, and recovery."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from exact import GRAVITY, eight, record
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import smartnav_graph as sn
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors import imu_intrinsics
from smartnav_graph.factors.imu import ImuBuilder, ImuConfig
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import FactorBatch
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, Calibration, GnssNoise
from smartnav_graph.session.session import Session
from smartnav_graph.smoothers.incremental import ReplayConfig
from smartnav_graph.smoothers.whole_graph import StackedFactors, custom_factor

NOISE = DEVICE_CLASSES["mems"]
QUIET = replace(NOISE, accel_noise_density=2e-3, gyro_noise_density=1e-4)
WHITE = GnssNoise(correlated_horizontal_sigma=0.0, correlated_vertical_sigma=0.0)
SIGMA = 0.01  # one per cent, 0.57 deg
SCALED = Config(imu=ImuConfig(scale_sigma=SIGMA))


def tumbling(seconds: float = 1.0, hertz: float = 100.0) -> Window:
    """A window that turns and shakes about all axes."""
    t = np.arange(round(seconds * hertz)) / hertz
    gyro = np.stack([0.4 * np.sin(3 * t), 0.3 * np.cos(2 * t), 0.6 + 0.2 * t], axis=1)
    accel = np.stack([np.sin(5 * t), 0.5 + np.cos(4 * t), GRAVITY + np.sin(2 * t)], axis=1)
    return Window(1, 0, round(seconds * NS), "normal", np.full(len(t), 1.0 / hertz), accel, gyro)


def deltas(window: Window, bias: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Oracle: strapdown integration of corrected samples, written down anew; rotation and [dp, dv]."""
    accel, gyro = (
        (reading - b) @ (np.eye(3) + M.reshape(3, 3)).T
        for reading, b, M in ((window.accel, bias[:3], S[:9]), (window.gyro, bias[3:], S[9:]))
    )
    R, p, v = Rotation.identity(), np.zeros(3), np.zeros(3)
    for a, w, dt in zip(accel, gyro, window.dt, strict=True):
        p, v = p + v * dt + 0.5 * R.apply(a) * dt**2, v + R.apply(a) * dt
        R = R * Rotation.from_rotvec(w * dt)
    return R.as_matrix(), np.concatenate([p, v])


BIAS = np.array([0.1, -0.2, 0.05, 0.01, -0.02, 0.03])


def test_integration_is_that_of_the_mechanisation_and_nearly_gtsams():
    found = imu_intrinsics.integrated_with_intrinsics(tumbling(), BIAS)
    R, rest = deltas(tumbling(), BIAS, np.zeros(18))
    np.testing.assert_allclose(found.dR, R, atol=1e-12)
    np.testing.assert_allclose(np.concatenate([found.dp, found.dv]), rest, atol=1e-12)
    bias = gtsam.imuBias.ConstantBias(BIAS[:3], BIAS[3:])
    pim = ImuBuilder(NOISE, GRAVITY).preintegrate(tumbling(), bias, PassState())
    # GTSAM adds rotation vectors up to first order of each interval
    np.testing.assert_allclose(found.dR, pim.deltaRij().matrix(), atol=1e-4)
    np.testing.assert_allclose(found.dv, pim.deltaVij(), atol=1e-3)
    np.testing.assert_allclose(found.dp, pim.deltaPij(), atol=1e-3)


def test_derivatives_by_bias_scale_and_misalignment_are_the_numerical_ones():
    window, step = tumbling(), 1e-5
    found = imu_intrinsics.integrated_with_intrinsics(window, BIAS)
    for column in range(24):
        ends = []
        for sign in (1.0, -1.0):
            moved = np.concatenate([BIAS, np.zeros(18)])
            moved[column] += sign * step
            ends.append(deltas(window, moved[:6], moved[6:]))
        (up_R, up), (down_R, down) = ends
        turn = Rotation.from_matrix(down_R.T @ up_R).as_rotvec()
        numeric = np.concatenate([turn, up - down]) / (2 * step)
        np.testing.assert_allclose(found.by[:, column], numeric, atol=2e-5, err_msg=str(column))


# --- the row ----------------------------------------------------------------------------------------------------------


def states(off: float, seed: int = 0) -> gtsam.Values:
    """Keyframes at both ends of the window, `off` of a unit from what it foretells; S beside zero."""
    rng = np.random.default_rng(seed)
    bias = gtsam.imuBias.ConstantBias(BIAS[:3], BIAS[3:])
    first = gtsam.NavState(gtsam.Rot3.Ypr(0.3, 0.1, -0.2), np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    second = ImuBuilder(NOISE, GRAVITY).preintegrate(tumbling(), bias, PassState()).predict(first, bias)
    values, delta = gtsam.Values(), gtsam.VectorValues()
    for i, nav in enumerate((first, second)):
        values.insert(key("X", i), nav.pose())
        values.insert(key("V", i), nav.velocity())
        delta.insert(key("X", i), off * rng.standard_normal(6))
        delta.insert(key("V", i), off * rng.standard_normal(3))
    values.insert(key("B", 0), bias)
    values.insert(key("S", 0), np.zeros(18))
    delta.insert(key("B", 0), 0.1 * off * rng.standard_normal(6))
    delta.insert(key("S", 0), 0.1 * off * rng.standard_normal(18))
    return values.retract(delta)


def row() -> tuple[FactorBatch, gtsam.ImuFactor]:
    """The window as a row, and as GTSAM's factor."""
    bias = gtsam.imuBias.ConstantBias(BIAS[:3], BIAS[3:])
    builder = ImuBuilder(NOISE, GRAVITY)
    pim = builder.preintegrate(tumbling(), bias, PassState())
    native = builder._factor(tumbling(), pim, PassState())
    keys = (key("X", 0), key("V", 0), key("X", 1), key("V", 1), key("B", 0), key("S", 0))
    data = imu_intrinsics.columns(tumbling(), BIAS, pim.preintMeasCov(), GRAVITY)
    return FactorBatch("imu", imu_intrinsics.MODEL, [keys], data[None], NS), native


def test_the_residual_is_zero_at_what_the_window_foretells():
    block, _ = row()
    # the keyframes are GTSAM's; see above
    np.testing.assert_allclose(StackedFactors(block.model, [block], {}).linearize(states(0.0))[0], 0.0, atol=0.3)


def test_squares_are_those_of_gtsams_factor():
    """Frames of the residuals differ (first body frame, last one); with S at zero their squares must not."""
    block, native = row()
    for seed in range(5):
        values = states(3e-3, seed)
        values.update(key("S", 0), np.zeros(18))
        mine = StackedFactors(block.model, [block], {}).linearize(values)[0]
        theirs = np.sum(native.whitenedError(values) ** 2)
        assert (mine**2).sum() == pytest.approx(theirs, rel=0.05)


def test_the_derivative_of_the_row_is_the_numerical_one():
    block, _ = row()
    values, stack, step = states(0.02), StackedFactors(block.model, [block], {}), 1e-6
    found = stack.linearize(values)[1]
    for letter, name, jacobian in zip(block.model.letters, block.keys[0], found, strict=True):
        for column in range(jacobian.shape[2]):
            ends = []
            for sign in (1.0, -1.0):
                delta = gtsam.VectorValues()
                delta.insert(name, sign * step * np.eye(jacobian.shape[2])[column])
                ends.append(stack.linearize(values.retract(delta))[0][0])
            numeric = (ends[0] - ends[1]) / (2 * step)
            size = np.abs(jacobian[0]).max()
            np.testing.assert_allclose(jacobian[0, :, column], numeric, atol=1e-4 * size, err_msg=f"{letter} {column}")


def test_a_custom_factor_of_the_row_has_its_error():
    block, _ = row()
    values = states(0.01)
    factor = custom_factor(block, 0, {})
    np.testing.assert_allclose(
        factor.unwhitenedError(values), StackedFactors(block.model, [block], {}).linearize(values)[0][0], atol=1e-9
    )


# --- recovery ---------------------------------------------------------------------------------------------------------


def scaled_session(seed: int, seconds: float = 60.0) -> tuple[Session, np.ndarray]:
    """A figure eight, the phone swaying, fixes of 1 cm; readings with scale 1 % and misalignment 0.5 deg (sigma)."""
    made = record(eight(seconds), noise=QUIET, fix_sigma=0.01, hertz=50.0, seed=seed)
    S = SIGMA * np.random.default_rng((seed, 1)).standard_normal(18)
    imu, biases = made.session.imu, made.biases
    accel, gyro = (
        (reading - bias) @ np.linalg.inv(np.eye(3) + M.reshape(3, 3)).T + bias
        for reading, bias, M in ((imu.accel, biases.accel, S[:9]), (imu.gyro, biases.gyro, S[9:]))
    )
    calibration = Calibration(imu_noise=QUIET, gnss_noise=WHITE)
    session = made.session.replace(imu=replace(imu, accel=accel, gyro=gyro), control=None, calibration=calibration)
    return session, S


@pytest.fixture(scope="module")
def recovered() -> list[tuple[np.ndarray, dict]]:
    out = []
    for seed in range(3):
        session, S = scaled_session(seed)
        out.append((S, sn.run(session, SCALED).summary))
    return out


def test_scale_and_misalignment_are_found_within_their_sigma(recovered):
    for S, summary in recovered:
        state = summary["states"][imu_intrinsics.NAME]
        value, sigma = np.array(state["value"]), np.array(state["sigma"])
        assert not state["held"] and summary["converged"]
        assert (np.abs(value - S) < 3.5 * sigma).all()
        assert (sigma < 0.6 * SIGMA).sum() >= 4
        assert sigma[[0, 17]].max() < 0.25 * SIGMA  # the scale along the way, and that of the turns


def test_their_sigmas_are_consistent(recovered):
    square = 0.0
    for S, summary in recovered:
        state = summary["states"][imu_intrinsics.NAME]
        square += float((((np.array(state["value"]) - S) / state["sigma"]) ** 2).sum())
    low, high = chi2(18 * len(recovered)).ppf([5e-4, 1 - 5e-4])
    assert 0.5 * low < square < 1.2 * high  # elements are correlated, which widens the spread


def test_what_the_motion_does_not_excite_keeps_its_prior(recovered):
    for _, summary in recovered:
        state = summary["states"][imu_intrinsics.NAME]
        sigma = np.array(state["sigma"])
        assert (sigma <= SIGMA * 1.001).all() and sigma.max() > 0.7 * SIGMA
        assert state["observed"] == [bool(s < 0.7 * SIGMA) for s in sigma]


def test_errors_not_modelled_cost_chi_square(recovered):
    session, _ = scaled_session(0)
    off = sn.run(session, Config(imu=ImuConfig(estimate_noise=False))).summary
    on = sn.run(session, Config(imu=ImuConfig(estimate_noise=False, scale_sigma=SIGMA))).summary
    assert on["cost"] < 0.8 * off["cost"]


def test_replay_estimates_them_too():
    session, S = scaled_session(1, 40.0)
    config = replace(SCALED, replay=ReplayConfig(polish=False))
    state = sn.run(session, config, causal=True).summary["states"][imu_intrinsics.NAME]
    assert (np.abs(np.array(state["value"]) - S) < 4.0 * np.array(state["sigma"])).all()


def test_off_by_default_and_bounded():
    assert imu_intrinsics.NAME not in sn.run(scaled_session(0, 20.0)[0]).summary["states"]
    with pytest.raises(ConfigError, match=r"config \[imu\]: scale_sigma = 0.5; expected between 0 and 0.2"):
        ImuConfig(scale_sigma=0.5)

"""Preintegration against independent oracles; windows in gaps."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from exact import GRAVITY, assemble, record
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS, Gap, ns_from_seconds
from smartnav_graph.factors.gap_model import Bridge
from smartnav_graph.factors.imu import ImuBuilder, ImuConfig
from smartnav_graph.graph.keyframes import KeyframeConfig, make_windows
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.graph.states import State
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, ImuNoise
from smartnav_graph.session.streams import Imu

NOISE = DEVICE_CLASSES["mems"]
ZERO = gtsam.imuBias.ConstantBias()


def window_of(accel, gyro, dt: float = 0.01) -> Window:
    """One window of constant intervals."""
    accel, gyro = np.atleast_2d(accel), np.atleast_2d(gyro)
    return Window(1, 0, round(len(accel) * dt * NS), "normal", np.full(len(accel), dt), accel, gyro)


def turning(seconds: float = 1.0) -> Window:
    """A window on a turn while speeding up, 100 Hz."""
    n = round(100 * seconds)
    return window_of(np.tile([0.8, 1.5, GRAVITY], (n, 1)), np.tile([0.1, -0.2, 0.6], (n, 1)))


def builder(noise: ImuNoise = NOISE, **kwargs) -> ImuBuilder:
    return ImuBuilder(noise, GRAVITY, **kwargs)


# --- known motions ----------------------------------------------------------------------------------------------------


def predicted(window: Window, v=(0.0, 0.0, 0.0), bias=ZERO) -> gtsam.NavState:
    start = gtsam.NavState(gtsam.Rot3(), np.zeros(3), np.array(v))
    return builder().preintegrate(window, bias, PassState()).predict(start, bias)


def test_a_device_at_rest_stays():
    end = predicted(window_of(np.tile([0, 0, GRAVITY], (200, 1)), np.zeros((200, 3))))
    np.testing.assert_allclose(end.position(), 0.0, atol=1e-12)
    np.testing.assert_allclose(end.velocity(), 0.0, atol=1e-12)


def test_free_fall():
    end = predicted(window_of(np.zeros((200, 3)), np.zeros((200, 3))), v=(3.0, 0.0, 0.0))
    np.testing.assert_allclose(end.position(), [6.0, 0.0, -0.5 * GRAVITY * 4], atol=1e-10)
    np.testing.assert_allclose(end.velocity(), [3.0, 0.0, -2 * GRAVITY], atol=1e-12)


def test_a_constant_turn_to_the_left_is_a_circle():
    # v = 5 m/s forward (+y), yaw rate w about z: radius v / w, force v w to the left (-x)
    v, w = 5.0, 0.5
    n = 2000
    window = window_of(np.tile([-v * w, 0.0, GRAVITY], (n, 1)), np.tile([0, 0, w], (n, 1)), dt=5e-4)
    # the force is the mean over the interval in the axes of its start
    window = replace(window, accel=window.accel + 0.5 * 5e-4 * np.cross(window.gyro, window.accel))
    end = predicted(window, v=(0.0, v, 0.0))
    angle = w * 1.0
    np.testing.assert_allclose(end.position(), [v / w * (np.cos(angle) - 1), v / w * np.sin(angle), 0.0], atol=1e-5)
    np.testing.assert_allclose(end.velocity(), [-v * np.sin(angle), v * np.cos(angle), 0.0], atol=1e-5)
    np.testing.assert_allclose(end.attitude().matrix(), gtsam.Rot3.Rz(angle).matrix(), atol=1e-12)


def test_a_bias_is_taken_out():
    bias = gtsam.imuBias.ConstantBias(np.array([0.1, -0.2, 0.3]), np.array([0.01, 0.02, -0.03]))
    still = window_of(
        np.tile(np.array([0, 0, GRAVITY]) + bias.accelerometer(), (100, 1)), np.tile(bias.gyroscope(), (100, 1))
    )
    np.testing.assert_allclose(predicted(still, bias=bias).position(), 0.0, atol=1e-12)


# --- oracles for state and covariance ---------------------------------------------------------------------------------


def combined(window: Window, noise: ImuNoise, integration_sigma: float) -> gtsam.PreintegratedCombinedMeasurements:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    params.setAccelerometerCovariance(np.eye(3) * noise.accel_noise_density**2)
    params.setGyroscopeCovariance(np.eye(3) * noise.gyro_noise_density**2)
    params.setIntegrationCovariance(np.eye(3) * integration_sigma**2)
    params.setBiasAccCovariance(np.eye(3) * noise.accel_bias_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * noise.gyro_bias_walk**2)
    pim = gtsam.PreintegratedCombinedMeasurements(params, ZERO)
    for accel, gyro, dt in zip(window.accel, window.gyro, window.dt, strict=True):
        pim.integrateMeasurement(accel, gyro, dt)
    return pim


def test_imu_factor_and_walk_agree_with_combined_imu_factor_over_a_second():
    window = turning()
    ours, theirs = builder().preintegrate(window, ZERO, PassState()), combined(window, NOISE, 1e-3)
    start = gtsam.NavState(gtsam.Rot3.Ypr(0.3, 0.1, -0.2), np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]))
    one, other = ours.predict(start, ZERO), theirs.predict(start, ZERO)
    np.testing.assert_allclose(one.position(), other.position(), atol=1e-9)
    np.testing.assert_allclose(one.velocity(), other.velocity(), atol=1e-9)
    np.testing.assert_allclose(one.attitude().matrix(), other.attitude().matrix(), atol=1e-12)
    # CombinedImuFactor grows the biases inside the window too: over a second less than one per cent of a sigma
    a, b = ours.preintMeasCov(), theirs.preintMeasCov()[:9, :9]
    sigma = np.sqrt(np.diag(b))
    np.testing.assert_allclose(a / np.outer(sigma, sigma), b / np.outer(sigma, sigma), atol=0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(a)), sigma, rtol=0.005)


def test_the_walk_has_the_variance_that_combined_imu_factor_gives_the_bias():
    recording = record()
    graph = assemble(recording.session, recording.truth)
    tag, factor = graph.factors("imu_bias")[5]
    length = next(w.length_s for w in graph.windows if w.t1_ns == tag.t_ns)
    walk = factor.noiseModel().sigmas()
    np.testing.assert_allclose(walk[:3], NOISE.accel_bias_walk * np.sqrt(length), rtol=1e-9)
    np.testing.assert_allclose(walk[3:], NOISE.gyro_bias_walk * np.sqrt(length), rtol=1e-9)
    theirs = np.sqrt(np.diag(combined(turning(), NOISE, 1e-3).preintMeasCov())[9:])
    np.testing.assert_allclose(theirs, [NOISE.accel_bias_walk] * 3 + [NOISE.gyro_bias_walk] * 3, rtol=1e-6)


def test_the_covariance_is_that_of_gtsams_scenario_runner():
    # Oracle: GTSAM's own Monte Carlo over its own noisy samples of a turning, climbing motion.
    noise = replace(NOISE, gyro_noise_density=3e-3)
    config = ImuConfig(integration_sigma=1e-7)
    ours = builder(noise, config=config)
    scenario = gtsam.ConstantTwistScenario(np.array([0.1, -0.2, 0.6]), np.array([0.0, 5.0, 0.3]))
    runner = gtsam.ScenarioRunner(scenario, ours.params(PassState()), 0.01, ZERO)
    t = np.arange(100) * 0.01
    window = window_of([runner.actualSpecificForce(x) for x in t], [runner.actualAngularVelocity(x) for x in t])
    mine = ours.preintegrate(window, ZERO, PassState()).preintMeasCov()
    oracle = runner.estimateCovariance(1.0, 2000, ZERO)
    # a variance of 2000 samples, 4 sigma: 4 sqrt(2 / 2000) = 13 %
    np.testing.assert_allclose(np.diag(mine), np.diag(oracle), rtol=0.13)
    sigma = np.sqrt(np.diag(mine))
    np.testing.assert_allclose(mine / np.outer(sigma, sigma), oracle / np.outer(sigma, sigma), atol=0.13)


def test_the_covariance_is_that_of_a_monte_carlo_of_the_mechanisation():
    # Oracle: strapdown integration written down anew, without GTSAM, noise of density / sqrt(dt) a sample.
    rng = np.random.default_rng(4)
    runs, window = 1500, turning()
    dt = window.dt[0]
    accel_sigma, gyro_sigma = (d / np.sqrt(dt) for d in (NOISE.accel_noise_density, NOISE.gyro_noise_density))
    R, p, v = Rotation.identity(runs), np.zeros((runs, 3)), np.zeros((runs, 3))
    for force, rate in zip(window.accel, window.gyro, strict=True):
        a = R.apply(force + accel_sigma * rng.standard_normal((runs, 3)))
        p, v = p + v * dt + 0.5 * a * dt**2, v + a * dt
        R = R * Rotation.from_rotvec((rate + gyro_sigma * rng.standard_normal((runs, 3))) * dt)
    mine = builder(config=ImuConfig(integration_sigma=1e-7)).preintegrate(window, ZERO, PassState()).preintMeasCov()
    end = Rotation.from_rotvec(window.gyro.mean(axis=0) * 1.0)
    spread = np.hstack([(end.inv() * R).as_rotvec(), p - p.mean(axis=0), v - v.mean(axis=0)])
    low, high = chi2(runs - 1).ppf([1e-5, 1 - 1e-5]) / (runs - 1)
    # rotation sigmas: GTSAM's tangent is that of the rotation vector, close to the body axes of a turn of 0.6 rad
    ratio = spread.var(axis=0, ddof=1) / np.diag(mine)
    assert (ratio[3:] > low).all() and (ratio[3:] < high).all(), ratio
    np.testing.assert_allclose(np.sqrt(ratio[:3]), 1.0, atol=0.07)


def test_noise_scales_act_on_their_own_group():
    scaled = builder().params(PassState(noise_scales={"accel": 2.0, "gyro": 3.0}))
    np.testing.assert_allclose(scaled.getAccelerometerCovariance(), np.eye(3) * (2 * NOISE.accel_noise_density) ** 2)
    np.testing.assert_allclose(scaled.getGyroscopeCovariance(), np.eye(3) * (3 * NOISE.gyro_noise_density) ** 2)


def test_no_default_of_gtsam_is_left():
    params = builder().params(PassState())
    for covariance in ("getAccelerometerCovariance", "getGyroscopeCovariance", "getIntegrationCovariance"):
        assert np.diag(getattr(params, covariance)()).max() < 1e-2  # GTSAM's own are one


def test_scaled_noise_is_not_kept_for_the_next_pass():
    ours = builder()
    plain = ours.preintegrate(turning(), ZERO, PassState()).preintMeasCov()
    louder = ours.preintegrate(turning(), ZERO, PassState(noise_scales={"gyro": 2.0})).preintMeasCov()
    np.testing.assert_allclose(louder[:3, :3], 4 * plain[:3, :3], rtol=1e-6)


# --- prediction inside a step -----------------------------------------------------------------------------------------


def test_the_first_keyframe_gets_no_inertial_factor():
    update = GraphUpdate(0, 0, 0.0)
    builder().add(update, replace(turning(), index=0, kind="first"), None, PassState())
    assert update.factors == [] and update.predicted is None


def test_the_step_foretells_the_state_and_its_variance():
    covariance = np.diag(np.r_[np.full(3, 1e-4), np.full(3, 4.0), np.full(3, 0.25), np.full(6, 1e-6)])
    nav = gtsam.NavState(gtsam.Rot3(), np.array([1.0, 2.0, 3.0]), np.array([4.0, 0.0, 0.0]))
    update = GraphUpdate(1, NS, 1.0)
    window = window_of(np.tile([0, 0, GRAVITY], (100, 1)), np.zeros((100, 3)))
    builder().add(update, window, State(0, 0, nav, ZERO, covariance), PassState())
    np.testing.assert_allclose(update.predicted.position(), [5.0, 2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(update.predict(nav, ZERO).position(), [5.0, 2.0, 3.0], atol=1e-12)
    # position 4 m^2, velocity 0.25 m^2/s^2 over 1 s, tilt (g/2 * 0.01)^2, white force density^2 / 3, integration 1e-6
    expected = 4.0 + 0.25 + (GRAVITY / 2) ** 2 * 1e-4 + NOISE.accel_noise_density**2 / 3 + 1e-6
    np.testing.assert_allclose(update.variance, expected, rtol=1e-4)


# --- gaps -------------------------------------------------------------------------------------------------------------


def test_a_window_in_a_gap_takes_the_bridge_noise():
    n = 1000
    imu = Imu(t_ns=ns_from_seconds(np.arange(n) / 100), accel=np.tile([0, 0, GRAVITY], (n, 1)), gyro=np.zeros((n, 3)))
    gap = Gap(4 * NS, 5 * NS, "bridged")
    bridge = Bridge(np.array([2.0, 1.0, 0.5]), np.array([0.03, 0.02, 0.01]))
    ours = ImuBuilder(NOISE, GRAVITY, [gap], {gap.start_ns: bridge})
    windows = make_windows(imu, np.array([3, 4, 5, 6]) * NS, [gap], {}, KeyframeConfig())
    assert [w.kind for w in windows] == ["first", "normal", "gap", "normal"]
    normal, inside = (ours.preintegrate(w, ZERO, PassState()).preintMeasCov() for w in windows[1:3])
    np.testing.assert_allclose(np.sqrt(np.diag(inside)[6:]), bridge.accel, rtol=0.02)
    np.testing.assert_allclose(np.sqrt(np.diag(inside)[:3]), bridge.gyro, rtol=1e-3)
    assert np.sqrt(np.diag(normal)[6:]).max() < 0.1


def test_config_refuses_what_is_not_positive():
    with pytest.raises(ConfigError, match=r"config \[imu\]: integration_sigma = 0.0; expected > 0"):
        ImuConfig(integration_sigma=0.0)


def test_a_turn_raises_the_noise_of_an_uncalibrated_gyro_in_replay():
    dt = np.full(50, 0.01)
    gyro = np.tile([0.0, 0.0, 0.8], (50, 1))  # 0.4 rad, its bias off 0.3 rad
    window = Window(1, 0, NS // 2, "normal", dt, np.zeros((50, 3)), gyro)
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.array([0.0, 0.0, 0.2]))
    builder = ImuBuilder(DEVICE_CLASSES["mems"], 9.81)
    causal = PassState(phase=Phase.CAUSAL)
    found = builder.turning(window, bias, causal).scale("gyro") * DEVICE_CLASSES["mems"].gyro_noise_density
    own = DEVICE_CLASSES["mems"].gyro_noise_density
    assert found**2 * 0.5 == pytest.approx(own**2 * 0.5 + (0.005 * 0.3) ** 2)
    assert builder.turning(window, bias, PassState()).scale("gyro") == 1.0  # batch finds its noise
    calibrated = ImuBuilder(DEVICE_CLASSES["mems"], 9.81, weight=20.0)
    assert calibrated.turning(window, bias, causal).scale("gyro") == 1.0
    back = Window(
        1, 0, NS // 2, "normal", dt, np.zeros((50, 3)), np.concatenate([gyro[:25], [0.0, 0.0, 0.4] - gyro[25:]])
    )
    assert builder.turning(back, bias, causal).scale("gyro") == pytest.approx(1.0)  # there and back again

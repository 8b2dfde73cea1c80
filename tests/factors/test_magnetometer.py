"""Magnetometer: the field it expects, its derivatives, the mean over a turn, what is disturbed and what is unknown."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numeric import assert_observation, random_rotations
from scipy.spatial.transform import Rotation

from smartnav_graph.core import frames
from smartnav_graph.core.errors import CalibrationError, ConfigError
from smartnav_graph.core.so3 import exp
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.factors.magnetometer import (
    LOSS_SCALE,
    MODEL,
    MagnetometerBuilder,
    MagnetometerConfig,
    SeenField,
    TurnedSamples,
    unearthly,
)
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.graph.states import State
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import MagnetometerNoise

STRENGTH = np.array([19.0, -45.0])  # uT, horizontal and up: middle Europe
DECLINATION = np.radians(4.6)
NAV_FIELD = np.array([STRENGTH[0] * np.sin(DECLINATION), STRENGTH[0] * np.cos(DECLINATION), STRENGTH[1]])
IRON = np.array([12.0, -30.0, 7.0])


def row(y, A=None, sigma=1.0, declination=DECLINATION) -> np.ndarray:
    A = np.eye(3) if A is None else A
    return np.concatenate([y, np.ravel(A), [np.sin(declination), np.cos(declination), sigma]])[None]


def residual(R, data, iron=IRON, strength=STRENGTH) -> np.ndarray:
    zero = np.zeros((1, 3))
    return SeenField().observe(R[None], zero, zero, [iron[None], strength[None]], data)[0][0]


def test_the_derivatives_are_the_numerical_ones():
    rng = np.random.default_rng(0)
    m = 20
    data = np.concatenate([row(rng.normal(0, 40, 3), rng.normal(0, 1, (3, 3)), rng.uniform(1, 5)) for _ in range(m)])
    extra = [rng.normal(0, 50, (m, 3)), rng.normal(0, 40, (m, 2))]
    p, v = rng.normal(size=(m, 3)), rng.normal(size=(m, 3))
    assert_observation(SeenField(), random_rotations(rng, m), p, v, extra, data)


def test_a_phone_that_points_north_reads_the_field_ahead_and_down():
    # heading 4.6 deg: the top edge points to magnetic north
    R = frames.nav_R_body_from_heading(4.6, [0.0, 0.0, 1.0])
    expected = np.array([0.0, 19.0, -45.0]) + IRON
    np.testing.assert_allclose(residual(R, row(expected)), 0.0, atol=1e-12)
    # turned east by a right angle, north is on the left (-x)
    east = frames.nav_R_body_from_heading(94.6, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(residual(east, row(np.array([-19.0, 0.0, -45.0]) + IRON)), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "wrong", "floor"),
    [
        ("declination sign", {"declination": -DECLINATION}, 2 * 19.0 * np.sin(DECLINATION) * 0.99),
        ("declination forgotten", {"declination": 0.0}, 19.0 * np.sin(DECLINATION) * 0.99),
        ("mount turned over", {"A": np.diag([1.0, -1.0, -1.0])}, 2 * 30.0),
    ],
)
def test_a_mistake_shows_in_uT(name, wrong, floor):
    R = random_rotations(np.random.default_rng(1), 1)[0]
    y = R.T @ NAV_FIELD + IRON
    assert np.linalg.norm(residual(R, row(y))) < 1e-12
    assert np.linalg.norm(residual(R, row(y, **wrong))) > floor


def test_north_east_down_and_gauss_show():
    R = random_rotations(np.random.default_rng(2), 1)[0]
    y = R.T @ NAV_FIELD + IRON
    ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    assert np.linalg.norm(residual(ned @ R, row(y))) > 20.0
    assert np.linalg.norm(residual(R, row(y / 100.0))) > 20.0


# --- the mean over a window -------------------------------------------------------------------------------------------


def turning(rate, seconds: float = 1.0, hertz: float = 100.0, bias=(0.0, 0.0, 0.0)) -> Window:
    n = round(seconds * hertz)
    gyro = np.tile(np.asarray(rate) + bias, (n, 1))
    return Window(1, 0, round(seconds * NS), "normal", np.full(n, 1 / hertz), np.zeros((n, 3)), gyro)


@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.5, -1.0, 1.5)])
def test_the_mean_over_a_turn_is_the_field_at_its_end(rate):
    bias = np.array([0.02, -0.05, 0.1])
    end = random_rotations(np.random.default_rng(3), 1)[0]
    t = np.arange(0.05, 1.001, 0.1)
    attitudes = end @ exp(np.outer(t - 1.0, rate))
    seen = attitudes.transpose(0, 2, 1) @ NAV_FIELD + IRON
    y, turn = TurnedSamples.of(turning(rate, bias=bias), ns_from_seconds(t), seen).mean(bias)
    np.testing.assert_allclose(y, end.T @ NAV_FIELD + turn @ IRON, atol=1e-9)
    assert np.linalg.norm(turn, 2) <= 1.0 + 1e-12


def test_a_full_turn_takes_the_hard_iron_out():
    t = np.arange(1, 101) / 100
    attitudes = exp(np.outer(t, [0.0, 0.0, 2 * np.pi]))
    seen = attitudes.transpose(0, 2, 1) @ NAV_FIELD + IRON
    _, turn = TurnedSamples.of(turning((0.0, 0.0, 2 * np.pi)), ns_from_seconds(t), seen).mean(np.zeros(3))
    np.testing.assert_allclose(turn, np.diag([0.0, 0.0, 1.0]), atol=1e-12)


# --- the builder ------------------------------------------------------------------------------------------------------


def builder(**changes) -> MagnetometerBuilder:
    t_ns = ns_from_seconds(np.arange(1, 101) / 10)
    values = {
        "t_ns": t_ns,
        "reading": np.tile(NAV_FIELD, (len(t_ns), 1)),
        "field_ut": STRENGTH,
        "field_sigma": np.full(2, 2.0),
        "declination": DECLINATION,
        "iron_sigma": 1.0,
        "noise": MagnetometerNoise(hard_iron_sigma_ut=1.0),
    }
    return MagnetometerBuilder(**{**values, **changes})


def step_of(made: MagnetometerBuilder, window: Window, pass_state: PassState | None = None) -> GraphUpdate:
    nav, bias = gtsam.NavState(), gtsam.imuBias.ConstantBias()
    update = GraphUpdate(window.index, window.t1_ns, window.t1_ns / NS, predicted=nav, bias=bias)
    made.add(update, window, State(window.index - 1, window.t0_ns, nav, bias), pass_state or PassState(stage=1))
    return update


def test_one_row_a_window_on_pose_iron_and_field():
    (block,) = step_of(builder(), turning((0.0, 0.0, 0.0))).blocks
    assert block.model is MODEL and block.sensor == "magnetometer" and block.rows == (9,) and block.used == (True,)
    assert [chr(gtsam.symbolChr(k)) for k in block.keys[0]] == list(MODEL.letters)
    states = [np.eye(4)[None], np.zeros((1, 3)), np.zeros((1, 3)), STRENGTH[None]]
    np.testing.assert_allclose(MODEL.linearize(states, block.data)[0], 0.0, atol=1e-12)


def test_nothing_where_the_turn_is_not_known_or_there_is_no_sample():
    window = turning((0.0, 0.0, 0.0))
    assert step_of(builder(), replace(window, kind="gap")).blocks == []
    late = builder(t_ns=ns_from_seconds(np.arange(20, 120) / 10))
    assert step_of(late, window).blocks == []


def test_rows_that_share_a_disturbance_share_its_information():
    noise = MagnetometerNoise(sigma_ut=1.0, disturbance_ut=3.0, disturbance_s=2.0)
    made = builder(noise=noise)
    assert made.sigma(1.0, 10) == pytest.approx(np.sqrt(0.1 + 9.0 * 4.0))
    assert made.sigma(8.0, 10) == pytest.approx(np.sqrt(0.1 + 9.0))  # two correlation times and more: independent
    quarter, whole = made.sigma(0.25, 25), made.sigma(1.0, 25)
    assert quarter**2 / 4 == pytest.approx(whole**2, rel=0.01)  # four rows of a quarter tell what one row does


def test_the_loss_acts_on_what_a_row_is_off_by_itself():
    shared = MagnetometerNoise(sigma_ut=0.1, disturbance_ut=3.0, disturbance_s=2.0, hard_iron_sigma_ut=1.0)
    for noise, factor in ((shared, 2.0), (replace(shared, disturbance_ut=0.0), 1.0)):
        (block,) = step_of(builder(noise=noise), turning((0.0, 0.0, 0.0))).blocks
        assert block.loss == "cauchy" and block.loss_scale == pytest.approx(LOSS_SCALE / factor)
    # of the row's own 3 uT, not of the 6 uT that four rows with one disturbance have
    assert builder(noise=shared).sigma(1.0, 10) * LOSS_SCALE / 2.0 == pytest.approx(3.0 * LOSS_SCALE, rel=0.01)


@pytest.mark.parametrize(
    ("field_ut", "used"),
    [
        (NAV_FIELD, True),
        (Rotation.from_euler("z", 120, degrees=True).apply(NAV_FIELD), True),  # heading is no criterion
        (NAV_FIELD * 2.0, False),  # intensity
        (np.array([0.0, 45.0, -19.0]), False),  # dip
    ],
)
def test_intensity_and_dip_tell_a_disturbance(field_ut, used):
    noise = MagnetometerNoise(hard_iron_sigma_ut=1.0, disturbance_ut=1.0)
    (block,) = step_of(builder(reading=np.tile(field_ut, (100, 1)), noise=noise), turning((0.0, 0.0, 0.0))).blocks
    assert block.used == (used,)


@pytest.mark.parametrize(("sigma", "used"), [(1.0, True), (15.0, False)])
def test_a_held_hard_iron_is_used_only_where_it_was_calibrated(sigma, used):
    made = builder(iron_sigma=sigma)
    pass_state = PassState(stage=1, fixed_states={"magnetometer_hard_iron_ut": np.zeros(3)})
    (block,) = step_of(made, turning((0.0, 0.0, 0.0)), pass_state).blocks
    assert block.used == (used,)


def test_first_seconds_make_a_held_hard_iron_usable_and_leave_its_prior_as_wide_as_it_was():
    made = builder(iron_sigma=240.0, held_in_replay=True, reading=np.tile(NAV_FIELD + IRON, (100, 1)))
    causal = PassState(stage=1, phase=Phase.CAUSAL)
    assert step_of(made, turning((0.0, 0.0, 0.0)), causal).blocks[0].used == (False,)
    aligned = replace(causal, aligned_states={"magnetometer_hard_iron_ut": (IRON, 2.0)})
    (block,) = step_of(made, turning((0.0, 0.0, 0.0)), aligned).blocks
    assert block.used == (True,)
    iron, sigma = made.iron_at_start(aligned)
    np.testing.assert_array_equal(iron.initial, IRON)
    assert (iron.sigma == 240.0).all() and sigma == 2.0


def test_soft_iron_and_hard_iron_of_the_calibration_are_taken_out():
    soft = np.array([[1.1, 0.02, 0.0], [0.02, 0.9, 0.01], [0.0, 0.01, 1.05]])
    noise = MagnetometerNoise(hard_iron_ut=tuple(IRON), soft_iron=tuple(soft.ravel()), hard_iron_sigma_ut=1.0)
    reading = np.tile(np.linalg.solve(soft, NAV_FIELD) + IRON, (100, 1))
    made = builder(reading=reading, noise=noise)
    (block,) = step_of(made, turning((0.0, 0.0, 0.0))).blocks
    states = [np.eye(4)[None], np.zeros((1, 3)), made.iron.initial[None], STRENGTH[None]]
    np.testing.assert_allclose(MODEL.linearize(states, block.data)[0], 0.0, atol=1e-12)
    assert block.used == (True,)


def test_readings_stronger_than_any_field_on_earth_hold_that_much_iron():
    assert unearthly(np.tile(NAV_FIELD, (10, 1))) == 0.0
    assert unearthly(np.tile([100.0, 289.0, 72.0], (10, 1))) == pytest.approx(244.2, abs=0.1)
    assert unearthly(np.tile([1.0, 2.0, 2.0], (10, 1))) == pytest.approx(17.0)


@pytest.mark.parametrize("changes", [{"loss": "tukey"}, {"gate_sigmas": 0.0}])
def test_wrong_options_are_named(changes):
    with pytest.raises(ConfigError, match=r"^config \[magnetometer\]: "):
        MagnetometerConfig(**changes)


@pytest.mark.parametrize("changes", [{"sigma_ut": 0.0}, {"disturbance_ut": -1.0}, {"soft_iron": (1.0,) * 8}])
def test_wrong_calibrations_are_refused(changes):
    with pytest.raises(CalibrationError, match=r"^calibration.toml: .* = .*; expected (>|9 finite)"):
        MagnetometerNoise(**changes)

"""Barometer: the standard atmosphere, derivatives, the mean around a keyframe, the pressure reference, doors."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from numeric import assert_observation, random_rotations
from sessions import positions

import smartnav_graph as sn
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors.barometer import (
    BarometerBuilder,
    BarometerConfig,
    Height,
    icao_height,
    metres_a_hpa,
    scatter_hpa,
)
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import BarometerNoise
from smartnav_graph.session.streams import Barometer


def test_the_standard_atmosphere():
    # ICAO Doc 7488, table I: geopotential height m and pressure hPa
    table = np.array([[-500.0, 1074.78], [0.0, 1013.25], [1000.0, 898.746], [5000.0, 540.199]])
    np.testing.assert_allclose(icao_height(table[:, 1]), table[:, 0], atol=0.5)
    assert icao_height(1000.0, 1000.0) == 0.0
    step = (icao_height(900.5) - icao_height(899.5)).item()
    assert metres_a_hpa(900.0) == pytest.approx(-step, rel=1e-5)
    assert metres_a_hpa(1013.25) == pytest.approx(8434.5 / 1013.25, rel=1e-3)  # scale height of 288.15 K


def test_the_derivatives_are_the_numerical_ones():
    rng = np.random.default_rng(0)
    m = 10
    data = np.stack([rng.normal(0, 100, m), rng.normal(0, 0.3, m), rng.uniform(0.05, 1, m)], axis=-1)
    p, v = rng.normal(size=(m, 3)), rng.normal(size=(m, 3))
    assert_observation(Height(), random_rotations(rng, m), p, v, [rng.normal(0, 50, (m, 1))], data)


def test_a_rise_of_a_metre_is_a_metre_of_height():
    zero, p = np.zeros((1, 3)), np.array([[5.0, 7.0, 3.0]])
    data = np.array([[1.0, 0.0, 0.5]])
    residual = Height().observe(np.eye(3)[None], p, zero, [np.array([[-2.0]])], data)[0]
    np.testing.assert_allclose(residual, 0.0, atol=1e-12)
    # samples that stand 0.2 s later than the keyframe of a lift that rises by 2 m/s
    lifted = Height().observe(
        np.eye(3)[None], p, np.array([[0.0, 0.0, 2.0]]), [np.zeros((1, 1))], data + np.array([0, 0.2, 0])
    )
    np.testing.assert_allclose(lifted[0], (3.0 + 0.4 - 1.0) / 0.5, atol=1e-12)


# --- the builder ------------------------------------------------------------------------------------------------------


def builder(t_ns, height, **changes) -> BarometerBuilder:
    values = {"scale": 8.4, "bias_sigma": 1000.0, "noise": BarometerNoise(), "loss": "none"}
    return BarometerBuilder(t_ns, np.asarray(height, dtype=np.float64), **{**values, **changes})


def window(start: float, end: float, index: int = 1) -> Window:
    empty = np.zeros((0, 3))
    kind = "normal" if end > start else "first"
    return Window(index, round(start * NS), round(end * NS), kind, np.zeros(0), empty, empty)


def step_of(made: BarometerBuilder, at: Window, height: float = 0.0) -> GraphUpdate:
    nav = gtsam.NavState(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, height])), np.zeros(3))
    bias = gtsam.imuBias.ConstantBias()
    update = GraphUpdate(at.index, at.t1_ns, at.t1_ns / NS, predicted=nav, bias=bias)
    previous = None if at.kind == "first" else State(at.index - 1, at.t0_ns, nav, bias)
    made.add(update, at, previous, PassState())
    return update


T_NS = ns_from_seconds(np.arange(0, 100) / 10)


def test_samples_around_a_keyframe_are_taken_once():
    made = builder(T_NS, np.arange(100.0))
    used = []
    for k in range(1, 9):
        (block,) = step_of(made, window(k - 1.0, k * 1.0, k)).blocks
        height, later, sigma = block.data[0]
        used.append(height)
        assert height == pytest.approx(10 * (k + later))  # a metre a sample: the mean stands where it says
        assert sigma == pytest.approx(8.4 * 0.03 / np.sqrt(10))
    np.testing.assert_allclose(np.diff(used), 10.0)


def test_short_windows_share_no_sample_and_far_samples_are_not_used():
    made = builder(T_NS, np.zeros(100))
    counts = [round((8.4 * 0.03 / s.blocks[0].data[0, 2]) ** 2) for s in (step_of(made, window(1.0, 1.2)),)]
    assert counts == [2]
    assert step_of(made, window(10.0, 11.0)).blocks == []
    assert len(step_of(made, window(10.0, 11.0)).factors) == 1  # the bias goes on


def test_the_bias_starts_where_the_first_height_says_and_is_tied_to_the_one_before():
    made = builder(T_NS, np.full(100, 2.0))
    first = step_of(made, window(0.0, 0.0, 0), height=-130.0)
    second = step_of(made, window(0.0, 1.0, 1))
    assert first.chain[key("D", 0)] == 132.0 == second.chain[key("D", 1)]
    (_, prior), (tag, tie) = *first.factors, *second.factors
    assert tag.sensor == "barometer_bias" and list(tie.keys()) == [key("D", 0), key("D", 1)]
    assert tie.noiseModel().sigma() == pytest.approx(8.4 * 0.003)  # m after a second
    assert prior.noiseModel().sigma() == 1000.0


def test_nothing_that_a_keyframe_uses_comes_later_than_half_a_second():
    heights = np.random.default_rng(0).normal(size=100)
    for end in (2.0, 3.3):
        known = round((end + 0.5) * NS) >= T_NS
        whole, part = (
            step_of(builder(t, h), window(end - 1.0, end)).blocks[0].data
            for t, h in ((T_NS, heights), (T_NS[known], heights[known]))
        )
        np.testing.assert_array_equal(whole, part)


# --- in a session -----------------------------------------------------------------------------------------------------


def height_error(session, solution) -> float:
    off = solution.nav_t_body[:, 2] - positions(session, solution.t_ns)[:, 2]
    return float(np.sqrt((off**2).mean()))


@pytest.fixture(scope="module")
def walk():
    return sn.simulate("walk-60s", 3).replace(magnetometer=None)


def test_it_holds_the_height_that_fixes_only_scatter_about(walk):
    without, with_it = (height_error(walk, sn.smooth(walk, sensors=chosen)) for chosen in (("-barometer",), ()))
    assert with_it < 0.7 * without or with_it < 0.5  # m; the fixes scatter by 4.5 m


def test_a_door_that_slams_moves_nothing(walk):
    plain = sn.smooth(walk)
    pressure = np.array(walk.barometer.pressure_hpa)
    gust = (walk.seconds(walk.barometer.t_ns) > 30.0) & (walk.seconds(walk.barometer.t_ns) < 30.6)
    pressure[gust] -= 2.0  # 17 m
    slammed = sn.smooth(walk.replace(barometer=replace(walk.barometer, pressure_hpa=pressure)))
    assert np.abs(slammed.nav_t_body[:, 2] - plain.nav_t_body[:, 2]).max() < 0.5


def test_a_pressure_reference_gives_absolute_height(walk):
    """At 100 m the standard atmosphere of a day with 1020.5 hPa at sea level."""
    at_sea = 1020.5
    shift = walk.barometer.pressure_hpa * at_sea / 1013.25
    offset = float(np.mean(icao_height(shift, at_sea) - 100.0 - positions(walk, walk.barometer.t_ns)[:, 2]))
    exact = walk.replace(barometer=replace(walk.barometer, pressure_hpa=shift))
    options = BarometerConfig(reference_hpa=at_sea, reference_sigma=0.01)
    solution = sn.smooth(exact, replace(Config(), barometer=options))
    off = solution.nav_t_body[:, 2] - positions(walk, solution.t_ns)[:, 2]
    assert off.mean() == pytest.approx(offset, abs=0.2)  # a sensor 1 hPa off is 8 m off, and believed


def test_wrong_options_and_a_reference_without_an_origin():
    with pytest.raises(ConfigError, match=r"config \[barometer\]: loss = 'tukey'; expected huber or none"):
        BarometerConfig(loss="tukey")
    with pytest.raises(ConfigError, match=r"reference_hpa = 101325\.0; expected 850 to 1100 hPa"):
        BarometerConfig(reference_hpa=101325.0)
    with pytest.raises(ConfigError, match="reference_sigma"):
        BarometerConfig(reference_sigma=0.0)
    session = sn.simulate("walk-60s", 0)
    local = session.replace(
        origin=None,
        gnss=replace(session.gnss, lla=None, enu=session.nav_position(session.gnss)),
    )
    with pytest.raises(ConfigError, match=r"reference_hpa = 1013\.25 in a session without origin"):
        sn.smooth(local, replace(Config(), barometer=BarometerConfig(reference_hpa=1013.25)))


def test_the_bias_walks_with_the_root_of_the_time():
    sigmas = []
    for length in (0.25, 1.0, 4.0):
        update = step_of(builder(T_NS, np.zeros(100)), window(1.0, 1.0 + length))
        (walk,) = (factor for tag, factor in update.factors if tag.sensor == "barometer_bias")
        sigmas.append(walk.noiseModel().sigmas()[0])
    assert sigmas == pytest.approx([0.5 * 8.4 * 0.003, 8.4 * 0.003, 2.0 * 8.4 * 0.003])


def test_means_show_their_own_noise_while_a_lift_goes_up_and_a_door_slams():
    """Draughts that last for seconds, 0.1 hPa: means over a second vary by nearly as much."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 120.0, 0.02)
    pressure = 1000.0 - 0.12 * 2.0 * t + rng.normal(0.0, 0.03, len(t))  # 2 m/s
    pressure[1000:1010] += 2.0
    draughts = np.repeat(rng.normal(0.0, 0.1, 120), 50)
    quiet, shaken = (Barometer(t_ns=ns_from_seconds(t), pressure_hpa=p) for p in (pressure, pressure + draughts))
    assert scatter_hpa(quiet, BarometerNoise()) == 0.0
    assert scatter_hpa(shaken, BarometerNoise()) == pytest.approx(0.1, rel=0.25)  # hPa, of 118 means
    assert scatter_hpa(shaken.take(slice(0, 500)), BarometerNoise()) == 0.0  # ten seconds


def test_no_mean_is_better_than_means_are_alike():
    built = BarometerBuilder(np.zeros(0), np.zeros(0), 8.3, 1.0, BarometerNoise(), "none", least_sigma=0.5)
    built = replace(built, t_ns=np.arange(0, 100) * NS // 50, height=np.zeros(100))
    window = SimpleNamespace(t1_ns=NS, length_s=1.0)
    assert built._around(window)[2] == 0.5  # m
    assert replace(built, least_sigma=0.0)._around(window)[2] == pytest.approx(8.3 * 0.03 / np.sqrt(50), rel=0.02)

"""Gravity-attitude: what it expects, when it speaks, how its sigma grows with the motion."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from exact import GRAVITY, START_NS, record
from numeric import assert_observation, random_rotations

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import exp
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors import FactorContext, gravity
from smartnav_graph.factors.gravity import GravityBuilder, GravityConfig, Stretch, Upright
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.detect.standstills import Standstills
from smartnav_graph.session.session import Device

REST = np.array([0.0, 0.0, GRAVITY])


def test_the_derivatives_are_the_numerical_ones():
    rng = np.random.default_rng(0)
    m = 20
    data = np.concatenate([rng.normal(0, 10, (m, 3)), rng.uniform(0.1, 2.0, (m, 1))], axis=1)
    states = random_rotations(rng, m), rng.normal(size=(m, 3)), rng.normal(size=(m, 3))
    assert_observation(Upright(), *states, [rng.normal(0, 0.3, (m, 6))], data)


def test_a_force_along_up_is_no_residual_and_a_lean_is_gravity_times_its_sine():
    rng = np.random.default_rng(1)
    R = random_rotations(rng, 1)
    bias = np.array([[0.2, -0.1, 0.3, 0, 0, 0]])
    zero = np.zeros((1, 3))

    def residual(attitude, force) -> np.ndarray:
        return Upright().observe(attitude, zero, zero, [bias], np.append(force + bias[0, :3], 0.5)[None])[0][0]

    np.testing.assert_allclose(residual(R, R[0].T @ REST), 0.0, atol=1e-12)
    leaning = exp(np.array([[0.1, 0.0, 0.0]])) @ R  # about east: up leans to the south
    np.testing.assert_allclose(residual(leaning, R[0].T @ REST), [0.0, -GRAVITY * np.sin(0.1) / 0.5], atol=1e-12)


# --- stretches --------------------------------------------------------------------------------------------------------


def windows(seconds: int, force=REST, rate=(0.0, 0.0, 0.0), hertz: int = 50, begin: int = 0) -> list[Window]:
    """One window a second; `force` (3,) at the end of each stretch is seen from the body as it turns."""
    n, empty = hertz, np.zeros((0, 3))
    made = [Window(0, begin, begin, "first", np.zeros(0), empty, empty)]
    for k in range(seconds):
        t0 = begin + k * NS
        t = k + np.arange(n) / n
        accel = np.einsum("nji,j->ni", exp(np.outer(t, rate)), force)
        made.append(Window(k + 1, t0, t0 + NS, "normal", np.full(n, 1 / n), accel, np.tile(rate, (n, 1))))
    return made


def steps_of(builder: GravityBuilder, stretch: list[Window]) -> list[GraphUpdate]:
    nav, bias = gtsam.NavState(), gtsam.imuBias.ConstantBias()
    steps = []
    for window in stretch:
        update = GraphUpdate(window.index, window.t1_ns, window.t1_ns / NS, predicted=nav, bias=bias)
        builder.add(update, window, State(window.index, window.t0_ns, nav, bias), PassState())
        steps.append(update)
    return steps


def rows_of(steps: list[GraphUpdate]) -> list[int]:
    return [step.index for step in steps if step.blocks]


@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.0), (0.3, -0.5, 1.0)])
def test_the_mean_is_seen_from_the_end_of_the_stretch(rate):
    (step,) = [s for s in steps_of(GravityBuilder(GRAVITY), windows(4, rate=rate)) if s.blocks]
    end = exp(np.array([np.multiply(rate, 4.0)]))[0]
    np.testing.assert_allclose(step.blocks[0].data[0, :3], end.T @ REST, atol=1e-9)


def test_one_row_a_stretch_and_a_pace_beside_it():
    steps = steps_of(GravityBuilder(GRAVITY), windows(10))
    assert rows_of(steps) == [4, 8]
    assert [tag.sensor for step in steps for tag, _ in step.factors] == ["pace", "pace"]


def test_a_gap_begins_a_new_stretch():
    made = windows(10)
    made[3] = replace(made[3], kind="gap")
    assert rows_of(steps_of(GravityBuilder(GRAVITY), made)) == [7]


def test_a_second_pass_gives_the_same():
    builder, made = GravityBuilder(GRAVITY), windows(10, rate=(0.3, -0.5, 1.0))
    first, second = (steps_of(builder, made) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert len(one.blocks) == len(other.blocks)
        for a, b in zip(one.blocks, other.blocks, strict=True):
            np.testing.assert_array_equal(a.data, b.data)


def test_it_speaks_a_minute_after_what_holds_tilt():
    held = np.array([10 * NS])
    assert rows_of(steps_of(GravityBuilder(GRAVITY, held), windows(80))) == [71, 75, 79]
    assert rows_of(steps_of(GravityBuilder(GRAVITY, held, GravityConfig("on")), windows(8))) == [4, 8]
    assert (
        rows_of(steps_of(GravityBuilder(GRAVITY, held + 79 * NS), windows(80)))[0] == 61
    )  # what comes later is unseen


# --- sigma ------------------------------------------------------------------------------------------------------------


def test_the_sigma_grows_with_the_motion():
    builder = GravityBuilder(9.81)
    rest = builder.sigma(np.array([0, 0, 9.81]), 0.03, 4.0)
    walking = builder.sigma(np.array([0, 0, 9.81]), 2.0, 4.0)
    braking = builder.sigma(np.array([0, 3.0, 9.81]), 0.3, 4.0)
    assert rest == pytest.approx(0.05, rel=0.01)
    # turning round at 1.4 m/s within 4 s, and a tenth of the steps
    assert walking == pytest.approx(np.hypot(np.hypot(0.2, 0.05), 1.4 * np.sqrt(2) / 4), rel=1e-6)
    assert braking > 2.0  # sqrt(9.81^2 + 3^2) is 0.45 m/s^2 too long
    assert builder.sigma(np.array([0, 0, 9.81]), 2.0, 8.0) < walking


def test_the_scatter_is_that_of_the_size_of_the_force():
    stretch = Stretch()
    for window in windows(4)[1:]:
        t = np.arange(50) / 50
        stretch.add(replace(window, accel=REST * (1 + 0.2 * np.sin(2 * np.pi * 2 * t))[:, None]), np.zeros(3))
    assert stretch.scatter == pytest.approx(0.2 * GRAVITY / np.sqrt(2), rel=1e-6)
    assert stretch.length_s == pytest.approx(4.0)


# --- who has it -------------------------------------------------------------------------------------------------------


def context(vehicle: str = "none", enabled: str = "auto", rests: Standstills | None = None, **streams) -> FactorContext:
    session = record().session.replace(device=Device(vehicle=vehicle), **({"gnss": None, "control": None} | streams))
    config = Config(gravity=GravityConfig(enabled))
    return FactorContext(session, Calibration(), [], vehicle, config, rests)


def test_only_who_is_carried_on_foot_is_a_walker():
    assert all(gravity.build(context(vehicle)) is None for vehicle in ("none", "car", "trolley"))
    assert gravity.build(context("car", "on")) is not None
    assert gravity.build(context("foot")) is not None and gravity.build(context("foot", "off")) is None


def test_fixes_and_rests_hold_tilt():
    assert len(gravity.build(context("foot")).held_ns) == 0
    session = record().session
    made = gravity.build(context("foot", gnss=session.gnss))
    np.testing.assert_array_equal(made.held_ns, session.gnss.t_ns)
    t = START_NS + np.arange(100) * NS // 10
    still = np.where((np.arange(100) >= 20) & (np.arange(100) < 40), 0.001, np.nan)
    made = gravity.build(context("foot", rests=Standstills(t, still, still)))
    np.testing.assert_array_equal(made.held_ns, t[[20, 39]])


@pytest.mark.parametrize("changes", [{"enabled": "yes"}, {"stretch_s": 0.0}, {"speed": -1.0}])
def test_wrong_options_are_named(changes):
    with pytest.raises(ConfigError, match=r"^config \[gravity\]: "):
        GravityConfig(**changes)

"""Zero velocity, no turn, one level: at the truth they are silent, and each holds what it is for."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from exact import assert_derivative
from numeric import assert_observation, random_rotations

from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.standstill import ANYWHERE, TAIL, Level, StandstillBuilder, build
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.detect.standstills import StandstillConfig, Standstills, find_standstills
from smartnav_graph.simulation.scenarios import simulate

T_NS = np.arange(0, 5 * NS, NS // 100)
STILL = (T_NS >= NS) & (T_NS <= 3 * NS)


def rests(on_foot=False):
    """At rest from 1 to 3 s, within 0.02 m/s and 1e-3 rad."""
    return Standstills(T_NS, np.where(STILL, 0.02, np.nan), np.where(STILL, 1e-3, np.nan), on_foot)


def at(seconds, index=0, height=0.0, speed=0.0):
    nav = gtsam.NavState(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, height])), np.full(3, speed))
    return State(index, round(seconds * NS), nav, gtsam.imuBias.ConstantBias())


def step_of(builder, start, end, kind="normal", height=0.0, index=1):
    window = Window(index, round(start * NS), round(end * NS), kind, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    update = GraphUpdate(index, window.t1_ns, end)
    update.predicted = at(end, index, height).nav
    builder.add(update, window, None if kind == "first" else at(start, index - 1), PassState())
    return update


@pytest.mark.parametrize(
    ("start", "end", "kind", "sensors"),
    [
        (0.0, 0.5, "normal", []),
        (0.0, 1.0, "normal", ["static"]),  # the rest begins at the keyframe
        (1.0, 2.0, "static", ["static", "static_turn"]),
        (1.0, 2.0, "gap", ["static"]),  # who knows what the gap hides
        (2.0, 4.0, "normal", []),
        (2.0, 2.0, "first", ["static"]),
    ],
)
def test_what_is_added_where(start, end, kind, sensors):
    update = step_of(StandstillBuilder(rests()), start, end, kind)
    assert [tag.sensor for tag, _ in update.factors] == sensors and not update.blocks


@pytest.mark.parametrize(("option", "left"), [("zupt", ["static_turn"]), ("zaru", ["static"])])
def test_each_can_be_left_out(option, left):
    update = step_of(StandstillBuilder(rests(), StandstillConfig(**{option: False})), 1.0, 2.0)
    assert [tag.sensor for tag, _ in update.factors] == left


def values(speed=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), height=0.0):
    """Keyframe 0 at an odd attitude, keyframe 1 turned by `turn` on the body side, `height` above it."""
    out, before = gtsam.Values(), gtsam.Rot3.RzRyRx(0.3, -0.7, 2.0)
    out.insert(key("X", 0), gtsam.Pose3(before, np.array([3.0, -4.0, 0.0])))
    out.insert(key("X", 1), gtsam.Pose3(before * gtsam.Rot3.Expmap(np.array(turn)), np.array([3.0, -4.0, height])))
    out.insert(key("V", 1), np.array(speed))
    return out


def test_residuals_in_sigmas():
    factors = {tag.sensor: f for tag, f in step_of(StandstillBuilder(rests()), 1.0, 2.0).factors}

    def white(sensor, **changes):
        return factors[sensor].noiseModel().noise().whiten(factors[sensor].unwhitenedError(values(**changes)))

    assert white("static") == pytest.approx(np.zeros(3)) and white("static_turn") == pytest.approx(np.zeros(6))
    assert white("static", speed=(0.02, 0.0, -0.04)) == pytest.approx([1, 0, -2])
    assert np.abs(white("static_turn", turn=(0.0, 2e-3, 0.0))[:3]) == pytest.approx([0, 2, 0])
    assert np.linalg.norm(white("static_turn", height=1.0)) == pytest.approx(1.0 / ANYWHERE)


def test_derivatives():
    for _, factor in step_of(StandstillBuilder(rests()), 1.0, 2.0).factors:
        assert_derivative(factor, values(speed=(1e-4, 2e-4, 0.0), turn=(1e-5, 2e-5, 0.0)))
    rng = np.random.default_rng(0)
    R, p, v = random_rotations(rng, 5), rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    assert_observation(Level(), R, p, v, [rng.normal(size=(5, 1))], np.full((5, 1), 0.02))


def test_a_false_rest_lets_go():
    (_, factor), *_ = step_of(StandstillBuilder(rests()), 1.0, 2.0).factors
    cost = factor.error(values(speed=(20.0, 0.0, 0.0)))
    assert factor.error(values(speed=(22.0, 0.0, 0.0))) - cost < 1.0  # hardly a force at 20 m/s
    near = factor.error(values(speed=(0.05, 0.0, 0.0)))
    assert near == pytest.approx(0.5 * (0.05 / 0.02) ** 2, rel=0.05)  # and all of it at 0.05 m/s


def test_a_speed_that_is_merely_unknown_does_not_let_go():
    # after a minute of dead reckoning the speed is known to 2 m/s: 3 m/s is no contradiction of a rest
    window = Window(1, NS, 2 * NS, "static", np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    covariance = np.zeros((15, 15))
    covariance[6:9, 6:9] = np.eye(3) * 2.0**2 / 3.0
    errors = []
    for previous in (at(1.0), replace(at(1.0), covariance=covariance)):
        update = GraphUpdate(1, window.t1_ns, 2.0)
        StandstillBuilder(rests()).add(update, window, previous, PassState())
        ((_, factor), *_) = update.factors
        errors.append(factor.error(values(speed=(3.0, 0.0, 0.0))))
    least_squares = 0.5 * (3.0 / 0.02) ** 2
    assert errors[0] < 0.02 * least_squares  # a speed that is known contradicts, and lets go
    assert errors[1] > 0.8 * least_squares


def test_a_false_stance_pulls_with_constant_force_only():
    (_, factor), *_ = step_of(StandstillBuilder(rests(on_foot=True)), 1.0, 2.0).factors
    costs = [factor.error(values(speed=(v, 0.0, 0.0))) for v in (10.0, 20.0, 30.0)]
    assert costs[2] - costs[1] == pytest.approx(costs[1] - costs[0], rel=1e-3)
    assert costs[1] - costs[0] == pytest.approx(TAIL * 10.0 / 0.02, rel=1e-3)


def test_all_stances_of_a_foot_are_on_one_floor():
    two = rests(on_foot=True)
    two.speed_sigma[(T_NS > 1.7 * NS) & (T_NS < 2.0 * NS)] = np.nan  # in the air
    builder = StandstillBuilder(two, StandstillConfig(flat_floor=True))
    first, second = step_of(builder, 1.0, 1.5, height=2.0), step_of(builder, 1.5, 2.0, height=2.5, index=2)
    (floor,) = first.session.values()
    assert floor.name == "floor_height_m" and floor.initial.tolist() == [2.0]
    assert second.session == first.session  # one state, one prior
    assert not step_of(builder, 2.0, 2.5, index=3).blocks  # the same stance: its floor is not measured anew
    (block,) = second.blocks
    residual, _ = block.model.linearize(
        [
            np.eye(4)[None] + 2.03 * np.eye(4)[2:3].T @ np.eye(4)[3:4],
            np.zeros((1, 3)),
            np.array([[2.0]]),
        ],
        block.data,
    )
    assert residual == pytest.approx(1.5)  # 3 cm of 2 cm
    assert not step_of(StandstillBuilder(rests(), StandstillConfig(flat_floor=True)), 1.0, 2.0).blocks  # no foot


def context(**options):
    session = simulate("static-60s", 0)
    config = Config(standstill=StandstillConfig(**options))
    noise = session.calibration.imu_noise
    found = find_standstills(session.imu, session.static, (), "none", noise, session.gravity, config.standstill)
    return FactorContext(session, Calibration(), (), "none", config, found)


def test_a_builder_only_where_something_stands_still():
    assert isinstance(build(context()), StandstillBuilder)
    assert build(context(detect=False, use_listed=False)) is None
    assert build(replace(context(), rests=None)) is None

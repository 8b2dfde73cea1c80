"""Step factor: yaw of a tilted device, derivatives, turns within a window, where it is used and where not."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from differences import wrap_deg
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core import frames
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors import pedestrian as step_factor
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.pedestrian import StepBuilder, StepConfig, Stride, level_yaw, stride_model
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.graph.states import State
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import Calibration, StepNoise
from smartnav_graph.session.detect.steps import Steps
from smartnav_graph.session.streams import ControlPoint
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.scenarios import Scenario

PHONE = frames.body_R_vehicle("+y", "+z")


@pytest.mark.parametrize("pitch", [-60.0, 0.0, 35.0, 90.0, 120.0])
@pytest.mark.parametrize("heading", [0.0, 100.0, 200.0, 359.0])
def test_yaw_of_a_device_that_is_only_pitched_is_its_heading(heading, pitch):
    """Also upright (pitch 90 deg), where the forward axis has no direction of its own."""
    level = frames.nav_R_body_from_heading(heading, [0.0, 0.0, 1.0])
    tilted = level @ Rotation.from_euler("x", pitch, degrees=True).as_matrix()
    yaw = np.degrees(level_yaw((tilted @ PHONE)[None]))[0]
    assert wrap_deg(90.0 - heading - yaw) == pytest.approx(0.0, abs=1e-9)


def states(rng, m: int) -> list[np.ndarray]:
    """Poses tilted by up to 80 deg, metres apart, and factors."""
    tilt = Rotation.from_rotvec(np.column_stack([rng.uniform(-1, 1, (m, 2)), np.zeros(m)]))
    turn = Rotation.from_rotvec(np.column_stack([np.zeros((m, 2)), rng.uniform(-3, 3, m)]))
    start, end = np.tile(np.eye(4), (m, 1, 1)), np.tile(np.eye(4), (m, 1, 1))
    start[:, :3, :3] = (turn * tilt).as_matrix()
    end[:, :3, :3] = (turn * tilt * Rotation.from_rotvec(0.3 * rng.normal(size=(m, 3)))).as_matrix()
    start[:, :3, 3], end[:, :3, 3] = rng.normal(size=(m, 3)), rng.normal(size=(m, 3))
    return [start, end, np.array([0.45, 0.05]) + 0.1 * rng.normal(size=(m, 2))]


@pytest.mark.parametrize("axes", [("+y", "+z"), ("+x", "-z")])
def test_the_derivatives_are_the_numerical_ones(axes):
    rng, model = np.random.default_rng(0), Stride(frames.body_R_vehicle(*axes))
    at = states(rng, 12)
    if axes[1] == "-z":  # the same attitudes of the vehicle
        for pose in at[:2]:
            pose[:, :3, :3] = pose[:, :3, :3] @ model.body_R_vehicle.T
    data = np.column_stack([rng.normal(3, 1, 12), rng.normal(0, 1, 12), rng.uniform(0.1, 0.5, 12)])
    _, found = model.linearize(at, data)

    def moved(slot: int, axis: int, size: float) -> np.ndarray:
        shifted = [x.copy() for x in at]
        if slot == 2:
            shifted[2][:, axis] += size
        elif axis < 3:
            shifted[slot][:, :3, :3] = at[slot][:, :3, :3] @ Rotation.from_rotvec(size * np.eye(3)[axis]).as_matrix()
        else:
            shifted[slot][:, :3, 3] += size * at[slot][:, :3, axis - 3]
        return model.linearize(shifted, data)[0]

    for slot, width in enumerate((6, 6, 2)):
        numeric = np.stack([(moved(slot, i, 1e-6) - moved(slot, i, -1e-6)) / 2e-6 for i in range(width)], axis=-1)
        np.testing.assert_allclose(found[slot], numeric, atol=1e-6 * np.abs(numeric).max())


# --- one window -------------------------------------------------------------------------------------------------------


def turning(rate_deg: float, seconds: float = 1.0, bias: float = 0.0, kind: str = "normal") -> Window:
    n = round(100 * seconds)
    gyro = np.zeros((n, 3))
    gyro[:, 2] = np.radians(rate_deg) + bias
    return Window(1, 10 * NS, 10 * NS + round(seconds * NS), kind, np.full(n, 0.01), np.zeros((n, 3)), gyro)


def builder(**changes) -> StepBuilder:
    second = np.arange(1, 31, dtype=np.int64) * NS
    values = {
        "steps": Steps(second - NS // 2, second, np.full(30, 16.0)),  # two units a step, walked in half a second
        "fixes_ns": np.zeros(0, np.int64),
        "model": stride_model("+y", "+z"),
        "noise": StepNoise(),
    }
    return StepBuilder(**{**values, **changes})


def add(
    made: StepBuilder, window: Window, R=None, bias: float = 0.0, pass_state: PassState | None = None
) -> GraphUpdate:
    nav = gtsam.NavState(gtsam.Pose3(gtsam.Rot3(np.eye(3) if R is None else R), np.zeros(3)), np.zeros(3))
    state = State(0, window.t0_ns, nav, gtsam.imuBias.ConstantBias(np.zeros(3), np.array([0.0, 0.0, bias])))
    update = GraphUpdate(1, window.t1_ns, 1.0)
    made.add(update, window, state, pass_state or PassState())
    return update


def test_the_length_follows_a_turn_within_the_window():
    """Straight for half a second while turning by 60 deg, then a step on a quarter circle's part."""
    straight = add(builder(), turning(0.0)).blocks[0].data[0]
    np.testing.assert_allclose(straight, [2.0, 0.0, 0.2], atol=1e-9)
    # evenly over 45 to 90 deg: mean of cos and sin
    quarter = add(builder(), turning(90.0, bias=0.1), bias=0.1).blocks[0].data[0]
    mean = [(1 - np.sqrt(0.5)) / (np.pi / 4), np.sqrt(0.5) / (np.pi / 4)]
    np.testing.assert_allclose(quarter[:2], 2.0 * np.array(mean), atol=1e-3)


def test_the_way_of_a_straight_walk_has_no_residual_and_its_mistakes_have():
    (block,) = add(builder(), turning(0.0)).blocks
    heading = frames.nav_R_body_from_heading(30.0, [0.0, 0.0, 1.0])
    start, end = np.eye(4), np.eye(4)
    start[:3, :3] = end[:3, :3] = heading
    end[:2, 3] = 0.9 * np.array([np.sin(np.radians(30)), np.cos(np.radians(30))])  # 0.45 m a unit

    def residual(factor) -> np.ndarray:
        return block.model.linearize([start[None], end[None], np.array([factor])], block.data)[0][0]

    np.testing.assert_allclose(residual([0.45, 0.0]), 0.0, atol=1e-9)
    np.testing.assert_allclose(residual([0.45, 0.1]), [0.0, -1.0], atol=1e-9)  # 0.2 m to the left, in 0.2 m
    assert np.linalg.norm(residual([-0.45, 0.0])) == pytest.approx(9.0)


def test_a_stand_is_a_row_of_no_length_and_no_row_stands_in_a_gap_or_upside_down():
    before = builder(steps=Steps(*(np.zeros(0, np.int64),) * 2, np.zeros(0)))
    assert add(before, turning(0.0)).blocks[0].data[0].tolist() == [0.0, 0.0, 0.2]
    assert add(builder(), turning(0.0, kind="gap")).blocks == []
    over = Rotation.from_euler("x", 170, degrees=True).as_matrix()
    assert add(builder(), turning(0.0), R=over).blocks == []
    assert len(add(builder(), turning(0.0), R=Rotation.from_euler("x", 100, degrees=True).as_matrix()).blocks) == 1


@pytest.mark.parametrize(
    ("fixes_s", "batch", "causal"),
    [
        ((), True, True),
        ((9.0, 10.0, 11.0, 12.0), False, False),  # good fixes each second
        ((4.0, 10.0, 16.0), True, True),
        ((9.0, 10.0, 16.0), True, False),  # a replay does not know yet that the next one is far
        ((9.0, 10.0, 14.0), False, False),
        ((4.0, 5.0), True, True),  # the fixes have stopped
    ],
)
def test_good_fixes_close_together_need_no_steps(fixes_s, batch, causal):
    made = builder(fixes_ns=(np.array(fixes_s) * NS).astype(np.int64))
    assert bool(add(made, turning(0.0)).blocks) == batch
    assert bool(add(made, turning(0.0), pass_state=PassState(phase=Phase.CAUSAL)).blocks) == causal


# --- who walks --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walk() -> sn.Session:
    return Scenario("walk", 40.0, motions.walk, "foot", "galaxy-s2")(1)


def build(session: sn.Session, vehicle: str, **options) -> StepBuilder | None:
    config = replace(Config(), steps=StepConfig(**options))
    return step_factor.build(FactorContext(session, Calibration(), (), vehicle, config))


def test_only_walkers_have_steps(walk):
    assert build(walk, "foot").note == ""
    assert "a walk (" in build(walk, "none").note and "--steps.enabled off" in build(walk, "none").note
    assert build(walk, "car") is None and build(walk, "foot", enabled="off") is None
    assert build(walk, "car", enabled="on") is not None
    still = Scenario("rest", 20.0, lambda s, rng: motions.static(s), "none", "galaxy-s2")(0)
    assert build(still, "none") is None


def test_only_good_fixes_carry_a_trajectory(walk):
    def points(sigma) -> sn.Session:
        t_ns, none = walk.imu.t_ns[[100, 200, 300]], np.zeros((3, 3))
        ids = np.array(["a", "b", "c"], dtype=object)
        return walk.replace(control=ControlPoint(t_ns=t_ns, enu=none, sigma=sigma, point_id=ids))

    assert len(build(points(None), "foot").fixes_ns) == 3  # surveyed
    assert len(build(points(np.full((3, 3), 0.7)), "foot").fixes_ns) == 0
    mixed = np.array([[0.1, 0.1, 9.0], [0.1, 0.5, 0.1], [np.nan, np.nan, np.nan]])
    assert build(points(mixed), "foot").fixes_ns.tolist() == walk.imu.t_ns[[100, 300]].tolist()


def test_wrong_options():
    with pytest.raises(ConfigError, match=r"config \[steps\]: enabled = 'maybe'; expected auto, on or off"):
        StepConfig(enabled="maybe")
    with pytest.raises(ConfigError, match=r"config \[steps\]: spacing_s = -1"):
        StepConfig(spacing_s=-1)

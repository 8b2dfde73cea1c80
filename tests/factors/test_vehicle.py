"""The wheeled vehicle's constraint: geometry worked by hand, derivatives, and what each state is for."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from numeric import assert_observation, random_rotations

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.frames import body_R_vehicle
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.factors.vehicle import MOUNT_SIZE, NonHolonomic, VehicleBuilder, VehicleConfig, recent
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import key, session_key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import VEHICLE_CLASSES
from smartnav_graph.session.detect.standstills import Standstills

PHONE = NonHolonomic(body_R_vehicle("+y", "+z"))
COMMA = NonHolonomic(body_R_vehicle("+x", "-z"))


def residual(model, R, v, mount=None, rate=(0.0, 0.0, 0.0), force=(0.0, 0.0, 9.81), sigma=(1.0, 1.0)):
    """Lateral and vertical m/s of one row; rate and force in declared vehicle axes."""
    mount = np.zeros((1, MOUNT_SIZE)) if mount is None else np.atleast_2d(mount)
    data = np.concatenate([rate, force, sigma])[None]
    return model.observe(np.asarray(R)[None], np.zeros((1, 3)), np.array([v], dtype=float), [mount], data)[0][0]


def mount(**values: float) -> np.ndarray:
    names = ("pitch", "yaw", "x", "y", "z", "h", "slip", "squat")
    return np.array([values.get(name, 0.0) for name in names])


@pytest.mark.parametrize(("model", "forward"), [(PHONE, (0.0, 1.0, 0.0)), (COMMA, (1.0, 0.0, 0.0))])
def test_riding_along_the_declared_forward_axis_is_free(model, forward):
    assert residual(model, np.eye(3), 13.0 * np.array(forward)) == pytest.approx([0.0, 0.0])


def test_a_slide_to_the_left_and_a_lift_are_seen_with_their_sign():
    # phone axes: forward is y, so left is -x
    assert residual(PHONE, np.eye(3), (-0.4, 5.0, 0.3)) == pytest.approx([0.4, 0.3])


def test_the_sigma_whitens_each_row():
    assert residual(PHONE, np.eye(3), (-0.4, 5.0, 0.3), sigma=(0.2, 0.1)) == pytest.approx([2.0, 3.0])


def test_a_mount_turned_to_the_left_and_pitched_takes_a_slant_ride_as_straight():
    yaw, pitch = 0.3, -0.2
    # the vehicle's own forward axis in declared axes (forward, left, up): Rz(yaw) Ry(pitch) e_x, pitch nose down
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    nav = 10.0 * np.array([-ahead[1], ahead[0], ahead[2]])  # phone axes: right, ahead, up
    assert residual(PHONE, np.eye(3), nav, mount(pitch=pitch, yaw=yaw)) == pytest.approx([0.0, 0.0], abs=1e-12)


def test_a_device_ahead_of_the_rear_axle_swings_out_in_a_left_turn():
    # 0.5 rad/s to the left, 1.2 m ahead of the axle: 0.6 m/s to the left, which the lever arm explains
    swing = (-0.6, 8.0, 0.0)
    assert residual(PHONE, np.eye(3), swing, rate=(0.0, 0.0, 0.5)) == pytest.approx([0.6, 0.0])
    assert residual(PHONE, np.eye(3), swing, mount(x=-1.2), rate=(0.0, 0.0, 0.5)) == pytest.approx([0.0, 0.0])


def test_a_device_above_the_road_sways_with_roll_and_one_behind_lifts_with_pitch():
    # right side down at 0.1 rad/s, 1 m above the road: 0.1 m/s to the right; the axle stands at z = -1
    assert residual(PHONE, np.eye(3), (0.1, 8.0, 0.0), mount(z=-1.0), rate=(0.1, 0.0, 0.0)) == pytest.approx([0, 0])
    # nose up is a negative turn about left: 1.4 m behind the point that keeps to the road goes down
    assert residual(PHONE, np.eye(3), (0.0, 8.0, -0.14), mount(h=1.4), rate=(0.0, -0.1, 0.0)) == pytest.approx([0, 0])


def test_tyres_slip_outwards_and_the_nose_rises_under_thrust():
    # force 3 m/s^2 to the left, 0.008 rad per m/s^2, 10 m/s: the axle moves 0.24 m/s to the right
    assert residual(PHONE, np.eye(3), (0.24, 10.0, 0.0), mount(slip=0.008), force=(0, 3, 9.8)) == pytest.approx([0, 0])
    # thrust 2 m/s^2 lifts the nose: the body's own up axis leans back, and the ride looks like one downwards
    assert residual(PHONE, np.eye(3), (0, 10.0, -0.1), mount(squat=0.005), force=(2, 0, 9.8)) == pytest.approx([0, 0])


@pytest.mark.parametrize("model", [PHONE, COMMA])
def test_derivatives(model):
    rng = np.random.default_rng(2)
    m = 7
    data = np.concatenate([rng.normal(0, 0.4, (m, 3)), rng.normal(0, 4, (m, 3)), rng.uniform(0.1, 0.3, (m, 2))], axis=1)
    state = rng.normal(0, 1, (m, MOUNT_SIZE)) * [0.5, 0.5, 1, 1, 1, 1, 0.02, 0.02]
    R, p, v = random_rotations(rng, m), rng.normal(0, 100, (m, 3)), rng.normal(0, 10, (m, 3))
    assert_observation(model, R, p, v, [state], data)
    strays = NonHolonomic(model.body_R_vehicle, in_gap=True)
    assert_observation(strays, R, p, v, [state, rng.normal(0, 0.3, (m, 6))], data)


def test_what_readings_stray_by_is_added_to_them():
    """As much rate and force in body axes as the same in the readings."""
    rng, state = np.random.default_rng(4), mount(x=-1.2, z=0.5, h=0.7, slip=0.01, squat=0.01, yaw=0.1)
    rate, force, strayed = rng.normal(0, 0.4, 3), rng.normal(0, 4, 3), rng.normal(0, 0.5, 6)
    axes, velocity = PHONE.body_R_vehicle, (-0.4, 9.0, 0.2)
    data = np.concatenate([rate, force, (1.0, 1.0)])[None]
    at = (np.eye(3)[None], np.zeros((1, 3)), np.array([velocity]))
    found = NonHolonomic(axes, in_gap=True).observe(*at, [state[None], strayed[None]], data)[0][0]
    raised = residual(PHONE, np.eye(3), velocity, state, rate + strayed[3:] @ axes, force + strayed[:3] @ axes)
    assert found == pytest.approx(raised)


# --- the builder ------------------------------------------------------------------------------------------------------

AXES = body_R_vehicle("+y", "+z")


def window(t0_s: float, t1_s: float) -> Window:
    """Inertial intervals of 10 ms: turning ever faster to the left, pushed ahead ever harder, 2 m/s^2 at the end."""
    n = round((t1_s - t0_s) * 100)
    gyro, accel = np.zeros((n, 3)), np.tile([0.0, 0.0, 9.8], (n, 1))
    gyro[:, 2] = np.arange(n) / 100
    accel[:, 1] = 2.0 * (np.arange(n) + 0.5) / n
    return Window(3, round(t0_s * NS), round(t1_s * NS), "normal", np.full(n, 0.01), accel, gyro)


def rows(builder: VehicleBuilder, at: Window, pass_state: PassState | None = None) -> list:
    update = GraphUpdate(at.index, at.t1_ns, at.t1_ns / NS)
    update.bias = gtsam.imuBias.ConstantBias(np.array([0.0, 0.5, 0.0]), np.array([0.0, 0.0, 0.1]))
    builder.add(update, at, None, pass_state or PassState(stage=1))
    return update.blocks


def car(**options) -> VehicleBuilder:
    return VehicleBuilder(AXES, VEHICLE_CLASSES["car"], **options)


def test_a_row_holds_rate_and_force_of_the_last_moments_without_bias():
    (block,) = rows(car(), window(10.0, 11.0))
    noise = VEHICLE_CLASSES["car"]
    rate = [0.0, 0.0, np.arange(95, 100).mean() / 100 - 0.1]
    np.testing.assert_allclose(block.data[0], [*rate, 1.5, 0.0, 9.8, noise.lateral_sigma, noise.vertical_sigma])
    assert block.keys == [(key("X", 3), key("V", 3), session_key("M", "vehicle"))]


def test_noise_found_from_the_data_scales_each_row():
    pass_state = PassState(stage=1, noise_scales={"vehicle_lateral": 2.0, "vehicle_vertical": 3.0})
    (block,) = rows(car(), window(10.0, 11.0), pass_state)
    noise = VEHICLE_CLASSES["car"]
    assert block.data[0, 6:] == pytest.approx([2 * noise.lateral_sigma, 3 * noise.vertical_sigma])


def test_one_row_a_second_however_many_keyframes():
    builder = car()
    edges = np.arange(10.0, 20.0, 0.25)
    assert sum(len(rows(builder, window(a, a + 0.25))) for a in edges) == 10


def test_no_row_inside_a_gap_of_which_nothing_is_known_but_one_at_its_end():
    builder = car(gaps=[Gap(round(10.4 * NS), 13 * NS, "missing")])
    assert [len(rows(builder, window(a, a + 1.0))) for a in (9.0, 10.0, 11.0, 12.0, 13.0)] == [1, 0, 0, 1, 1]


def test_a_row_inside_a_gap_rests_on_what_readings_stray_by():
    step, at = GraphUpdate(3, 11 * NS, 11.0), window(10.0, 11.0)
    step.bias, step.chain[key("G", 3)] = gtsam.imuBias.ConstantBias(), np.zeros(6)
    car(gaps=[Gap(round(10.4 * NS), 13 * NS, "missing")]).add(step, at, None, PassState(stage=1))
    (block,) = step.blocks
    assert block.model.letters[2:] == ("M", "G") and block.keys[0][3] == key("G", 3)


def test_no_row_at_a_standstill():
    t_ns = np.arange(0, 20 * NS, NS // 10)
    still = np.where((t_ns > 9.5 * NS) & (t_ns < 12.5 * NS), 0.01, np.nan)
    builder = car(rests=Standstills(t_ns, still, still))
    assert [len(rows(builder, window(a, a + 1.0))) for a in (8.0, 9.0, 10.0, 11.0, 12.0)] == [1, 0, 0, 0, 1]


def test_the_mean_of_the_last_moments_takes_the_last_interval_at_least():
    at = window(0.0, 0.02)
    assert recent(at, at.gyro, 0.001) == pytest.approx([0.0, 0.0, 0.01])


@pytest.mark.parametrize("options", [{"period_s": 0.0}, {"mount_sigma_deg": -1.0}, {"loss": "tukey"}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match=r"^config \[vehicle\]: .*; expected "):
        VehicleConfig(**options)

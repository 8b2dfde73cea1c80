"""The first state: closed form, rests, what the user gives, and whole starts."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from differences import wrap_deg
from exact import GRAVITY, START_NS, angle_deg, eight, record
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from smartnav_graph.core import frames
from smartnav_graph.core.errors import ConfigError, SolverError
from smartnav_graph.core.frames import magnetic_field_ut
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.estimate.alignment.first_stretch import FirstStretch, Fixes
from smartnav_graph.estimate.alignment.initial_state import InitialiseConfig, InitialState, UserStart
from smartnav_graph.estimate.alignment.initialiser import find_initial_state
from smartnav_graph.estimate.alignment.static import find_rest, inertial_curve, kabsch_attitude
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.factors.prior import PriorConfig
from smartnav_graph.graph.keyframes import KeyframeConfig, make_windows
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.session.streams import Imu, Magnetometer
from smartnav_graph.simulation import motions, sensors
from smartnav_graph.simulation.recording import ORIGIN, YEAR
from smartnav_graph.simulation.scenarios import simulate
from smartnav_graph.simulation.sensors import PROFILES, MagnetometerModel
from smartnav_graph.simulation.trajectory import Leg, Legs, Trajectory

NOISE = DEVICE_CLASSES["mems"]  # in motion
PHONE = PROFILES["galaxy-s2"]  # at rest
ZERO = gtsam.imuBias.ConstantBias()

# --- closed form ------------------------------------------------------------------------------------------------------


def curves(seed: int = 0, n: int = 20, sigma: float = 0.0):
    """A random inertial curve and the fixes it leads to; and the attitude, position and velocity it starts from."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng).as_matrix()
    p, v = rng.uniform(-50, 50, 3), rng.uniform(-10, 10, 3)
    t = np.arange(n) * 1.0
    curve = np.cumsum(np.cumsum(rng.standard_normal((n, 3)), axis=0), axis=0)
    fixes = p + v * t[:, None] + curve @ R.T
    fixes[:, 2] -= 0.5 * GRAVITY * t**2
    return curve, fixes + sigma * rng.standard_normal((n, 3)), t, (R, p, v)


@pytest.mark.parametrize("seed", range(5))
def test_a_known_attitude_is_recovered_exactly(seed):
    curve, fixes, t, (R, p, v) = curves(seed)
    found = kabsch_attitude(curve, fixes, t, GRAVITY)
    assert angle_deg(found[0], R) < 1e-6
    np.testing.assert_allclose(found[1], p, atol=1e-8)
    np.testing.assert_allclose(found[2], v, atol=1e-8)


def test_a_flat_curve_gives_a_rotation_and_no_mirror():
    curve, _, t, (R, p, v) = curves(1)
    curve = curve * [1, 1, 0]
    fixes = p + v * t[:, None] + curve @ R.T
    fixes[:, 2] -= 0.5 * GRAVITY * t**2
    found = kabsch_attitude(curve, fixes, t, GRAVITY)[0]
    assert np.linalg.det(found) == pytest.approx(1.0) and angle_deg(found, R) < 1e-6


def test_the_wrong_sign_of_gravity_shows():
    curve, fixes, t, (R, _, _) = curves(2, n=12)
    assert angle_deg(kabsch_attitude(curve, fixes, t, -GRAVITY)[0], R) > 20.0


def test_noise_turns_it_as_much_as_it_must():
    # information about the rotation: sum (|q|^2 I - q q^T) / sigma^2, q the curve without its line, in nav
    square, runs, sigma = 0.0, 200, 1.0
    for seed in range(runs):
        curve, fixes, t, (R, _, _) = curves(seed, sigma=sigma)
        basis, _ = np.linalg.qr(np.stack([np.ones_like(t), t], axis=-1))
        q = (curve - basis @ (basis.T @ curve)) @ R.T
        information = ((q**2).sum() * np.eye(3) - q.T @ q) / sigma**2
        error = Rotation.from_matrix(kabsch_attitude(curve, fixes, t, GRAVITY)[0] @ R.T).as_rotvec()
        square += error @ information @ error
    low, high = chi2(3 * runs).ppf([1e-4, 1 - 1e-4])
    assert low < square < high, square / (3 * runs)


def test_the_inertial_curve_is_the_path_without_start_and_gravity():
    recording = record(motions.car(15.0, np.random.default_rng(5), start_speed=12.0))
    at = START_NS + ns_from_seconds(np.arange(0.0037, 12.0, 1.0))
    windows = make_windows(recording.session.imu, at, [], {}, KeyframeConfig(max_spacing_s=2.0))
    truth, t = recording.truth(at), (at - at[0]) / NS
    path = (
        truth.nav_t_body[0] + truth.nav_v_body[0] * t[:, None] + inertial_curve(windows, ZERO) @ truth.nav_R_body[0].T
    )
    path[:, 2] -= 0.5 * GRAVITY * t**2
    np.testing.assert_allclose(path, truth.nav_t_body, atol=0.05)  # m after 11 s
    R, p, v = kabsch_attitude(inertial_curve(windows, ZERO), truth.nav_t_body, t, GRAVITY)
    assert angle_deg(R, truth.nav_R_body[0]) < 0.5
    assert np.linalg.norm(p - truth.nav_t_body[0]) < 0.05 and np.linalg.norm(v - truth.nav_v_body[0]) < 0.05


def test_a_known_bias_is_taken_out_of_the_curve():
    recording = record()
    bias = gtsam.imuBias.ConstantBias(np.array([0.2, 0.1, -0.3]), np.array([0.01, -0.02, 0.03]))
    imu = recording.session.imu
    wrong = replace(imu, accel=imu.accel + bias.accelerometer(), gyro=imu.gyro + bias.gyroscope())
    at = START_NS + ns_from_seconds(np.arange(0.0, 10.0))
    one, other = (make_windows(x, at, [], {}, KeyframeConfig(max_spacing_s=2.0)) for x in (imu, wrong))
    # the half turn of an interval was taken with the biased rate: g * 0.037 rad/s * 5 ms = 2 mm/s^2 over 9 s
    np.testing.assert_allclose(inertial_curve(other, bias), inertial_curve(one, ZERO), atol=0.08)


# --- rests ------------------------------------------------------------------------------------------------------------


def noisy(trajectory, seed: int = 0):
    return record(trajectory, noise=PHONE, seed=seed)


@pytest.mark.parametrize("seed", range(3))
def test_the_rest_before_a_walk_round_an_eight_is_found(seed):
    recording = noisy(eight(30.0), seed)
    rest = find_rest(recording.session.imu, START_NS, GRAVITY, 1.0)
    assert rest is not None and 3.9 < rest.length_s < 6.5  # at rest for 5 s, then up to speed within 5 s
    bias, R = recording.bias([START_NS])[0], recording.truth([START_NS]).nav_R_body[0]
    assert np.abs(rest.gyro - bias[3:]).max() < 4 * rest.gyro_sigma + 5e-4
    np.testing.assert_allclose(rest.accel, R.T @ [0, 0, GRAVITY] + bias[:3], atol=0.05)


def test_a_long_rest_counts_for_thirty_seconds():
    rest = find_rest(noisy(motions.static(60.0)).session.imu, START_NS, GRAVITY, 1.0)
    assert 29.0 < rest.length_s <= 30.0
    assert rest.gyro_sigma == pytest.approx(3e-4, rel=0.5)  # no gyro is known better: the walk


def test_a_phone_at_rest_is_at_rest():
    session = simulate("static-60s")
    assert find_rest(session.imu, session.t0_ns, session.gravity, 1.0).length_s > 25.0


@pytest.mark.parametrize(
    ("name", "start_s"),
    [("walking", 12.0), ("a car that speeds up", 1.0), ("round an eight", 12.0)],
)
def test_motion_is_no_rest(name, start_s):
    made = {
        "walking": motions.walk(30.0, np.random.default_rng(5)),
        "a car that speeds up": motions.car(30.0, np.random.default_rng(5), start_speed=5.0),
        "round an eight": eight(30.0),
    }[name]
    imu = noisy(made).session.imu
    assert find_rest(imu, START_NS + int(start_s * NS), GRAVITY, 1.0) is None


def still(seconds: float = 10.0, **changes) -> Imu:
    """A flat device at rest with the noise of a phone, changed by rows: name -> f(t) -> (n, 3)."""
    rng = np.random.default_rng(0)
    t = np.arange(round(100 * seconds)) / 100
    values = {
        "accel": np.tile([0.0, 0.0, GRAVITY], (len(t), 1)) + 0.03 * rng.standard_normal((len(t), 3)),
        "gyro": 2e-3 * rng.standard_normal((len(t), 3)),
    }
    for name, f in changes.items():
        values[name] = values[name] + f(t)[:, None] * np.ones(3)
    return Imu(t_ns=START_NS + ns_from_seconds(t), **values)


def rest_length(imu: Imu, shortest_s: float = 1.0) -> float | None:
    rest = find_rest(imu, START_NS, GRAVITY, shortest_s)
    return None if rest is None else rest.length_s


def test_what_is_and_is_not_a_rest():
    assert rest_length(still()) > 9.0
    assert rest_length(still(accel=lambda t: 0.5 * np.sin(2 * np.pi * 12 * t))) is None  # an engine
    assert rest_length(still(gyro=lambda t: 0.05 * np.sin(2 * np.pi * t))) is None  # in a hand
    assert rest_length(still(accel=lambda t: 0.0 * t - 1.0)) is None  # 1.7 m/s^2 too little: not gravity alone
    assert 2.4 < rest_length(still(accel=lambda t: 0.5 * (t > 3.0))) < 3.1  # pushed off after 3 s
    assert 2.4 < rest_length(still(gyro=lambda t: 0.02 * (t > 3.0))) < 3.1  # turned slowly from there on
    assert rest_length(still(gyro=lambda t: 0.05 + 0.0 * t)) > 9.0  # a large but steady gyro bias


def test_too_short_a_rest_does_not_count():
    imu = still(accel=lambda t: 0.5 * (t > 3.0))
    assert rest_length(imu, 2.0) is not None and rest_length(imu, 4.0) is None
    assert find_rest(imu.take(slice(0, 3)), START_NS, GRAVITY, 1.0) is None
    assert find_rest(imu, int(imu.t_ns[-1]), GRAVITY, 1.0) is None


# --- what the user gives ----------------------------------------------------------------------------------------------


def test_given_is_read():
    assert UserStart.parse("1,2.5,-3,90") == UserStart((1.0, 2.5, -3.0), 90.0, 10.0, 10.0)
    assert UserStart.parse(" 1, 2,3 ,90 ,0.5,2") == UserStart((1.0, 2.0, 3.0), 90.0, 0.5, 2.0)


@pytest.mark.parametrize(
    "text",
    ["", "1,2,3", "1,2,3,4,5", "1,2,3,4,5,6,7", "a,b,c,d", "1,2,3,nan", "1,2,3,inf", "1,2,3,4,0,1", "1,2,3,4,1,-1"],
)
def test_given_that_cannot_be_read(text):
    with pytest.raises(ConfigError) as e:
        UserStart.parse(text)
    assert str(e.value).startswith(f"--initial: {text!r}; expected e,n,u,heading_deg[,sigma_m,sigma_deg] in metres")


@pytest.mark.parametrize(
    "wrong", [{"stretch_s": 0.0}, {"stretch_s": 50.0, "max_stretch_s": 40.0}, {"starts": 0}, {"rest_s": 0.0}]
)
def test_config_names_what_is_wrong(wrong):
    with pytest.raises(ConfigError, match=r"config \[initialise\]: stretch_s = .*0 < stretch_s <= max_stretch_s"):
        InitialiseConfig(**wrong)


# --- whole starts without a solver ------------------------------------------------------------------------------------


def started(session, **changes) -> InitialState:
    """The first state of a session without its fixes."""
    at = session.t0_ns + ns_from_seconds(np.arange(0.0, 20.0))
    values = {
        "windows": make_windows(session.imu, at, [], {}, KeyframeConfig(max_spacing_s=2.0)),
        "imu": session.imu,
        "fixes": Fixes.none(),
        "gravity": session.gravity,
        "noise": NOISE,
        "forward": session.device.forward,
        "up": session.device.up,
        "magnetometer": session.magnetometer,
        "config": InitialiseConfig(),
        "fix_sigma": 3.0,
    }
    return find_initial_state(FirstStretch(**{**values, **changes}), no_solver)


def no_solver(prior, count, pass_state, values):
    raise AssertionError("nothing to solve")


def declination_deg() -> float:
    east, north, _ = magnetic_field_ut(ORIGIN, YEAR)
    return float(np.degrees(np.arctan2(east, north)))


@pytest.mark.parametrize("seed", range(5))
def test_a_rest_of_a_calibrated_device_gives_the_magnetic_heading_within_three_degrees(seed):
    # left over: 0.02 m/s^2 of bias (0.12 deg of tilt, times tan 68 deg of dip) and 0.3 uT in 19 uT: 0.95 deg a sigma
    recording = record(motions.static(30.0), noise=replace(PHONE, accel_bias_sigma=0.02), seed=seed)
    t_ns = recording.session.imu.t_ns[::10]
    mag = sensors.magnetometer(
        recording.truth(t_ns),
        t_ns,
        MagnetometerModel(hard_iron_sigma_ut=0.3),
        magnetic_field_ut(ORIGIN, YEAR),
        np.random.default_rng(seed),
    )
    session = recording.session.replace(magnetometer=mag)
    start = started(session, declination_deg=declination_deg())
    assert start.method == "static" and "magnetometer" in start.sentence
    assert abs(wrap_deg(start.heading_deg - 40.0)) < 3.0


@pytest.mark.parametrize("seed", range(5))
def test_a_rest_of_a_phone_as_it_is_keeps_the_sigma_it_claims(seed):
    session = simulate("static-60s", seed)  # heading 40 deg, pitch 5 deg, roll -3 deg
    start = started(session, declination_deg=declination_deg(), iron_sigma=1.0)
    # 20 deg for iron nearby and 1 uT of the phone's own in 19 uT
    assert abs(wrap_deg(start.heading_deg - 40.0)) < start.sigma_heading_deg == pytest.approx(20.3, abs=0.3)
    R = start.prior.start.nav.attitude().matrix()
    true = motions.static(1.0).sample([0.5]).nav_R_body[0]
    tilt = np.degrees(np.arccos(np.clip((R @ true.T)[2, 2], -1, 1)))
    assert tilt < np.degrees(3 * 0.3 / 9.81 * np.sqrt(2))  # 3 sigma of the accelerometer bias


@pytest.mark.parametrize("heading", [0.0, 40.0, 135.0, 350.0])
@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (20.0, 35.0), (-40.0, 60.0)])
def test_the_magnetic_heading_of_an_exact_field(heading, roll, pitch):
    ned_R_frd = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix()
    enu = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    R = enu @ ned_R_frd @ np.diag([1.0, -1, -1]) @ frames.body_R_vehicle("+y", "+z").T
    n = 1000
    t = START_NS + ns_from_seconds(np.arange(n) / 100)
    imu = Imu(t_ns=t, accel=np.tile(R.T @ [0, 0, GRAVITY], (n, 1)), gyro=np.zeros((n, 3)))
    mag = Magnetometer(t_ns=t, field_ut=np.tile(R.T @ magnetic_field_ut(ORIGIN, YEAR), (n, 1)))
    session = record().session.replace(imu=imu, magnetometer=mag, gnss=None, control=None)
    at = START_NS + ns_from_seconds(np.arange(0.0, 9.0))
    windows = make_windows(imu, at, [], {}, KeyframeConfig(max_spacing_s=2.0))
    start = started(session, windows=windows, declination_deg=declination_deg())
    assert abs(wrap_deg(start.heading_deg - heading)) < 1e-6
    assert angle_deg(start.prior.start.nav.attitude().matrix(), R) < 1e-6


def test_a_rest_alone_starts_at_zero_and_says_so():
    session = simulate("static-60s").replace(magnetometer=None)
    start = started(session)
    assert start.heading_deg == 0.0
    assert 0.01 < start.sigma_heading_deg < 0.1  # the square of a levelling good to 1.5 deg
    assert start.sentence.startswith(
        "No absolute sensor: started from a rest of 29.5 s; heading and position set to zero"
    )
    np.testing.assert_array_equal(start.prior.start.nav.position(), 0.0)
    np.testing.assert_array_equal(start.prior.start.nav.velocity(), 0.0)
    np.testing.assert_allclose(start.prior.start.bias.gyroscope(), session.reference.gyro_bias[0], atol=2e-3)
    np.testing.assert_allclose(start.prior.sigma_vel, 0.01)


def test_neither_rest_nor_absolute_sensor_is_refused_with_the_way_out():
    session = record(motions.car(30.0, np.random.default_rng(5), start_speed=12.0)).session
    with pytest.raises(SolverError) as e:
        started(session)
    text = str(e.value)
    assert text.startswith("initialisation: no absolute sensor (no position fix, no control point) and no rest")
    assert 'give --initial "e,n,u,heading_deg"' in text


def test_forward_may_be_the_axis_that_points_up_in_a_flat_device():
    """A phone upright in a holder: forward out of its back, up its top edge."""
    R = Rotation.from_euler("x", 90.0, degrees=True).as_matrix()  # its top edge points up
    n = 1000
    t = START_NS + ns_from_seconds(np.arange(n) / 100)
    imu = Imu(t_ns=t, accel=np.tile(R.T @ [0, 0, GRAVITY], (n, 1)), gyro=np.zeros((n, 3)))
    mag = Magnetometer(t_ns=t, field_ut=np.tile(R.T @ magnetic_field_ut(ORIGIN, YEAR), (n, 1)))
    session = record().session.replace(imu=imu, magnetometer=mag, gnss=None, control=None)
    at = START_NS + ns_from_seconds(np.arange(0.0, 9.0))
    windows = make_windows(imu, at, [], {}, KeyframeConfig(max_spacing_s=2.0))
    start = started(session, windows=windows, forward="-z", up="+y", declination_deg=declination_deg())
    assert start.heading_deg % 360.0 == pytest.approx(0.0, abs=1e-6)
    device = replace(record().session.device, forward="-z", up="+y")
    fixes = record(eight(30.0), noise=PHONE, fix_sigma=0.3, seed=2).session.replace(device=device)
    assert np.isfinite(initialise(prepare(fixes, Config())).heading_deg)


@pytest.mark.parametrize("resting", [False, True])
def test_a_given_start_is_levelled_and_held_as_told(resting):
    motion = motions.static(30.0) if resting else motions.car(30.0, np.random.default_rng(5), start_speed=12.0)
    recording = record(motion)
    start = started(recording.session, user=UserStart((1.0, 2.0, 3.0), 123.0, 0.5, 2.0))
    prior = start.prior
    assert start.method == "given" and start.heading_deg == 123.0
    assert ("levelled over a rest" in start.sentence) == resting
    np.testing.assert_array_equal(prior.start.nav.position(), [1, 2, 3])
    np.testing.assert_array_equal(prior.sigma_pos, 0.5)
    assert np.degrees(prior.sigma_rot[2]) == pytest.approx(2.0)
    R = prior.start.nav.attitude().matrix()
    assert frames.heading_pitch_roll_deg(R)[0, 0] == pytest.approx(123.0, abs=1e-6)
    up = recording.truth([START_NS]).nav_R_body[0].T @ [0, 0, 1]
    assert np.degrees(np.arccos((R @ up)[2])) < (0.01 if resting else 12.0)
    assert prior.sigma_vel.max() == (0.01 if resting else 10.0)


# --- whole starts with the real solver --------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "method"), [("car", "dynamic"), ("figure eight", "static"), ("walk", "static")])
def test_a_start_from_good_fixes_finds_attitude_and_speed(name, method):
    made = {
        "car": motions.car(40.0, np.random.default_rng(5), start_speed=12.0),
        "figure eight": eight(40.0),
        "walk": motions.walk(40.0, np.random.default_rng(5)),
    }[name]
    recording = record(made, noise=PHONE, fix_sigma=0.3, seed=2)
    problem = prepare(recording.session, Config())
    start = initialise(problem)
    truth = recording.truth([problem.windows[0].t1_ns])
    nav = start.prior.start.nav
    heading = frames.heading_pitch_roll_deg(truth.nav_R_body)[0, 0]
    error = abs(float(wrap_deg(start.heading_deg - heading)))
    assert start.method == method
    assert error < 3.0 * start.sigma_heading_deg and start.sigma_heading_deg < 10.0
    assert np.linalg.norm(nav.velocity() - truth.nav_v_body[0]) < 0.5
    assert np.linalg.norm(nav.position() - truth.nav_t_body[0]) < 1.0
    assert start.to_dict()["sentence"] == start.sentence and f"{start.heading_deg:.1f} deg" in start.sentence


def test_steady_travel_is_no_rest_where_fixes_say_otherwise():
    # a car at a constant 12 m/s on a straight: inertially at rest
    straight = Trajectory(Legs([Leg(20.0, 12.0), Leg(6.0, 6.0), Leg(8.0, 9.0, 90.0)], speed=12.0, heading_deg=60.0))
    recording = record(straight, noise=PHONE, fix_sigma=0.3, seed=2)
    assert find_rest(recording.session.imu, START_NS, GRAVITY, 1.0) is not None
    start = initialise(prepare(recording.session, Config()))
    assert start.method == "dynamic"
    np.testing.assert_allclose(np.linalg.norm(start.prior.start.nav.velocity()), 12.0, atol=0.5)


def test_the_options_of_the_prior_take_effect():
    session = simulate("car-10min").replace(reference=None)
    config = Config(prior=PriorConfig(angle_sigma=0.5, speed_sigma=40.0))
    prior = initialise(prepare(session, config)).prior
    np.testing.assert_array_equal(prior.sigma_rot, 0.5)
    np.testing.assert_array_equal(prior.sigma_vel, 40.0)
    with pytest.raises(ConfigError, match="speed_sigma"):
        PriorConfig(speed_sigma=0.0)

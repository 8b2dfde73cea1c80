"""What every builder of blocks owes: zero at the truth, true derivatives and sigmas, causality, only finite numbers.

Everything runs over CASES, in units of sigma; a new sensor adds its row, or `test_contract` fails.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import gtsam
import numpy as np
import pytest
from exact import LEVER, START_NS, Graph, Recording, assemble, assert_derivative, record
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState
from smartnav_graph.graph.states import kind_of
from smartnav_graph.session.calibration.model import BarometerNoise, Calibration, MagnetometerNoise
from smartnav_graph.session.session import Device, Mount, Session
from smartnav_graph.session.streams import Magnetometer, PoseFix, Ranges, Velocity, WheelSpeed
from smartnav_graph.simulation import motions, sensors
from smartnav_graph.simulation.trajectory import Leg, Legs, Trajectory

Wrong = Callable[[Session], Session]
Record = Callable[[int | None], Recording]
SHIFT_NS = NS // 10
MEMORY = PassState(stage=LAST_STAGE)


@dataclass(frozen=True)
class Case:
    """One builder.

    record : its recording, exact for None, noisy for a seed; at_truth : largest |component| there, in sigma
    mutations : name -> (mistake, rms over the rows it must exceed, in sigma); known : true session states
    stream : stream and field whose broken numbers are refused; noisy : whether its sigma is that of simulated noise
    options : sections of the configuration, for a factor that is off by default
    lookahead_s : what it may see of the time after a keyframe; cut : inertial samples of the shorter recording
    """

    record: Record
    at_truth: float
    mutations: Mapping[str, tuple[Wrong, float]]
    known: Mapping[str, Any] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    stream: tuple[str, str] | None = None
    noisy: bool = True
    lookahead_s: float = 0.0
    cut: int = 1300

    def graph(self, made: Recording, session: Session | None = None) -> Graph:
        """The graph of the recording, or of a changed session, at the true states."""
        states = {"bias": made.bias, "known": self.known}
        return assemble(session or made.session, made.truth, pass_state=MEMORY, options=self.options, **states)


# --- recordings -------------------------------------------------------------------------------------------------------

YAW, AHEAD, ABOVE, RIGHT = np.radians(3.0), 1.2, 0.5, 0.3  # rad, m: how the phone sits in the car
SIGMA = 0.2  # m/s


def _ride() -> Trajectory:
    """A car on a plain: 20 s of turns, gain and loss of speed; the phone turned and ahead of the rear axle."""
    legs = [Leg(4.0, 10.0), Leg(6.0, 10.0, 80.0), Leg(4.0, 4.0), Leg(6.0, 9.0, -60.0)]
    return Trajectory(Legs(legs, speed=6.0), held_deg=(float(np.degrees(YAW)), 0.0, 0.0), carried=(RIGHT, AHEAD, ABOVE))


@cache
def car(seed: int | None) -> Recording:
    """A ride with wheel speeds at 20 Hz, body velocities at 10 Hz and velocities in the fixes."""
    made = record(_ride(), seed=seed)
    session, ride = made.session, made.trajectory
    rng = np.random.default_rng((0 if seed is None else seed, 1))
    noise = 0.0 if seed is None else SIGMA
    t = np.arange(0.0, ride.duration, 0.05)
    fixes = ride.sample((session.gnss.t_ns - START_NS) / NS)
    arm = np.cross(fixes.body_rate, LEVER)
    of_fixes = fixes.nav_v_body + np.einsum("nij,nj->ni", fixes.nav_R_body, arm)
    there = ride.sample(t[::2] + 0.003)
    in_body = np.einsum("nji,nj->ni", there.nav_R_body, there.nav_v_body)

    def off(rows: np.ndarray) -> np.ndarray:
        return rows + noise * rng.standard_normal(rows.shape)

    session = session.replace(
        device=Device(name="exact", vehicle="car"),
        wheel=WheelSpeed(t_ns=START_NS + ns_from_seconds(t), speed=off(ride.speed(t)), sigma=np.full(len(t), SIGMA)),
        velocity=Velocity(
            t_ns=START_NS + ns_from_seconds(there.t), velocity=off(in_body), sigma=np.full(in_body.shape, SIGMA)
        ),
        gnss=replace(session.gnss, velocity=off(of_fixes), sigma_velocity=np.full(of_fixes.shape, SIGMA)),
    )
    return replace(made, session=session)


# pitch, yaw, the rear axle seen from the phone in the vehicle's own axes (forward, left, up), no compliance
CAR_STATES = {"vehicle_mount": [0.0, -YAW, -AHEAD, RIGHT, -ABOVE, 0.0, 0.0, 0.0]}


NAV_FIELD = np.array([0.0, 19.0, -45.0])  # uT, magnetic north is north
IRON = np.array([12.0, -30.0, 7.0])
FIELD_STATES = {"magnetometer_hard_iron_ut": IRON, "magnetometer_field_ut": NAV_FIELD[1:]}


@cache
def with_field(seed: int | None) -> Recording:
    """A figure eight with a magnetometer at 20 Hz; no iron nearby."""
    made = record(seed=seed)
    t = np.arange(0.013, 29.9, 0.05)
    noise = MagnetometerNoise(sigma_ut=0.5, disturbance_ut=0.0)
    white = np.random.default_rng((0 if seed is None else seed, 2)).standard_normal((len(t), 3))
    field_ut = np.einsum("nji,j->ni", made.trajectory.sample(t).nav_R_body, NAV_FIELD) + IRON
    field_ut += 0.0 if seed is None else noise.sigma_ut * white
    stream = Magnetometer(t_ns=START_NS + ns_from_seconds(t), field_ut=field_ut)
    return replace(
        made, session=made.session.replace(magnetometer=stream, calibration=Calibration(magnetometer_noise=noise))
    )


@cache
def afoot(seed: int | None) -> Recording:
    """A straight walk of 70 s that nothing but the inertial data tell of."""
    way = Legs([Leg(70.0, 1.35)], speed=1.35, heading_deg=30.0)
    walk = Trajectory(way, held_deg=(0.0, 35.0, 4.0), sway=motions.walk(10.0, np.random.default_rng(0)).sway)
    made = record(walk, seed=seed)
    device = Device(name="exact", vehicle="foot")
    return replace(made, session=made.session.replace(gnss=None, control=None, device=device))


@cache
def uphill(seed: int | None) -> Recording:
    """A walk up a ramp and round its bends, barometer at 10 Hz; fixes too poor to do without steps."""
    legs = [Leg(6.0, 1.35, slope_deg=10.0), Leg(4.0, 1.35, 90.0, 10.0), Leg(10.0, 1.35, slope_deg=-5.0)]
    legs += [Leg(5.0, 1.35, -120.0), Leg(5.0, 1.35)]
    sway = motions.walk(10.0, np.random.default_rng(0)).sway
    made = record(Trajectory(Legs(legs, speed=1.35), held_deg=(0.0, 35.0, 4.0), sway=sway), seed=seed)
    t = np.arange(0.003, 29.9, 0.1)
    height, t_ns = made.trajectory.sample(t).nav_t_body[:, 2], START_NS + ns_from_seconds(t)
    noise = 0.0 if seed is None else BarometerNoise().pressure_sigma
    model = sensors.BarometerModel(offset_sigma_hpa=0.0, sigma_hpa=noise)
    stream = sensors.barometer(height, t_ns, model, np.random.default_rng((seed or 0, 3)))
    session = made.session.replace(barometer=stream, device=Device(name="exact", vehicle="foot"))
    return replace(made, session=session)


TURN = np.array([0.02, -0.03, 0.04])  # rad, of the sensor in the body
DELAY_S = 0.03
FIX_STATES = {
    "pose_fixes_time_offset_s": [DELAY_S],
    "pose_fixes_lever_arm_correction_m": LEVER,
    "pose_fixes_mount_correction_rad": TURN,
}


@cache
def recognised(seed: int | None) -> Recording:
    """A figure eight with a pose fix a second, of a sensor of unknown mount whose stamps are early."""
    made = record(seed=seed)
    t = np.arange(0.4, 29.5, 1.0)
    there = made.trajectory.sample(t + DELAY_S)
    white = np.random.default_rng((0 if seed is None else seed, 4)).standard_normal((2, len(t), 3)) * (seed is not None)
    attitude = Rotation.from_rotvec(0.01 * white[0]) * Rotation.from_matrix(there.nav_R_body)
    stream = PoseFix(
        t_ns=START_NS + ns_from_seconds(t),
        enu=there.nav_t_body + there.nav_R_body @ np.array(LEVER) + 0.05 * white[1],
        sigma=np.full((len(t), 3), 0.05),
        quat=(attitude * Rotation.from_rotvec(TURN)).as_quat()[:, [3, 0, 1, 2]],
        sigma_rot=np.full((len(t), 3), 0.01),
    )
    return replace(made, session=made.session.replace(pose_fixes=stream))


ANCHORS = np.array([[-16.0, -8.0, 2.0], [5.0, -8.0, 3.0], [5.0, 8.0, 2.0], [-16.0, 8.0, 3.0]])
ANCHOR_BIAS = np.array([0.2, -0.1, 0.3, 0.0])  # m
RANGE_STATES = {f"ranges_bias_A{i}_m": [bias] for i, bias in enumerate(ANCHOR_BIAS)}


@cache
def ranged(seed: int | None) -> Recording:
    """A figure eight among four anchors that are heard one after the other, and nothing else."""
    made = record(seed=seed)
    t = np.arange(0.4, 29.5, 0.25)
    there, row = made.trajectory.sample(t), np.arange(len(t)) % 4
    sensor = there.nav_t_body + there.nav_R_body @ np.array(LEVER)
    white = np.random.default_rng((0 if seed is None else seed, 5)).standard_normal(len(t)) * (seed is not None)
    stream = Ranges(
        t_ns=START_NS + ns_from_seconds(t),
        anchor_id=np.array([f"A{i}" for i in row], dtype=object),
        enu=ANCHORS[row],
        range_m=np.linalg.norm(sensor - ANCHORS[row], axis=1) + ANCHOR_BIAS[row] + 0.05 * white,
        sigma=np.full(len(t), 0.05),
    )
    sensors = {"ranges": Mount(body_t=LEVER)}
    return replace(made, session=made.session.replace(ranges=stream, gnss=None, control=None, sensors=sensors))


# --- mistakes ---------------------------------------------------------------------------------------------------------


def _column(stream: str, name: str, change: Callable[[np.ndarray], np.ndarray]) -> Wrong:
    def wrong(session: Session) -> Session:
        rows = getattr(session, stream)
        return session.replace(**{stream: replace(rows, **{name: change(getattr(rows, name))})})

    return wrong


def _axes(forward: str, up: str) -> Wrong:
    return lambda session: session.replace(device=replace(session.device, forward=forward, up=up))


def _late(stream: str) -> Wrong:
    return _column(stream, "t_ns", lambda t_ns: t_ns + SHIFT_NS)


CASES: dict[str, Case] = {
    "vehicle": Case(
        car,
        0.2,  # the rate is the mean of the last 0.05 s, the lever arm 1.2 m
        {
            # 8 m/s sideways or up for a sigma of 0.15 m/s
            "forward axis": (_axes("+x", "+z"), 30.0),
            "up axis": (_axes("+y", "-x"), 0.5),
            "rate sign": (_column("imu", "gyro", np.negative), 1.0),
        },
        known=CAR_STATES,
        noisy=False,
    ),
    "wheel": Case(
        car,
        0.3,  # the straight line through 0.4 s of a car that changes its force by 4 m/s^2 a second
        {
            "km/h": (_column("wheel", "speed", lambda v: 3.6 * v), 50.0),
            "sign": (_column("wheel", "speed", np.negative), 50.0),
            "forward axis": (_axes("-x", "+z"), 20.0),
            "clock late by 0.1 s": (_late("wheel"), 1.0),
        },
        known=CAR_STATES,
        stream=("wheel", "speed"),
        lookahead_s=0.2,
    ),
    "velocity": Case(
        car,
        0.05,  # a straight line between readings 0.1 s apart
        {
            "sign": (_column("velocity", "velocity", np.negative), 50.0),
            "axes swapped": (_column("velocity", "velocity", lambda v: v[:, [1, 0, 2]]), 20.0),
            "clock late by 0.1 s": (_late("velocity"), 0.3),
        },
        stream=("velocity", "velocity"),
        lookahead_s=0.5,
    ),
    "magnetometer": Case(
        with_field,
        0.1,  # 20 samples of 0.5 uT; between samples the turn is taken about one axis
        {
            "gauss": (_column("magnetometer", "field_ut", lambda b: b / 100.0), 100.0),
            "sign": (_column("magnetometer", "field_ut", np.negative), 100.0),
            "axes swapped": (_column("magnetometer", "field_ut", lambda b: b[:, [1, 0, 2]]), 100.0),
            # 1.5 rad/s in 49 uT, and the mean of half a second's turn the wrong way
            "clock late by 0.1 s": (_late("magnetometer"), 5.0),
            "rate sign": (_column("imu", "gyro", np.negative), 10.0),
        },
        known=FIELD_STATES,
        stream=("magnetometer", "field_ut"),
    ),
    "gravity": Case(
        afoot,
        0.5,  # steps of 0.53 s do not fit into 4 s
        {
            # twice the roll of 4 deg, and the pitch of 35 deg, for a sigma of 0.5 m/s^2
            "force sign": (_column("imu", "accel", lambda f: f * [-1.0, 1.0, 1.0]), 1.2),
            "axes swapped": (_column("imu", "accel", lambda f: f[:, [1, 0, 2]]), 8.0),
        },
        noisy=False,
        cut=4500,
    ),
    "barometer": Case(
        uphill,
        0.6,  # the device bobs by 18 mm with the steps, which a mean of a second leaves out; sigma 80 mm
        {
            # 1.9 m up, then down
            "pressure sign": (_column("barometer", "pressure_hpa", lambda p: 2 * p[0] - p), 10.0),
            "feet": (_column("barometer", "pressure_hpa", lambda p: p[0] + 3.28 * (p - p[0])), 15.0),
        },
        stream=("barometer", "pressure_hpa"),
        noisy=False,
        lookahead_s=0.5,
    ),
    "steps": Case(
        uphill,
        2.5,  # of the first and the last step only a part is recorded, 0.5 m with a sigma of 0.2 m
        {
            # 1.35 m a second
            "backwards": (_axes("-y", "+z"), 8.0),
            "sideways": (_axes("+x", "+z"), 5.5),
        },
        known={"step_factor": [0.48, 0.0]},
        noisy=False,
        lookahead_s=1.0,
    ),
    "pose_fixes": Case(
        recognised,
        0.05,  # a quarter of a millimetre: the force is the mean of the last inertial interval
        {
            "nav axes swapped": (_column("pose_fixes", "enu", lambda p: p[:, [1, 0, 2]]), 50.0),
            "feet": (_column("pose_fixes", "enu", lambda p: p / 0.3048), 50.0),
            "clock late by 0.1 s": (_late("pose_fixes"), 1.0),  # 1.5 m/s for a sigma of 0.05 m
        },
        known=FIX_STATES,
        stream=("pose_fixes", "enu"),
    ),
    "pose_attitude": Case(
        recognised,
        0.2,  # two milliradians: the rate changes within 0.03 s
        {
            "body to nav": (_column("pose_fixes", "quat", lambda q: q * [1, -1, -1, -1]), 50.0),
            "scalar last": (_column("pose_fixes", "quat", lambda q: q[:, [3, 0, 1, 2]]), 50.0),
            "clock late by 0.1 s": (_late("pose_fixes"), 3.0),  # 0.8 rad/s for a sigma of 0.01 rad
        },
        known=FIX_STATES,
    ),
    "ranges": Case(
        ranged,
        1e-6,
        {
            "feet": (_column("ranges", "range_m", lambda r: r / 0.3048), 100.0),
            "nav axes swapped": (_column("ranges", "enu", lambda p: p[:, [1, 0, 2]]), 50.0),
            "anchors confused": (_column("ranges", "enu", np.flipud), 20.0),
            "height sign": (_column("ranges", "enu", lambda p: p * [1, 1, -1]), 3.0),
            "lever arm forgotten": (lambda session: session.replace(sensors={}), 5.0),
            "lever arm sign": (lambda s: s.replace(sensors={"ranges": Mount(body_t=tuple(-x for x in LEVER))}), 10.0),
            "bias sign": (_column("ranges", "range_m", lambda r: r - 2 * np.resize(ANCHOR_BIAS, len(r))), 3.0),
            "clock late by 0.1 s": (_late("ranges"), 0.8),  # 1.5 m/s, partly across, for a sigma of 0.05 m
        },
        known=RANGE_STATES,
        stream=("ranges", "range_m"),
    ),
    "gnss_velocity": Case(
        car,
        0.05,  # the angular rate that turns the lever arm is the mean of the last inertial interval
        {
            "sign": (_column("gnss", "velocity", np.negative), 40.0),
            "nav axes swapped": (_column("gnss", "velocity", lambda v: v[:, [1, 0, 2]]), 20.0),
            "lever arm forgotten": (lambda session: session.replace(sensors={}), 0.3),
        },
    ),
}
REFUSING = [sensor for sensor, case in CASES.items() if case.stream]
NOISY = [sensor for sensor, case in CASES.items() if case.noisy]
MISTAKES = [(sensor, name) for sensor, case in CASES.items() for name in case.mutations]


# --- what is owed -----------------------------------------------------------------------------------------------------


@cache
def graph_of(sensor: str, seed: int | None = None) -> Graph:
    return CASES[sensor].graph(CASES[sensor].record(seed))


def white(graph: Graph, sensor: str) -> np.ndarray:
    """Whitened residuals, one row a measurement."""
    return np.array([factor.whitenedError(graph.values) for _, factor in graph.rows(sensor)])


def rms(rows: np.ndarray) -> float:
    return float(np.sqrt((rows**2).mean()))


@pytest.mark.parametrize("sensor", CASES)
def test_the_residual_at_the_simulated_truth_is_zero(sensor):
    rows = white(graph_of(sensor), sensor)
    assert len(rows) >= 15
    assert np.abs(rows).max() <= CASES[sensor].at_truth


@pytest.mark.parametrize(("sensor", "name"), MISTAKES)
def test_a_mistake_shows_in_the_residual(sensor, name):
    case = CASES[sensor]
    wrong, floor = case.mutations[name]
    made = case.record(None)
    found = rms(white(case.graph(made, wrong(made.session)), sensor))
    assert found > floor > 2 * case.at_truth, found


def disturbed(graph: Graph, factor: Any) -> gtsam.Values:
    """Every state of one factor off by 0.02 of its unit: derivatives must hold away from the truth too."""
    rng = np.random.default_rng(3)
    delta = gtsam.VectorValues()
    for name in factor.keys():  # noqa: SIM118
        delta.insert(name, 0.02 * rng.standard_normal(kind_of(name).dim))
    return graph.values.retract(delta)


@pytest.mark.parametrize("sensor", CASES)
def test_the_analytic_derivative_is_the_numerical_one(sensor):
    graph = graph_of(sensor)
    rows = graph.rows(sensor)
    _, factor = rows[len(rows) // 2]
    assert_derivative(factor, disturbed(graph, factor))


@pytest.mark.parametrize("sensor", NOISY)
def test_whitened_residuals_of_simulated_noise_have_unit_variance(sensor):
    rows = np.concatenate([white(graph_of(sensor, seed), sensor).ravel() for seed in range(4)])
    low, high = chi2(rows.size).ppf([1e-4, 1 - 1e-4])  # two-sided, 1e-4 in each tail
    assert low < (rows**2).sum() < high, (low / rows.size, (rows**2).mean(), high / rows.size)


@pytest.mark.parametrize("sensor", CASES)
def test_removing_what_comes_later_leaves_earlier_steps_unchanged(sensor):
    case = CASES[sensor]
    made = case.record(None)
    cut = int(made.session.imu.t_ns[case.cut])
    shorter = made.session.replace(
        **{name: stream.take(stream.t_ns <= cut) for name, stream in made.session.streams().items()}
    )
    full = graph_of(sensor)
    part = case.graph(made, shorter)
    # without fixes keyframes stand at full seconds; else later windows end where the recording does
    last = max((w.t1_ns for w in part.windows if w.rows), default=cut)
    known = min(last, cut - ns_from_seconds(case.lookahead_s))
    pairs = [[(tag, f) for tag, f in graph.rows(sensor) if tag.t_ns <= known] for graph in (full, part)]
    assert len(pairs[0]) == len(pairs[1]) > 8
    for (tag, factor), (other_tag, other) in zip(*pairs, strict=True):
        assert tag == other_tag
        values = disturbed(full, factor)
        np.testing.assert_array_equal(factor.whitenedError(values), other.whitenedError(values))


@pytest.mark.parametrize("sensor", REFUSING)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_measurement_that_is_no_number_is_refused_by_name(sensor, value):
    name, column = CASES[sensor].stream
    stream = getattr(CASES[sensor].record(None).session, name)
    rows = np.array(getattr(stream, column))
    rows.reshape(len(rows), -1)[4, 0] = value
    with pytest.raises(SessionError, match=rf"^{name}: \w+ is {value} at row 4 .*; expected finite numbers") as error:
        replace(stream, **{column: rows})
    assert error.value.stream == name and error.value.row == 4

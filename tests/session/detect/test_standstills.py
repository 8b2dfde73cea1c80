"""Standstills: rests between motions, stances of a synthetic foot, listed periods, and what is none."""

import gzip
from dataclasses import replace

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.core.arrays import runs
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS, Gap, find_gaps
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.session.detect.stances import REST_SPEED, stance_speed
from smartnav_graph.session.detect.standstills import (
    HAND_SPEED,
    LOOKAHEAD_S,
    StandstillConfig,
    Standstills,
    find_standstills,
)
from smartnav_graph.session.streams import Imu, StaticPeriod
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.scenarios import simulate
from smartnav_graph.simulation.sensors import PROFILES, imu
from smartnav_graph.simulation.trajectory import Leg, Legs, Trajectory

GRAVITY = 9.81
PHONE = PROFILES["galaxy-s2"]


def ride(trajectory, noise=PHONE, seed=0, hertz=100.0):
    """Inertial samples along a motion."""
    t = np.arange(0.0, trajectory.duration, 1.0 / hertz)
    t_ns = np.rint(t * NS).astype(np.int64)
    return imu(trajectory.sample(t), t_ns, noise, GRAVITY, np.random.default_rng(seed))[0]


def found(samples, vehicle="none", listed=None, gaps=(), noise=PHONE, **options):
    return find_standstills(samples, listed, gaps, vehicle, noise, GRAVITY, StandstillConfig(**options))


def seconds(spans):
    return [(start / NS, end / NS) for start, end in spans]


def stop_and_go(sway=()):
    """5 s rest, 20 s drive, 6 s stop, 20 s drive."""
    legs = [Leg(5.0, 0.0), Leg(4.0, 8.0), Leg(12.0, 8.0, 40.0), Leg(4.0, 0.0), Leg(6.0, 0.0), Leg(4.0, 8.0)]
    return Trajectory(Legs([*legs, Leg(12.0, 8.0, -30.0), Leg(4.0, 0.0)]), sway=sway, sway_speed=8.0)


def test_the_rests_of_a_drive_and_nothing_else():
    samples = ride(stop_and_go(motions.SPRINGS))
    rests = found(samples, "car")
    (first, stop) = seconds(rests.rests())[:2]
    assert first[0] == 0.0 and 4.5 < first[1] < 5.2
    assert 24.9 < stop[0] < 25.7 and 30.5 < stop[1] < 31.2
    assert rests.spans() == rests.rests() and not rests.on_foot
    # a rest found is sure to a centimetre a second; elsewhere nothing is known
    assert rests.speed_at(3 * NS) == REST_SPEED and np.isnan(rests.speed_at(10 * NS))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scenario", ["phone-car-5min", "trolley-loop"])
def test_no_false_rest_on_wheels(scenario, seed):
    session = simulate(scenario, seed)
    noise = session.calibration.imu_noise
    rests = find_standstills(session.imu, None, (), session.device.vehicle, noise, GRAVITY, StandstillConfig())
    at = session.reference.t_ns
    speed = np.linalg.norm(session.reference.velocity, axis=1)
    still = np.array([np.isfinite(rests.speed_at(int(t))) for t in at])
    assert speed[still].max(initial=0.0) < 0.1  # m/s: a wheel that begins to roll
    listed = session.static
    rest = [start for start, end in zip(listed.t_ns, listed.t_end_ns, strict=True) if end - start > 3 * NS]
    assert len(rest) > 0 and all(any(a - 2 * NS < r < b for a, b in rests.spans()) for r in rest)


def test_steady_travel_on_real_roads_is_no_rest(dataset, kitti):
    noise = DEVICE_CLASSES["mems"]
    motorway = readers.read(dataset("car_comma2k19"))
    assert not found(motorway.imu, noise=noise).still.any()  # never below 8 m/s
    gaps = find_gaps(kitti.imu.t_ns, np.hstack([kitti.imu.gyro, kitti.imu.accel]))
    rests = found(kitti.imu, gaps=gaps, noise=noise)
    fixes = kitti.nav_position(kitti.gnss)
    speed = np.linalg.norm(np.diff(fixes, axis=0), axis=1) / (np.diff(kitti.gnss.t_ns) / NS)
    for start, end in rests.spans():
        assert np.interp([start, end], kitti.gnss.t_ns[1:], speed).max() < 1.0


def test_gaps_are_no_rest():
    samples = ride(motions.static(20.0))
    rests = found(samples, gaps=[Gap(5 * NS, 7 * NS, "bridged")])
    assert seconds(rests.spans()) == [(0.0, pytest.approx(4.9, abs=0.4)), (pytest.approx(7.1, abs=0.4), 19.99)]


@pytest.mark.parametrize(
    ("mounting", "swing", "spin"),
    [("body", 0.015, 0.0), ("foot", 0.06, 0.0), ("body", 0.0, 0.05), ("foot", 0.0, 0.05)],
    ids=["swings", "foot swings", "spins", "foot spins"],
)
def test_a_device_that_turns_slowly_is_not_at_rest(mounting, swing, spin):
    # rad/s, a sine of 1 Hz and a constant, a few times the limits; the force is gravity alone
    still = ride(motions.static(20.0))
    rate = np.outer(swing * np.sin(2 * np.pi * still.t_ns / NS) + spin, [0.0, 0.0, 1.0])
    assert len(found(still, mounting=mounting).rests()) == 1
    assert not found(replace(still, gyro=still.gyro + rate), mounting=mounting).rests()


def test_a_rest_holds_no_turn_only_where_the_data_say_so():
    # a listed stop during which the device is handled: no velocity, but turns
    trajectory = motions.figure_eight(20.0)
    listed = StaticPeriod(t_ns=[8 * NS], t_end_ns=[10 * NS], sigma_v=[0.05])
    rests = found(ride(trajectory), listed=listed)
    assert rests.speed_at(9 * NS) == 0.05 and np.isnan(rests.over(rests.turn_sigma, 8 * NS, 10 * NS))
    assert np.isfinite(rests.over(rests.turn_sigma, NS, 3 * NS))  # the rest before
    only = found(ride(trajectory), listed=listed, detect=False)
    assert seconds(only.spans()) == [(8.0, 10.0)] and not only.rests()
    assert not find_standstills(
        ride(trajectory), listed, (), "none", PHONE, GRAVITY, StandstillConfig(use_listed=False, detect=False)
    ).still.any()


def foot(strides=30, stance=0.5, swing=0.6, hertz=200.0, seed=1, rolling=0.0):
    """A foot that stands and swings in turn: (samples, mask of the stances). Gravity on z; 3 s of rest first."""
    rng = np.random.default_rng(seed)
    part = np.concatenate(
        [np.zeros(round(3 * hertz)), np.tile([0.0] * round(stance * hertz) + [1.0] * round(swing * hertz), strides)]
    )
    n, dt = len(part), 1.0 / hertz
    phase = np.zeros(n)
    for first, last in runs(part > 0):
        phase[first:last] = np.linspace(0.0, 2 * np.pi, last - first)
    rate = np.zeros((n, 3))
    rate[:, 1] = 7.0 * np.sin(phase) + rolling * (part == 0)
    force = np.tile([0.0, 0.0, GRAVITY], (n, 1))
    force[:, 0] += 20.0 * np.sin(phase)
    force[:, 2] += 15.0 * np.sin(2 * phase)
    rate, force = rate + rng.normal(0, 0.005, (n, 3)), force + rng.normal(0, 0.03, (n, 3))
    return Imu(t_ns=np.rint(np.arange(n) * dt * NS).astype(np.int64), gyro=rate, accel=force), part == 0


# the force hardly changes at its own extremes, which a variance takes for rest
@pytest.mark.parametrize(("detector", "false"), [("shoe", 0.06), ("are", 0.06), ("amv", 0.3)])
def test_the_stances_of_a_foot(detector, false):
    samples, stands = foot()
    rests = found(samples, "foot", detector=detector)
    assert rests.on_foot
    # stances are found but for the samples at their ends, and hardly anything of the swing is taken for one
    assert rests.still[stands].mean() > 0.85
    assert rests.still[~stands].mean() < false
    assert detector == "amv" or len(rests.spans()) in (30, 31)  # the recording ends with a swing
    # truly at rest before the first step and in pauses, not in each stance
    assert seconds(rests.rests())[0][0] == 0.0 and len(rests.rests()) < 3


def test_a_rolling_foot_is_less_sure():
    slow, fast = (np.nanmedian(stance_speed(foot(rolling=rate)[0], GRAVITY)[700:]) for rate in (0.3, 1.2))
    # 3 cm from the point the foot turns about
    assert slow == pytest.approx(0.03 * 0.3, rel=0.3, abs=0.002) and fast == pytest.approx(0.03 * 1.2, rel=0.3)


def test_who_walks_with_a_phone_in_the_hand_is_not_on_foot():
    session = simulate("walk-60s", 0)
    rests = find_standstills(session.imu, None, (), "foot", PHONE, GRAVITY, StandstillConfig())
    assert not rests.on_foot
    declared = find_standstills(session.imu, None, (), "foot", PHONE, GRAVITY, StandstillConfig(mounting="foot"))
    assert declared.on_foot


@pytest.mark.parametrize("vehicle", ["car", "trolley"])
def test_wheels_are_no_feet(vehicle):
    assert not found(foot()[0], vehicle).on_foot


def on_foot(source):
    session = readers.read(source)
    noise = DEVICE_CLASSES["mems"]
    return find_standstills(session.imu, None, (), "foot", noise, session.gravity, StandstillConfig()).on_foot


WALKS = (
    *("2017-11-22-11-22-03", "2017-11-22-11-49-29", "2017-12-15-18-01-51", "2018-02-09-11-32-01"),
    "SensorConnectData_31",
)


@pytest.mark.parametrize("walk", WALKS)
def test_a_walking_foot_is_recognised(dataset, walk):
    file = dataset("foot_pyshoe_vicon") / f"{walk}_LLIO.mat"
    if not file.exists():
        pytest.skip(f"{file.name} is not there")
    assert on_foot(file)


@pytest.mark.parametrize("walk", ["2017-11-22-11-27-30", "2017-11-27-11-25-12"])
def test_a_runner_and_a_slow_walker_are_recognised(dataset, walk):
    """Without the declaration of the reader too."""
    file = dataset("foot_pyshoe_vicon") / f"{walk}_LLIO.mat"
    if not file.exists():
        pytest.skip(f"{file.name} is not there")
    assert on_foot(file)
    rests = prepare(readers.read(file), Config(run=RunConfig(initial="0,0,0,0"))).rests
    assert rests is not None and rests.on_foot


def test_real_feet_and_hands_are_distinguished(dataset):
    assert all(on_foot(f"{dataset('foot_dual_zupt')}#{foot}") for foot in ("left", "right"))
    phones = ("android/Jakob_Nexus5_NoDist_Texting", "ios/Guillaume_iPhone5_NoDist_Texting")
    assert not any(on_foot(dataset("phone_mocap_tyrex") / phone) for phone in phones)


def in_the_hand(seconds=20.0, hertz=100.0):
    """Somebody stands: the hand trembles at one hertz by half a centimetre and three degrees."""
    t = np.arange(0.0, seconds, 1.0 / hertz)
    wave = np.stack([np.sin(2 * np.pi * t + phase) for phase in (0.0, 1.0, 2.0)], axis=1)
    rate, force = 0.1 * wave, 0.15 * wave + [0.0, 0.0, GRAVITY]
    return Imu(t_ns=np.rint(t * NS).astype(np.int64), gyro=rate, accel=force)


def test_who_stands_with_a_device_in_the_hand_has_no_speed_but_turns():
    samples = in_the_hand()
    rests = found(samples, "foot")
    assert seconds(rests.spans()) == [(0.0, 19.99)] and not rests.rests()
    assert set(rests.speed_sigma) == {HAND_SPEED}
    assert not found(samples, "foot", standing=False).still.any()
    for vehicle in ("none", "car", "trolley"):  # a smooth ride trembles no more
        assert not found(samples, vehicle).still.any()
    walking = replace(samples, gyro=3.0 * samples.gyro, accel=samples.accel + 3.0 * (samples.accel - [0, 0, GRAVITY]))
    assert not found(walking, "foot").still.any()


@pytest.mark.parametrize("made", ["wheels", "foot", "hand"])
def test_nothing_rests_on_what_comes_later_than_the_lookahead(made):
    samples, vehicle = (ride(stop_and_go()), "car") if made == "wheels" else (foot()[0], "foot")
    if made == "hand":
        samples = in_the_hand(40.0)
        moving = (samples.t_ns // (5 * NS)) % 2 == 1  # stands and walks in turn
        samples = replace(samples, gyro=samples.gyro * np.where(moving, 5.0, 1.0)[:, None])
    options = {"mounting": "foot"} if made == "foot" else {}
    whole = found(samples, vehicle, **options)
    for cut_s in (4.6, 8.3, 26.4, 30.9):
        shorter = samples.take(samples.t_ns <= round(cut_s * NS))
        part = found(shorter, vehicle, **options)
        known = shorter.t_ns <= round((cut_s - LOOKAHEAD_S) * NS)
        for name in ("speed_sigma", "turn_sigma"):
            now, then = getattr(whole, name)[: len(known)][known], getattr(part, name)[known]
            np.testing.assert_allclose(now, then, rtol=1e-9)


def test_stamps_of_keyframes():
    t_ns = np.arange(11) * NS
    speed = np.array([np.nan, 1, 1, 1, np.nan, np.nan, 1, np.nan, np.nan, np.nan, 1])
    rests = Standstills(t_ns, speed, speed)
    assert seconds(rests.spans()) == [(1, 3), (6, 6), (10, 10)]
    assert (rests.keyframes() / NS).tolist() == [1, 3, 6, 10]
    assert (rests.keyframes(0.9) / NS).tolist() == pytest.approx([1, 1 + 2 / 3, 1 + 4 / 3, 3, 6, 10])
    # between two samples both must stand still
    assert rests.speed_at(round(1.5 * NS)) == 1 and np.isnan(rests.speed_at(round(3.5 * NS)))
    assert rests.over(speed, NS, 3 * NS) == 1 and np.isnan(rests.over(speed, NS, 4 * NS))
    assert np.isnan(rests.speed_at(-NS)) and rests.speed_at(10 * NS) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"detector": "zvd"}, "detector = 'zvd'; expected one of shoe, are, amv"),
        ({"mounting": "hand"}, "mounting = 'hand'; expected one of auto, foot, body"),
        ({"floor_sigma": 0.0}, "floor_sigma = 0.0; expected > 0 m"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ConfigError, match=message):
        StandstillConfig(**options)


def test_too_short_and_odd_recordings():
    for n in (2, 3, 30):
        samples = ride(motions.static(10.0)).take(slice(0, n))
        assert not found(samples).still.any()
    slow = ride(motions.static(60.0), hertz=5.0)  # a tenth of a second without a sample says nothing
    assert not found(slow).still.any()
    assert found(ride(motions.static(60.0), hertz=10.0)).still.all()
    upside = replace(samples := ride(motions.static(10.0)), accel=1.2 * samples.accel)
    assert not found(upside).still.any()  # 20 % more than gravity is no rest


def test_a_replay_decides_by_the_first_seconds_whether_a_device_is_on_a_foot():
    given = foot()[0], None, (), "none", PHONE, GRAVITY, StandstillConfig()
    assert not find_standstills(*given, available_ns=3 * NS).on_foot
    assert find_standstills(*given, available_ns=20 * NS).on_foot


def test_stamps_inside_a_standstill_do_not_wait_for_its_end():
    t_ns = np.arange(101) * NS // 10
    rests = [Standstills(t_ns[:n], np.zeros(n), np.zeros(n)) for n in (48, 101)]
    early, late = (rest.keyframes(0.9, causal=True) / NS for rest in rests)
    assert early[:-1].tolist() == late[: len(early) - 1].tolist() == pytest.approx([0, 0.9, 1.8, 2.7, 3.6, 4.5])


def phones(folder):
    """Specific force and rate of phones carried in many ways, on one clock each."""
    for file in sorted(folder.glob("*.csv.gz")):
        lines = [line.split(",") for line in gzip.decompress(file.read_bytes()).decode().splitlines()]
        force, rate = (np.array([row[1:] for row in lines if row[0] == name], dtype=float) for name in ("acce", "gyro"))
        force = force[np.concatenate([[True], np.diff(force[:, 0]) > 0])]
        gyro = np.stack([np.interp(force[:, 0], rate[:, 0], column) for column in rate.T[1:]], axis=-1)
        yield file.name, Imu(t_ns=(force[:, 0] * NS).astype(np.int64), accel=force[:, 1:], gyro=gyro)


@pytest.mark.slow
def test_phones_that_walk_and_run_are_on_no_foot(dataset):
    assert not [name for name, imu in phones(dataset("phone_placements")) if found(imu, "foot").on_foot]


def test_a_declared_foot_without_a_stance_is_an_error():
    session = simulate("phone-car-5min")
    device = replace(session.device, mounting="foot", vehicle="none")
    t_ns = session.imu.t_ns
    rate = np.where(np.arange(len(t_ns)) // 25 % 2, 5.0, -5.0)[:, None] * [0.6, 0.5, 0.6]  # never at rest
    shaken = replace(session.imu, gyro=rate)
    with pytest.raises(SessionError, match="no stance was found"):
        prepare(session.replace(device=device, imu=shaken, static=None), Config())

"""Steady travel that looks like a standstill: what fixes, wheels and images refute, and what they do not."""

from dataclasses import replace

import numpy as np
import pytest
from sessions import truth

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.session.detect.moving import _Speeds
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import GnssFix, Imu, WheelSpeed
from smartnav_graph.vision.pairs import Pairs
from smartnav_graph.vision.zero_motion import moving_spans

SECONDS = 120


def quiet(speed=0.0, noise=0.05, error=None, seed=0, seconds=SECONDS, **gnss) -> Session:
    """A device without acceleration and turn, that moves north-east; fixes of 3 m at 1 Hz unless `error` (n, 3)."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.02)
    force = np.array([0.0, 0.0, 9.81]) + rng.normal(0.0, noise, (len(t), 3))
    imu = Imu(t_ns=(t * NS).astype(np.int64), accel=force, gyro=rng.normal(0.0, 0.002, (len(t), 3)))
    at = np.arange(seconds, dtype=float)
    error = rng.normal(0.0, 3.0, (seconds, 3)) if error is None else error
    enu = np.outer(at, [speed / np.sqrt(2.0), speed / np.sqrt(2.0), 0.0]) + error
    return Session(imu=imu, gnss=GnssFix(t_ns=(at * NS).astype(np.int64), enu=enu, **gnss), gravity_m_s2=9.81)


def at_rest_s(session: Session, *, causal: bool = False) -> float:
    rests = prepare(session, Config(), causal=causal).rests
    return float(rests.still.mean()) * SECONDS


@pytest.mark.parametrize("speed", [1.0, 9.9])
@pytest.mark.parametrize("noise", [0.05, 0.2])  # m/s^2: one standstill, and many short ones
def test_fixes_refute_a_standstill_at_constant_velocity(speed, noise):
    assert at_rest_s(quiet(0.0, noise)) > 30.0
    assert at_rest_s(quiet(speed, noise)) < 1.0


@pytest.mark.parametrize("speed", [1.0, 9.9])
def test_the_path_at_constant_velocity(speed):
    run = sn.run(quiet(speed))
    assert run.summary["path_m"] == pytest.approx(speed * SECONDS, rel=0.03)
    assert any(text.startswith("standstill") and "gnss show motion" in text for text in run.summary["warnings"])


def test_the_path_of_the_recorded_case(dataset):
    run = sn.run(sn.load(dataset("hard_cases/const_velocity_cv_slow1ms")))
    assert run.summary["path_m"] == pytest.approx(np.hypot(0.7, 0.7) * SECONDS, rel=0.03)


def _errors(kind: str, rng: np.random.Generator) -> np.ndarray:
    white, steps = rng.normal(size=(SECONDS, 3)), rng.normal(size=(SECONDS, 3))
    drift = 4.0 * white[0] * np.ones((SECONDS, 3))
    for k in range(1, SECONDS):
        drift[k] = np.exp(-1 / 60) * drift[k - 1] + 4.0 * np.sqrt(1 - np.exp(-2 / 60)) * steps[k]
    if kind == "drift":
        return drift + 0.1 * white
    if kind == "stale":
        return np.repeat(3.0 * white[::7], 7, axis=0)[:SECONDS]
    error = 3.0 * white
    if kind == "outliers":
        error[rng.random(SECONDS) < 0.2] += rng.normal(0.0, 100.0, 3)
    if kind == "burst":
        error[50:75] += [60.0, -40.0, 0.0]
    return error


@pytest.mark.parametrize("kind", ["white", "drift", "stale", "outliers", "burst"])
@pytest.mark.parametrize("seed", range(3))
def test_a_rest_with_poor_fixes_stays_one(kind, seed):
    session = quiet(error=_errors(kind, np.random.default_rng(seed)), seed=seed)
    assert at_rest_s(session) == pytest.approx(SECONDS, abs=0.1)
    assert at_rest_s(session, causal=True) > SECONDS - 5.0


def test_a_walk_with_stops_keeps_them():
    session = sn.simulate("trolley-loop", 0)
    rests = prepare(session, Config()).rests
    speed = np.linalg.norm(truth(session, session.reference.t_ns)[2], axis=1)
    stopped = float((speed < 0.01).mean())
    assert float(rests.still.mean()) > 0.9 * stopped > 0.05


def test_without_fixes_nothing_is_refuted():
    session = quiet(9.9)
    early = session.replace(gnss=session.gnss.take(session.gnss.t_ns < 3 * NS))
    config = replace(Config(), keyframes=replace(Config().keyframes, lead_s=SECONDS))
    assert float(prepare(early, config).rests.still.mean()) == 1.0


def test_a_replay_decides_by_what_is_known():
    session, cut_ns = quiet(1.0, error=np.random.default_rng(1).normal(0.0, 1.0, (SECONDS, 3))), 70 * NS
    until = session.replace(
        imu=session.imu.take(session.imu.t_ns <= cut_ns), gnss=session.gnss.take(session.gnss.t_ns <= cut_ns)
    )
    whole, part = (prepare(one, Config(), causal=True).rests for one in (session, until))
    count = int(np.searchsorted(whole.t_ns, cut_ns - NS))
    assert np.array_equal(whole.still[:count], part.still[:count])
    assert not whole.still[count]


def test_wheels_refute_a_standstill():
    session = quiet()
    t = np.arange(0.0, SECONDS, 0.1)
    turning = (t > 60.0) & (t < 80.0)
    wheel = WheelSpeed(t_ns=(t * NS).astype(np.int64), speed=np.where(turning, 2.0, 0.0))
    assert at_rest_s(session.replace(wheel=wheel)) == pytest.approx(SECONDS - 20.0, abs=2.0)
    slip = replace(wheel, speed=np.where(np.arange(len(t)) % 50 == 0, 2.0, 0.0))  # single wrong readings
    assert at_rest_s(session.replace(wheel=slip)) == pytest.approx(SECONDS, abs=0.1)


@pytest.mark.parametrize(("share", "moves"), [(1.0, True), (0.5, False), (0.0, False)])
def test_images_show_motion_where_nearly_all_points_move(share, moves):
    rng = np.random.default_rng(0)
    x0 = rng.uniform(-0.5, 0.5, (50, 2))
    x1 = x0 + np.where(np.arange(50)[:, None] < share * 50, [0.02, 0.0], 0.0)
    pairs = Pairs(np.array([0, NS]), np.array([[0, 1]]), x0, x1, np.zeros(50, dtype=np.intp))
    rest = [(-NS, 2 * NS)]
    assert moving_spans(pairs, rest).tolist() == ([[0, NS]] if moves else [])
    begun = [(NS // 2, 2 * NS)]  # the first image was taken before the standstill
    assert not len(moving_spans(pairs, begun)) and not len(moving_spans(pairs, []))


@pytest.mark.parametrize(("last_moving_s", "lost_s"), [(20, 0.0), (23, 4.0)])
def test_speeds_before_a_rest_do_not_refute_it(last_moving_s, lost_s):
    """Shaken for 20 s, with a speed once a second; one of a reading in the rest itself does."""
    session = quiet()
    shaken = (session.imu.t_ns < 20 * NS)[:, None] * np.random.default_rng(3).normal(0.0, 3.0, session.imu.accel.shape)
    session = session.replace(imu=replace(session.imu, accel=session.imu.accel + shaken))
    at = np.arange(SECONDS)
    wheel = WheelSpeed(t_ns=at * NS, speed=np.where(at <= last_moving_s, 2.0, 0.0))
    without = at_rest_s(session)
    assert without == pytest.approx(100.0, abs=1.0)
    assert at_rest_s(session.replace(wheel=wheel)) == pytest.approx(without - lost_s, abs=1.0)


def test_a_stop_with_one_reading_in_it_is_not_refuted_by_those_around_it():
    t_ns = np.arange(20) * NS
    speed = np.where(np.arange(20) == 10, 0.0, 5.0)[:, None]
    readings = _Speeds(t_ns, t_ns, speed, np.full(20, 0.05))
    assert not list(readings.moving(round(9.6 * NS), round(10.4 * NS)))
    assert list(readings.moving(round(4.6 * NS), round(5.4 * NS)))

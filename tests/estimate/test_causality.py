"""What comes later than the declared look-ahead changes no state of a replay: every sensor, and every decision that a
batch run takes by the whole recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from sessions import recorded, with_gnss, with_imu

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.graph.solution import Solution
from smartnav_graph.smoothers.incremental import ReplayConfig

CONFIG = replace(Config(), replay=ReplayConfig(polish=False))
LARGEST_LOOKAHEAD_S = 1.0
# s, behind the 30 s of the initialisation
CUT_S = 36.3


def until(session: sn.Session, seconds: float) -> sn.Session:
    """The recording as if it had been stopped."""
    end = session.t0_ns + round(seconds * NS)
    cut = {name: stream.take(stream.t_ns <= end) for name, stream in session.streams().items()}
    return session.replace(**{name: stream if len(stream) else None for name, stream in cut.items()})


def assert_same_beginning(one: Solution, other: Solution, until_s: float) -> None:
    """Every keyframe up to a time, its state and covariance."""
    known = one.seconds <= until_s
    count = int(known.sum())
    assert count > 4 and np.array_equal(one.t_ns[:count], other.t_ns[:count])
    assert (other.seconds[count:] > until_s).all()
    for name in ("nav_t_body", "nav_R_body", "nav_v_body", "accel_bias", "gyro_bias", "covariance"):
        scale = np.abs(getattr(one, name)[known]).max()
        np.testing.assert_allclose(getattr(one, name)[known], getattr(other, name)[:count], atol=1e-9 * max(scale, 1.0))


@pytest.mark.parametrize("scenario", ["walk-all-2min", pytest.param("car-all-2min", marks=pytest.mark.slow)])
def test_no_sensor_looks_further_ahead_than_a_second(scenario):
    """All streams cut off at 36 s and at 45 s."""
    session = sn.simulate(scenario)
    one, other = (sn.run(until(session, seconds), CONFIG, causal=True).causal for seconds in (CUT_S, 45.0))
    assert_same_beginning(one, other, CUT_S - LARGEST_LOOKAHEAD_S)


def _wheel_that_counts_backwards_later() -> sn.Session:
    """A car declared the wrong way round, so that its wheels turn backwards all the time; only after 60 s a reading
    shows that they have a sign."""
    session = sn.simulate("car-all-2min")
    wheel = session.wheel
    later = wheel.t_ns > session.t0_ns + 60 * NS
    speed = np.where(later, -1.0, 1.0) * np.abs(wheel.speed)
    return session.replace(device=replace(session.device, forward="-y"), wheel=replace(wheel, speed=speed))


def _walk_that_is_short() -> sn.Session:
    """A walk of 25 s, then a device that lies still: of two minutes, too little to be a walk."""
    session = sn.simulate("walk-all-2min")
    imu, lying = session.imu, session.imu.t_ns > session.t0_ns + 25 * NS
    accel = np.where(lying[:, None], [0.0, 0.0, 9.81], imu.accel)
    session = with_imu(session, accel=accel, gyro=np.where(lying[:, None], 0.0, imu.gyro))
    return session.replace(device=replace(session.device, vehicle="none"), barometer=None, magnetometer=None)


def _fixes_far_apart() -> sn.Session:
    """Keyframes between fixes 7.4 s apart must not wait for the next one to be placed."""
    session = recorded(rate_hz=5.0)
    return session.replace(gnss=session.gnss.take(np.arange(len(session.gnss.t_ns)) % 37 == 0))


def _fixes_that_grow_better() -> sn.Session:
    """Fixes of a code receiver, then twice as many of centimetres: the median of all is that of a carrier phase."""
    session = recorded(seconds=110.0, white_m=2.0, markov_m=3.0, markov_s=60.0)
    sigma = session.gnss.sigma.copy()
    sigma[session.gnss.t_ns > session.t0_ns + 40 * NS] = 0.02
    return with_gnss(session, sigma=sigma)


def _gaps() -> sn.Session:
    """One before the cut and one after it."""
    session = recorded()
    seconds = (session.imu.t_ns - session.t0_ns) / NS
    return session.replace(imu=session.imu.take(~((abs(seconds - 20.3) < 0.7) | (abs(seconds - 50.3) < 0.7))))


LATER: dict[str, Callable[[], sn.Session]] = {
    "the sign of a wheel": _wheel_that_counts_backwards_later,
    "a walk": _walk_that_is_short,
    "keyframes": _fixes_far_apart,
    "correlated fixes": _fixes_that_grow_better,
    "gaps": _gaps,
}


@pytest.mark.parametrize("decision", LATER)
def test_no_decision_is_taken_by_what_comes_later(decision):
    whole = LATER[decision]()
    one, other = (sn.run(session, CONFIG, causal=True).causal for session in (until(whole, CUT_S), whole))
    assert_same_beginning(one, other, CUT_S - LARGEST_LOOKAHEAD_S)


@pytest.mark.parametrize("decision", ["the sign of a wheel", "a walk"])
def test_a_batch_run_takes_them_by_the_whole_recording(decision):
    """The cases above are no cases if both decide the same."""
    problem = prepare(LATER[decision](), CONFIG)
    causal = prepare(LATER[decision](), CONFIG, causal=True)
    name = {"the sign of a wheel": "wheel", "a walk": "steps"}[decision]
    then, now = (next((b for b in p.builders if b.name == name), None) for p in (problem, causal))
    assert now is not None and now.causal
    at = problem.session.t0_ns + 30 * NS
    if name == "wheel":
        assert now._unsigned(at) and not then._unsigned(at) and not now._unsigned(at + 60 * NS)
    else:
        assert then is None and now.walks(at) and not now.walks(at + 80 * NS)


@pytest.mark.parametrize("scenario", ["walk-all-2min", "car-all-2min"])
def test_the_look_ahead_is_declared_and_counts_as_delay(scenario):
    problem = prepare(sn.simulate(scenario), CONFIG, causal=True)
    declared = {builder.name: builder.lookahead_s for builder in problem.builders}
    assert 0.0 < max(declared.values()) <= LARGEST_LOOKAHEAD_S
    expected = {"static": 1.0, "vehicle": 1.0, "wheel": 0.2, "velocity": 0.5, "barometer": 0.5, "steps": 0.97}
    assert {name: s for name, s in declared.items() if s} == {
        name: pytest.approx(s) for name, s in expected.items() if name in declared
    }


def test_the_delay_is_at_least_the_look_ahead():
    session = until(recorded(), 40.0)
    given = replace(CONFIG, run=replace(CONFIG.run, initial="0,0,0,90,1,5"))
    summary = sn.run(session, given, causal=True).summary
    assert summary["lookahead_s"] == 1.0 and summary["delay_s"] >= 1.0

"""The verdict: good on clean recordings, and not where something is wrong, with the right reason."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from planted_faults import inertial_noise

import smartnav_graph as sn
from smartnav_graph.estimate.result import verdict as verdicts
from smartnav_graph.estimate.result.predictions import interpolated
from smartnav_graph.estimate.result.score_tests import SensorError
from smartnav_graph.estimate.reweight.image_pair_outliers import Account
from smartnav_graph.factors.coplanarity import CONTRARY, IN_USE, REASONS
from smartnav_graph.simulation.degrade import Degrade, degrade

NS = 10**9


def inertial(session, change):
    gyro, accel = change(session.imu.gyro, session.imu.accel)
    return session.replace(imu=replace(session.imu, gyro=gyro, accel=accel))


def moved(session, shift):
    enu = session.nav_position(session.gnss) + shift
    return session.replace(gnss=replace(session.gnss, lla=None, enu=enu))


@pytest.fixture(scope="module")
def drive(kitti):
    """Two minutes of a drive."""
    cut = kitti.t0_ns + 130 * NS
    imu, gnss = kitti.imu, kitti.gnss
    return kitti.replace(imu=imu.take(imu.t_ns < cut), gnss=gnss.take(gnss.t_ns < cut))


def verdict(session) -> tuple[str, str]:
    found = sn.run(session).summary["verdict"]
    for reason in found["reasons"]:
        assert set(reason) == {"level", "sensor", "text", "remedy", "size", "start_s", "end_s"}
        assert reason["text"] and reason["remedy"]
    return found["level"], " | ".join(f"{reason['sensor']}: {reason['text']}" for reason in found["reasons"])


@pytest.mark.parametrize("scenario", ["car-10min", "figure-eight-60s", "trolley-loop", "walk-60s"])
def test_clean_simulations_are_good(scenario):
    assert verdict(sn.simulate(scenario, seed=3)) == ("good", "")


def test_a_clean_drive_is_good(drive):
    assert verdict(drive) == ("good", "")
    assert verdict(degrade(drive, Degrade(gnss_white=3.0, gnss_gm=(4.0, 60.0)), 1))[0] == "good"


FAULTS = {
    "gyro sign": (lambda s: inertial(s, lambda g, a: (-g, a)), "contradictory", "gyro"),
    "axes exchanged": (lambda s: inertial(s, lambda g, a: (g[:, [1, 0, 2]], a[:, [1, 0, 2]])), "contradictory", "imu"),
    "reversed fixes": (lambda s: moved(s, s.nav_position(s.gnss)[::-1] - s.nav_position(s.gnss)), None, ""),
    "18 s late": (
        lambda s: s.replace(gnss=replace(s.gnss, t_ns=s.gnss.t_ns + 18 * NS).take(slice(0, -18))),
        "doubtful",
        "GPS time against UTC",
    ),
    "a multipath stretch": (
        lambda s: moved(s, np.where(np.arange(len(s.gnss))[:, None] // 25 == 2, 130.0, 0.0) * [1.0, 0.0, 0.0]),
        None,
        "in a row were rejected",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_not_good(drive, fault):
    change, level, word = FAULTS[fault]
    found, text = verdict(change(drive))
    assert found != "good" and (level is None or found == level) and word in text, text


def test_samples_that_scatter_are_no_good_even_where_that_is_found():
    level, text = verdict(inertial_noise(10.0)(sn.simulate("figure-eight-60s", 3), np.random.default_rng(0)))
    assert level != "good" and "times as much as those of its class" in text


@pytest.mark.parametrize(("kept", "contrary", "refused", "word"), [(80, 20, "", "20 %"), (0, 9, "why", "none is used")])
def test_images_that_contradict_the_other_sensors_count(monkeypatch, kept, contrary, refused, word):
    reasons = {**dict.fromkeys(REASONS, 0), REASONS[IN_USE]: kept, REASONS[CONTRARY]: contrary}
    monkeypatch.setattr(verdicts, "pair_account", lambda *_: Account(reasons, 0, refused))
    inputs = SimpleNamespace(solved=SimpleNamespace(problem=SimpleNamespace(builders=()), pass_state=None))
    assert word in next(iter(verdicts._images(inputs))).text
    reasons |= {REASONS[IN_USE]: 100, REASONS[CONTRARY]: 5}
    monkeypatch.setattr(verdicts, "pair_account", lambda *_: Account(reasons, 0, ""))
    assert not list(verdicts._images(inputs))


@pytest.mark.parametrize(
    ("error", "counts"),
    [
        (SensorError("gnss", "clock jump", value=3.0, sigma=0.1, t_ns=0), True),
        (SensorError("gnss", "clock jump", value=178.0, sigma=5.0, t_ns=0), False),  # nothing moves
        (SensorError("imu", "gyro scale", "y", value=-0.04, sigma=0.001), True),
    ],
)
def test_errors_without_a_state_count_where_they_are_clear_and_what_they_seem(monkeypatch, error, counts):
    monkeypatch.setattr(verdicts, "sensor_errors", lambda _: [error])
    session = SimpleNamespace(device=SimpleNamespace(forward="+x"), seconds=lambda t_ns: 0.0)
    solved, fit = SimpleNamespace(problem=SimpleNamespace(session=session)), SimpleNamespace(per_dof=dict)
    inputs = SimpleNamespace(solved=solved, fit=fit, together=True, unmodelled=None)
    assert bool(list(verdicts._sensor_errors(inputs))) == counts


def test_fixes_of_two_places_in_turns_contradict_each_other():
    def reasons(residual: np.ndarray) -> list[str]:
        return [
            one.text for one in verdicts._two_places(SimpleNamespace(solved=SimpleNamespace(fixes=fixes(residual))))
        ]

    def fixes(residual: np.ndarray) -> dict[str, SimpleNamespace]:
        return {"gnss": SimpleNamespace(residual=residual)}

    rng = np.random.default_rng(0)
    noise, second = rng.normal(0.0, 3.0, (60, 3)), np.arange(60)[:, None] % 2
    assert not reasons(noise) and not reasons(rng.uniform(-3.0, 3.0, (60, 3))) and not reasons(noise[:30])
    assert not reasons(noise + np.where(np.arange(60)[:, None] % 10, 0.0, 40.0))  # outliers
    assert not reasons(np.round(rng.uniform(0.0, 1.0, (60, 3))))  # m, of a device at rest
    assert "fixes are alternately of two places, 2" in reasons(noise + second * [15.0, 20.0, 0.0])[0]
    assert "heights of the fixes" in reasons(noise + second * [0.0, 0.0, 47.0])[0]


def test_withheld_fixes_are_compared_with_the_line_and_the_cubic_between_the_kept_ones():
    t_ns = np.arange(0, 50, 5) * NS
    middle = t_ns[:-1] + 2 * NS
    kept, true = (np.stack([s**3, s**2, s], axis=-1) for s in (t_ns / NS, middle / NS))
    line, cubic = interpolated(middle, t_ns, kept)
    assert cubic == pytest.approx(true, abs=1e-6)  # m: a cubic spline without end conditions is exact on a cubic
    assert line[:, 2] == pytest.approx(true[:, 2]) and (line[:, 1] > true[:, 1] + 5.9).all()  # s (5 - s) = 6 m above
    assert all(curve[0] == pytest.approx(kept[0]) for curve in interpolated(t_ns[:1] - NS, t_ns, kept))

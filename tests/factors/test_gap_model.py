"""Bridges across gaps: what recorded stretches predict, and with what noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smartnav_graph.core.timebase import NS, Gap, ns_from_seconds
from smartnav_graph.factors.gap_model import FLOOR, UNKNOWN, Bridge, bridged, bridges
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.session.streams import Imu

NOISE = DEVICE_CLASSES["mems"]
GRAVITY = 9.81


def swinging(seconds: float = 300.0, noise: float = 0.0, seed: int = 0) -> Imu:
    """A turn rate and a force that swing with 4 to 9 s, and white noise; gravity on z. 100 Hz."""
    t = np.arange(round(100 * seconds)) / 100
    rng = np.random.default_rng(seed)
    waves = np.stack([np.sin(2 * np.pi * t / period + period) for period in (4.0, 6.0, 9.0)], axis=-1)
    accel = waves + [0, 0, GRAVITY] + noise * rng.standard_normal((len(t), 3))
    gyro = 0.3 * waves[:, ::-1] + 0.3 * noise * rng.standard_normal((len(t), 3))
    return Imu(t_ns=ns_from_seconds(t), accel=accel, gyro=gyro)


def hole(imu: Imu, start: int, rows: int, kind: str = "bridged") -> Gap:
    return Gap(int(imu.t_ns[start]), int(imu.t_ns[start + rows]), kind)


def straight(imu: Imu, gaps: list[Gap]) -> Imu:
    """The samples of the gaps replaced by straight lines, as somebody did."""
    accel, gyro = np.array(imu.accel), np.array(imu.gyro)
    for gap in gaps:
        i, j = np.searchsorted(imu.t_ns, [gap.start_ns, gap.end_ns])
        for rows in (accel, gyro):
            rows[i : j + 1] = np.linspace(rows[i], rows[j], j - i + 1)
    return replace(imu, accel=accel, gyro=gyro)


def mean(imu: Imu, gap: Gap) -> np.ndarray:
    """Mean (6,) of force and rate over the gap."""
    inside = (imu.t_ns >= gap.start_ns) & (imu.t_ns <= gap.end_ns)
    rows = np.concatenate([imu.accel, imu.gyro], axis=1)[inside]
    return np.trapezoid(rows, imu.t_ns[inside] / NS, axis=0) / gap.length_s


def test_a_swing_is_carried_on_across_the_gap():
    imu = swinging()
    gaps = [hole(imu, i, 160) for i in range(3000, 27000, 3100)]
    line = straight(imu, gaps)
    found = bridges(line, gaps, NOISE)
    error, drawn = (
        np.sqrt(np.mean([(guess(gap) - mean(imu, gap)) ** 2 for gap in gaps], axis=0))
        for guess in (lambda gap: found[gap.start_ns].expected[0], lambda gap: mean(line, gap))
    )
    assert (error < 0.1 * drawn).all(), (error, drawn)


@pytest.mark.parametrize("noise", [0.5, 2.0])
def test_the_noise_is_what_unseen_gaps_turn_out_to_cost(noise):
    imu = swinging(600.0, noise)
    gaps = [hole(imu, i, 160) for i in range(1500, 58000, 1000)]
    found = bridges(straight(imu, gaps), gaps, NOISE)
    error = np.array([found[gap.start_ns].expected[0] - mean(imu, gap) for gap in gaps])
    cost = np.sqrt((error**2).mean(axis=0) * gaps[0].length_s)  # as a density
    whole = found[gaps[0].start_ns].over(gaps[0].length_s)
    predicted = np.concatenate([whole.accel, whole.gyro])
    np.testing.assert_allclose(predicted, cost, rtol=0.5)


def drifting(seconds: float, seed: int) -> Imu:
    """Force ahead and to the left is a Gauss-Markov process of 0.6 m/s^2/sqrt(s) and 20 s; the yaw rate is a tenth
    of the force to the left; white noise of 0.05 m/s^2/sqrt(Hz) upwards. 50 Hz."""
    rng = np.random.default_rng(seed)
    n, dt = round(50 * seconds), 0.02
    accel, gyro = np.tile([0.0, 0.0, GRAVITY], (n, 1)), 1e-4 * rng.standard_normal((n, 3))
    for k in range(1, n):
        accel[k, :2] = accel[k - 1, :2] * np.exp(-dt / 20.0) + 0.6 * np.sqrt(dt) * rng.standard_normal(2)
    gyro[:, 2] += 0.1 * accel[:, 1]
    accel[:, 2] += 0.05 / np.sqrt(dt) * rng.standard_normal(n)
    return Imu(t_ns=ns_from_seconds(np.arange(n) * dt), accel=accel, gyro=gyro)


def test_random_walk_white_noise_and_correlation_are_separated():
    imu = drifting(900.0, 3)
    found = bridges(imu, [hole(imu, 20_000, 150)], NOISE)[int(imu.t_ns[20_000])]
    q = found.diffusion
    np.testing.assert_allclose(np.sqrt(np.diag(q)[:2]), 0.6, rtol=0.25)
    assert np.sqrt(q[5, 5]) == pytest.approx(0.06, rel=0.25)
    assert q[1, 5] / np.sqrt(q[1, 1] * q[5, 5]) > 0.95 and abs(q[0, 1]) < 0.3 * q[1, 1]
    assert found.accel[2] == pytest.approx(FLOOR * NOISE.accel_noise_density, rel=0.3)  # 0.09
    assert np.sqrt(q[2, 2] * 3.0**2 / 12.0) < found.accel[2]
    assert (np.linalg.eigvalsh(q) > -1e-12).all()


def test_a_bridge_over_one_window_has_the_noise_of_its_mean():
    """The mean of a Brownian bridge of diffusion q over T has the variance q T / 12, white noise D^2 / T."""
    diffusion = np.zeros((6, 6))
    diffusion[0, 0] = 0.49
    bridge = Bridge(np.full(3, 0.1), np.full(3, 0.02), None, diffusion)
    rng, T, n = np.random.default_rng(0), 2.0, 200
    walk = np.cumsum(0.7 * np.sqrt(T / n) * rng.standard_normal((4000, n)), axis=1)
    means = (walk - np.linspace(1 / n, 1, n) * walk[:, -1:]).mean(axis=1)
    whole = bridge.over(T)
    assert whole.accel[0] ** 2 / T == pytest.approx(0.01 / T + means.var(), rel=0.1)
    assert whole.accel[1] == pytest.approx(0.1) and not whole.diffusion.any()


def test_vibration_is_averaged():
    """Two single samples of noise sigma leave sigma / sqrt(2) in the mean of their line, means over 0.6 s far less."""
    rng = np.random.default_rng(2)
    n = 30_000
    imu = Imu(
        t_ns=ns_from_seconds(np.arange(n) / 100),
        accel=np.array([0, 0, GRAVITY]) + rng.standard_normal((n, 3)),
        gyro=0.1 * rng.standard_normal((n, 3)),
    )
    gap = hole(imu, 15_000, 160)
    found = bridges(imu, [gap], NOISE)[gap.start_ns]
    line = np.sqrt(0.5 * gap.length_s)
    assert (found.accel < 0.3 * line).all() and (found.gyro < 0.03 * line).all()


def test_a_bridge_has_at_least_the_noise_of_recorded_data():
    imu = Imu(
        t_ns=ns_from_seconds(np.arange(6000) / 100),
        accel=np.tile([0.0, 0.0, GRAVITY], (6000, 1)),
        gyro=np.zeros((6000, 3)),
    )
    gap = hole(imu, 3000, 150)
    found = bridges(imu, [gap], NOISE)[gap.start_ns]
    np.testing.assert_allclose(found.accel, FLOOR * NOISE.accel_noise_density)
    np.testing.assert_allclose(found.gyro, FLOOR * NOISE.gyro_noise_density)
    np.testing.assert_allclose(found.expected[0], [0, 0, GRAVITY, 0, 0, 0], atol=1e-6)


def test_samples_inside_a_gap_have_no_influence():
    imu = swinging(noise=0.5)
    gap, other = hole(imu, 5000, 160), hole(imu, 5200, 160)
    wild = np.array(imu.accel)
    for g in (gap, other):
        i, j = np.searchsorted(imu.t_ns, [g.start_ns, g.end_ns])
        wild[i + 1 : j] += 1000.0
    one, two = (bridges(x, [gap, other], NOISE)[gap.start_ns] for x in (imu, replace(imu, accel=wild)))
    np.testing.assert_allclose(two.expected[0], one.expected[0], rtol=1e-9)
    np.testing.assert_allclose(two.accel, one.accel, rtol=1e-9)


def test_a_gap_longer_than_the_rest_learns_from_shorter_stretches():
    imu = swinging(40.0, 0.5)
    gap = hole(imu, 1000, 2500)
    found = bridges(imu, [gap], NOISE)[gap.start_ns]
    assert found.expected is not None and found.accel.max() < UNKNOWN * NOISE.accel_noise_density


def test_two_samples_only():
    bare = Imu(t_ns=[0, 2 * NS], accel=np.zeros((2, 3)), gyro=np.zeros((2, 3)))
    found = bridges(bare, [Gap(0, 2 * NS, "missing")], NOISE)[0]
    assert found.expected is None
    assert (found.accel == UNKNOWN * NOISE.accel_noise_density).all()
    assert (found.gyro == UNKNOWN * NOISE.gyro_noise_density).all()


def test_a_gap_at_the_very_start_is_seen_from_its_end():
    imu = swinging(noise=0.2)
    late = imu.take((imu.t_ns == 0) | (imu.t_ns >= 2 * NS))
    gap = Gap(0, 2 * NS, "missing")
    found = bridges(late, [gap], NOISE)[0]
    assert np.abs(found.expected[0] - mean(imu, gap))[:3].max() < 4 * found.accel.max() / np.sqrt(gap.length_s)


@pytest.mark.parametrize("kind", ["missing", "bridged"])
def test_the_curve_has_the_mean_and_leaves_the_rest_alone(kind):
    imu = swinging(noise=0.1)
    gap = hole(imu, 5000, 160, kind)
    inside = (imu.t_ns > gap.start_ns) & (imu.t_ns < gap.end_ns)
    faulty = imu.take(~inside) if kind == "missing" else straight(imu, [gap])
    filled = bridged(faulty, [gap], bridges(faulty, [gap], NOISE))
    np.testing.assert_array_equal(filled.t_ns, imu.t_ns)
    np.testing.assert_allclose(filled.accel[~inside], imu.accel[~inside], atol=1e-9)
    np.testing.assert_allclose(mean(filled, gap), bridges(faulty, [gap], NOISE)[gap.start_ns].expected[0], atol=1e-4)


def test_without_gaps_nothing_changes():
    imu = swinging(5.0)
    assert bridged(imu, [], {}) is imu

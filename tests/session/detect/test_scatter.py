"""The scatter of fixes is that of their white noise, and an upper bound where they move."""

import numpy as np
import pytest

from smartnav_graph.session.detect.scatter import (
    LEAST_FIXES,
    LEAST_PIECES,
    agrees_with_neighbours,
    normalised_residuals,
    sampling_noise,
    scatter,
)
from smartnav_graph.session.streams import Imu

NS = 10**9


def stamps(n: int, step_s: float = 1.0) -> np.ndarray:
    return (np.arange(n) * step_s * NS).astype(np.int64)


def test_a_cubic_leaves_nothing() -> None:
    t_ns = np.sort(np.random.default_rng(0).integers(0, 60 * NS, 40))
    t = t_ns / NS
    position = np.stack([1 + 2 * t - 0.3 * t**2 + 0.01 * t**3, 5 - t], axis=1)
    left = normalised_residuals(t_ns, position)
    assert np.nanmax(np.abs(left)) < 1e-6
    assert np.isnan(left[[0, 1, -2, -1]]).all()


@pytest.mark.parametrize("dim", [1, 2])
def test_white_noise_is_found_whatever_the_speed_and_outliers(dim: int) -> None:
    rng = np.random.default_rng(1)
    t_ns = stamps(400)
    position = 12.0 * (t_ns / NS)[:, None] + rng.normal(0.0, 2.5, (400, dim))
    position[rng.choice(400, 20, replace=False)] += 300.0
    found = scatter(t_ns, position)
    assert found is not None and found.is_noise
    assert 0.85 * 2.5 < found.sigma < 1.45 * 2.5


@pytest.mark.parametrize("share", [0.2, 0.3])
def test_many_outliers_are_no_scatter(share: float) -> None:
    """They spoil most of the residuals, and look like white noise."""
    rng = np.random.default_rng(9)
    position = rng.normal(0.0, 2.5, (400, 2))
    position[rng.random(400) < share] += 100.0
    found = scatter(stamps(400), position)
    assert found is not None and 0.6 * 2.5 < found.sigma < 1.8 * 2.5


@pytest.mark.parametrize("rows", [40, 400])
def test_no_noise_is_left_out(rows: int) -> None:
    """Without outliers the scatter is that of all fixes."""
    sigmas = [scatter(stamps(rows), np.random.default_rng(k).normal(0.0, 2.5, (rows, 2))).sigma for k in range(20)]
    assert np.mean(sigmas) == pytest.approx(2.5, rel=0.1)


@pytest.mark.parametrize("rows", range(490, 600, 10))
def test_noise_that_changes_with_time_has_no_outliers(rows: int) -> None:
    """However many fixes there are: nearly half of them would have to be left out."""
    rng = np.random.default_rng(4)
    level = np.repeat(0.03 * np.exp(rng.normal(0.0, 1.3, 60)), 10)
    position = level[:, None] * rng.standard_normal((600, 2))
    found = scatter(stamps(600)[:rows], position[:rows])
    assert found is not None and found.is_noise


def test_motion_is_no_noise() -> None:
    t = np.arange(300.0)
    position = np.stack([20 * np.sin(0.9 * t), 20 * np.cos(0.9 * t)], axis=1)
    found = scatter(stamps(300), position + np.random.default_rng(2).normal(0.0, 0.02, position.shape))
    assert found is not None and not found.is_noise and found.sigma > 0.02


def test_motion_too_fast_for_the_fixes_is_no_noise() -> None:
    """At every spacing a cubic leaves the whole of it."""
    t = np.arange(300.0)
    swing = np.stack([20 * np.sin(1.2 * t), 20 * np.cos(1.2 * t)], axis=1)
    turns = np.random.default_rng(5).normal(0.0, 30.0, (300, 2))
    for position, step_s in ((swing, 1.0), (turns, 10.0)):
        found = scatter(stamps(300, step_s), position)
        assert found is not None and not found.is_noise


def test_slow_errors_do_not_show() -> None:
    rng = np.random.default_rng(3)
    slow = np.zeros((600, 2))
    for k in range(1, 600):
        slow[k] = np.exp(-1 / 60) * slow[k - 1] + rng.normal(0.0, 4.0 * np.sqrt(1 - np.exp(-2 / 60)), 2)
    found = scatter(stamps(600), slow + rng.normal(0.0, 3.0, slow.shape))
    assert found is not None and found.is_noise and 2.5 < found.sigma < 3.6


def test_repeated_and_few_fixes() -> None:
    rng = np.random.default_rng(4)
    position = rng.normal(0.0, 1.0, (50, 2))
    once = scatter(stamps(50), position)
    twice = scatter(stamps(100, 0.5), np.repeat(position, 2, axis=0))
    assert once is not None and twice is not None and once.rows == twice.rows == 50
    assert scatter(stamps(LEAST_FIXES - 1), position[: LEAST_FIXES - 1]) is None
    assert scatter(stamps(0), np.zeros((0, 2))) is None


def test_fixes_off_their_neighbours_do_not_agree_with_them() -> None:
    rng = np.random.default_rng(6)
    position = 10.0 * np.arange(100.0)[:, None] + rng.normal(0.0, 1.0, (100, 2))
    position[40] += 50.0
    position[60:80] += 100.0
    agrees = agrees_with_neighbours(stamps(100), position)
    assert not agrees[[0, 1, 40, 59, 60, 79, 80, 98, 99]].any()
    assert agrees[[10, 30, 50, 65, 70, 75, 90]].mean() > 0.8


@pytest.mark.parametrize("hertz", [10.0, 200.0])
def test_the_noise_between_inertial_samples_is_a_density_whatever_the_rate(hertz: float) -> None:
    """White noise of density d has d sqrt(rate) a sample; a steady turn and acceleration add nothing."""
    rng, n = np.random.default_rng(7), 4000
    t = np.arange(n) / hertz
    accel, gyro = 0.03 * np.sqrt(hertz) * rng.normal(size=(n, 3)), 0.002 * np.sqrt(hertz) * rng.normal(size=(n, 3))
    imu = Imu(t_ns=stamps(n, 1.0 / hertz), accel=accel + 0.01 * t[:, None], gyro=gyro + 1.0)
    assert sampling_noise(imu) == pytest.approx((0.03, 0.002), rel=0.1)
    assert sampling_noise(imu.take(slice(0, LEAST_PIECES * LEAST_FIXES - 1))) == (0.0, 0.0)


def test_vibration_of_an_engine_and_steps_are_no_white_noise() -> None:
    """Harmonics of 1 and 0.5 m/s^2 and a walk's bounce, in white noise of 0.01 m/s^2/sqrt(Hz)."""
    rng, n = np.random.default_rng(8), 6000
    t = np.arange(n) / 100.0
    shaken = np.sin(2 * np.pi * 27.0 * t) + 0.5 * np.sin(2 * np.pi * 41.0 * t) + 3.0 * np.sin(2 * np.pi * 1.8 * t)
    imu = Imu(
        t_ns=stamps(n, 0.01), accel=0.1 * rng.normal(size=(n, 3)) + shaken[:, None], gyro=0.01 * rng.normal(size=(n, 3))
    )
    assert sampling_noise(imu) == pytest.approx((0.01, 0.001), rel=0.15)

"""Sensors at rest: Allan deviation of published data, coverage of the sigmas, real recordings, refusals."""

from __future__ import annotations

import gzip
from dataclasses import replace

import numpy as np
import pytest
from simulated import DATASETS, Coverage, noise, real

import smartnav_graph as sn
from smartnav_graph.calibrate import static
from smartnav_graph.calibrate.allan import allan_deviation, cluster_sizes, confidence_limits
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.streams import Imu, Magnetometer, Temperature

DT, COUNT = 0.1, 60_000
# Of the order of the phone of the 2012 thesis; its gyro is zero at 40 deg C and drifts in proportion to temperature.
TERMS = {
    "accel": {"white": 3.9e-3, "bias_instability": 8e-4},
    "gyro": {"white": 2.5e-4, "bias_instability": 5e-5},
}
WALKING = {
    "accel": {"white": 3.9e-3, "random_walk": 2e-4, "quantisation": 2e-3},
    "gyro": {"white": 2.5e-4, "random_walk": 1e-5, "quantisation": 1.5e-4},
}
SLOPE, ZERO_C = (2.0e-4, 0.85e-4, -6.1e-4), 40.0
MAG = 0.5
OPTIONS = static.StaticOptions()


def at_rest(seed, terms=TERMS):
    rng, t = np.random.default_rng(seed), np.arange(COUNT) * DT
    at_c = 40 + 7.5 * np.sin(2 * np.pi * t / 3000)
    imu = {s: np.stack([noise(COUNT, DT, rng, **terms[s]) for _ in "xyz"], axis=1) for s in ("accel", "gyro")}
    t_ns = np.round(t * 1e9).astype(np.int64)
    return sn.Session(
        imu=Imu(
            t_ns=t_ns,
            accel=imu["accel"] + [0.0, 0.0, 9.93],
            gyro=imu["gyro"] + (at_c - ZERO_C)[:, None] * SLOPE,
        ),
        temperature=Temperature(t_ns=t_ns[::10], temperature_c=at_c[::10] + 0.05 * rng.standard_normal(COUNT // 10)),
        magnetometer=Magnetometer(t_ns=t_ns, field_ut=[20.0, 3.0, -44.0] + MAG * rng.standard_normal((COUNT, 3))),
    )


def covered(seeds):
    count = Coverage()
    for seed in seeds:
        kind = (TERMS, WALKING)[seed % 2]
        values = static.fit([at_rest(seed, kind)], OPTIONS).values
        for sensor, terms in kind.items():
            for i, axis in enumerate("xyz"):
                names = {"white": "white_noise"}
                for term, truth in terms.items():
                    label = names.get(term, term)
                    if f"{sensor}_{label}_{axis}" in values:
                        count.add(f"{sensor} {label}", values[f"{sensor}_{label}_{axis}"], truth)
                count.add(f"{sensor} ramp", values[f"{sensor}_rate_ramp_{axis}"], 0.0)
                slope = SLOPE[i] if sensor == "gyro" else 0.0
                count.add(f"{sensor} temperature", values[f"{sensor}_temperature_{axis}"], slope)
        count.add("heading", values["heading_noise"], np.degrees(MAG / np.hypot(20.0, 3.0)))
    return count


def test_sigmas_cover_the_truth():
    covered(range(4)).check()


@pytest.mark.slow
def test_sigmas_cover_the_truth_in_95_of_100():
    shares = covered(range(100, 200)).check()
    print(shares)
    for name, (share, count) in shares.items():
        assert 0.92 <= share <= 0.99, f"{name}: {share:.3f} of {count}"


def test_allan_deviation_of_the_numbers_of_nist():
    """Riley (2008), NIST SP 1065, Tables 30 and 31: 1000 numbers of a prime modulus generator."""
    numbers = [1234567890]
    for _ in range(999):
        numbers.append(16807 * numbers[-1] % 2147483647)
    readings = np.array(numbers)[:, None] / 2147483647.0
    found = allan_deviation(readings, np.array([1, 10, 100]))[:, 0]
    assert np.allclose(found, [2.922319e-01, 9.159953e-02, 3.241343e-02], rtol=2e-7)


def test_allan_deviation_is_that_of_allantools():
    allantools = pytest.importorskip("allantools")
    readings = np.random.default_rng(0).standard_normal((30_000, 2)).cumsum(axis=0)
    sizes = cluster_sizes(len(readings))
    found = allan_deviation(readings, sizes)
    for i in range(2):
        _, theirs, _, _ = allantools.oadev(readings[:, i], rate=100.0, data_type="freq", taus=sizes * 0.01)
        assert np.allclose(found[:, i], theirs, rtol=1e-9)


def test_confidence_limits_hold_the_expected_deviation():
    sizes, inside = np.array([1, 10, 100, 1000]), np.zeros(4)
    for seed in range(200):
        readings = np.random.default_rng(seed).standard_normal((10_000, 1))
        low, high = confidence_limits(allan_deviation(readings, sizes)[:, 0], sizes, len(readings))
        truth = 1 / np.sqrt(sizes)
        inside += (low <= truth) & (truth <= high)
    assert (inside / 200 > 0.89).all() and (inside[:3] / 200 < 0.99).all()


def test_a_calibration_takes_out_the_bias_of_the_temperature():
    session = at_rest(3)
    result = static.fit([session], OPTIONS)
    errors = result.change(Calibration()).imu_errors
    left = errors.corrected(session.imu, session.temperature).gyro
    slow = left.reshape(-1, 600, 3).mean(axis=1).std(axis=0)
    assert (slow < 3e-4).all()  # rad/s; 3e-3 on z before
    assert not result.warnings and "temperature" not in result.refused


def test_what_the_data_do_not_carry_is_refused():
    result = static.fit([at_rest(1, {s: {"white": t["white"]} for s, t in TERMS.items()})], OPTIONS)
    assert {"gyro_random_walk_x", "gyro_bias_instability_y"} <= set(result.refused)
    assert "record longer" in result.refused["gyro_random_walk_x"]
    constant = at_rest(1)
    still = np.full(len(constant.temperature), 25.0)
    found = static.fit([constant.replace(temperature=replace(constant.temperature, temperature_c=still))], OPTIONS)
    assert "constant within 0 deg C" in found.refused["temperature"]
    assert not any("temperature" in name for name in found.values)


def changed(session, **columns):
    return session.replace(imu=replace(session.imu, **columns))


def test_bad_recordings_are_named():
    clean = at_rest(2)
    imu, rng = clean.imu, np.random.default_rng(0)
    with pytest.raises(CalibrationError, match="gyro_y is constant"):
        static.fit([changed(clean, gyro=imu.gyro * [1, 0, 1])], OPTIONS)
    with pytest.raises(CalibrationError, match="accel_z is clipped"):
        static.fit([changed(clean, accel=np.minimum(imu.accel, [9, 9, 9.925]))], OPTIONS)
    moved = imu.accel + 3 * np.cumsum(rng.standard_normal((COUNT, 3)), axis=0) * np.sqrt(DT)
    with pytest.raises(CalibrationError, match="the device moved"):
        static.fit([changed(clean, accel=moved)], OPTIONS)
    with pytest.raises(CalibrationError, match=r"specific force at rest is 1\..*import it in m/s"):
        static.fit([changed(clean, accel=imu.accel / 9.8)], OPTIONS)
    step = 0.03
    coarse = static.fit([changed(clean, accel=np.round(imu.accel / step) * step)], OPTIONS)
    assert any("accel_x is quantised in steps of 0.03" in text for text in coarse.warnings)
    knocked = imu.accel.copy()
    knocked[30_000:33_000] += np.sin(np.arange(3000))[:, None]
    assert "moved 5 %" in static.fit([changed(clean, accel=knocked)], OPTIONS).warnings[0]
    smooth = np.apply_along_axis(lambda x: np.convolve(x, np.ones(8) / 8, "same"), 0, imu.gyro)
    smooth[:10], smooth[-10:] = smooth[10], smooth[-11]
    assert any(
        "low-passed" in text and "gyro_x" in text
        for text in static.fit([changed(clean, gyro=smooth)], OPTIONS).warnings
    )


@real("static_galaxy_s5")
def test_six_hours_of_a_phone_at_rest():
    data = np.load(DATASETS / "static_galaxy_s5" / "samsung_galaxy_s5_static_10Hz.npz")
    t_ns = np.arange(len(data["acc_mps2"])) * 10**8
    imu = Imu(t_ns=t_ns, accel=data["acc_mps2"].astype(float), gyro=data["gyro_measured_radps"].astype(float))
    result = static.fit([sn.Session(imu=imu)], OPTIONS)
    least = [np.degrees(result.values[f"gyro_allan_minimum_{a}"].value) for a in "xyz"]
    taus = [result.values[f"gyro_allan_minimum_tau_{a}"].value for a in "xyz"]
    white = [np.degrees(result.values[f"gyro_white_noise_{a}"].value) for a in "xyz"]
    assert all(0.003 < x < 0.007 for x in least) and all(400 < x < 1300 for x in taus)
    assert all(0.045 < x < 0.066 for x in white)  # deg/s/sqrt(Hz), as read at 10 to 20 s
    assert any("low-passed" in text for text in result.warnings)


@real("static_temperature_tag")
def test_three_days_of_a_tag_by_temperature():
    with gzip.open(DATASETS / "static_temperature_tag" / "cats_temperature_10s_means.csv.gz", "rt") as file:
        data = np.genfromtxt(file, delimiter=",", skip_header=1)
    t_ns = (data[:, 0] * 1e9).astype(np.int64)
    imu, heat = Imu(t_ns=t_ns, accel=data[:, 2:5], gyro=data[:, 5:8]), Temperature(t_ns=t_ns, temperature_c=data[:, 1])
    result = static.fit([sn.Session(imu=imu, temperature=heat)], static.StaticOptions(least_rest_s=600.0))
    slopes = [np.degrees(result.values[f"gyro_temperature_{a}"].value) for a in "xyz"]
    assert np.allclose(slopes, [-0.0035, 0.027, 0.007], rtol=0.1)
    assert "gyro_temperature_x" in result.refused  # within its noise: not used

"""Axes of a device: planted permutations, signs and angles are found; a motion that does not carry them is refused."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from simulated import Coverage
from test_calibrate_imu import handled

import smartnav_graph as sn
from smartnav_graph.calibrate.axes import AxesOptions, fit, parse_turns
from smartnav_graph.core.errors import CalibrationError, ConfigError
from smartnav_graph.session.streams import Imu, Magnetometer

G = np.array([0.0, 0.0, 9.81])
P = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # of the sensors in the device: x of the device along y
ANGLES = np.radians([1.5, -0.8, 0.6])
LEVER, LATE_S, FAST = np.array([0.1, -0.05, 0.02]), 3.7, 2e-5


def plate(seed, seconds=40.0, accel=P, gyro=P, about=(1.0, 1.0, 1.0)):
    """A device and a reference on one plate that is turned by hand; clocks that differ by lag and drift."""
    rng = np.random.default_rng(seed)
    knots = np.arange(0.0, seconds + 12, 0.7)
    path = CubicSpline(knots, np.cumsum(0.5 * rng.standard_normal((len(knots), 3)), axis=0) * about)
    place = CubicSpline(knots, 0.05 * rng.standard_normal((len(knots), 3)))
    small = Rotation.from_rotvec(ANGLES)

    def rotation(t):
        return Rotation.from_euler("xyz", path(t))

    def read(t, at):
        h = 1e-3
        turn = (rotation(t - h).inv() * rotation(t + h)).as_rotvec() / (2 * h)
        there = [place(t + k * h) + rotation(t + k * h).apply(at) for k in (-1, 0, 1)]
        force = rotation(t).inv().apply((there[0] - 2 * there[1] + there[2]) / h**2 + G)
        return turn, force

    t, u = np.arange(0.5, seconds + 0.5, 1 / 87.0), np.arange(0.0, seconds + 8, 1 / 100.0)
    turn, force = read(t + LATE_S + FAST * t, LEVER)  # the reference began before
    mine = small.inv().apply(turn) @ gyro + 0.01, small.inv().apply(force) @ accel + [0.2, -0.1, 0.1]
    theirs = read(u, np.zeros(3))
    device, reference = (
        sn.Session(
            imu=Imu(
                t_ns=np.round(at * 1e9).astype(np.int64),
                gyro=rates + 0.002 * rng.standard_normal(rates.shape),
                accel=specific + 0.03 * rng.standard_normal(rates.shape),
            ),
            gravity_m_s2=9.81,
        )
        for at, (rates, specific) in ((t, mine), (u, theirs))
    )
    return device, reference


def axes_of(values, sensor):
    return [int(values[f"{sensor}_axis_{axis}"].value) for axis in "xyz"]


def test_planted_axes_are_found():
    """x of the device along y of the reference, y along -x; 1.5 deg and less to .1 deg; the lag to a millisecond."""
    result = fit(plate(0), AxesOptions())
    for sensor in ("gyro", "accel"):
        assert axes_of(result.values, sensor) == [2, -1, 3]
        angles = [result.values[f"{sensor}_angle_{axis}"] for axis in "xyz"]
        assert np.allclose([a.value for a in angles], np.degrees(ANGLES), atol=0.1)
    assert not result.warnings and not result.refused
    assert len(result.order) == 6 and len(result.covariance) == 36


def covered(seeds):
    count = Coverage()
    for seed in seeds:
        values = fit(plate(seed), AxesOptions()).values
        for sensor in ("gyro", "accel"):
            for axis, true in zip("xyz", np.degrees(ANGLES), strict=True):
                count.add(f"{sensor} angle", values[f"{sensor}_angle_{axis}"], true)
    return count


@pytest.mark.slow
def test_sigmas_cover_the_truth():
    covered(range(20)).check()


def test_signs_and_exchanged_columns_are_named():
    flipped = np.diag([1.0, -1.0, 1.0])
    result = fit(plate(1, accel=-np.eye(3), gyro=flipped), AxesOptions())
    assert axes_of(result.values, "gyro") == [1, -2, 3] and axes_of(result.values, "accel") == [-1, -2, -3]
    text = " ".join(result.warnings)
    assert "gyro: left-handed" in text and "axes x, z of the accel are not those of the gyro" in text


def test_what_the_motion_does_not_carry_is_refused():
    with pytest.raises(CalibrationError, match=r"about its . axis; expected .*turn both together about all three axes"):
        fit(plate(2, about=(0.0, 0.0, 1.0)), AxesOptions())
    device, reference = plate(3)
    with pytest.raises(CalibrationError, match=r"correlate by 0\..*mount them on one plate"):
        fit((device, plate(4)[1]), AxesOptions())
    fast = device.replace(imu=replace(device.imu, gyro=np.degrees(device.imu.gyro)))
    with pytest.raises(CalibrationError, match=r"the reference reads 0\.0175 times.*one unit"):
        fit((fast, reference), AxesOptions())
    with pytest.raises(CalibrationError, match=r"1 recordings; expected two: the device, then the reference"):
        fit((device,), AxesOptions())


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        (slice(1), "0 readings of the magnetometer"),
        (slice(0, 3000, 1000), "3 readings"),
        (slice(0, 200), r"in 2\.\d s while both"),
    ],
)
def test_a_magnetometer_of_few_readings_is_refused_and_leaves_the_others(rows, text):
    device, reference = (
        one.replace(magnetometer=Magnetometer(t_ns=one.imu.t_ns, field_ut=one.imu.accel)) for one in plate(5)
    )
    assert not fit((device, reference), AxesOptions()).refused
    few = device.replace(magnetometer=device.magnetometer.take(rows))
    result = fit((few, reference), AxesOptions())
    assert axes_of(result.values, "gyro") == [2, -1, 3] and len(result.order) == 6
    assert list(result.refused) == ["magnetometer"] and re.search(text, result.refused["magnetometer"])


TURNS = "x:90,y:90,z:-90,x:-90,z:90,y:-90,x:90,z:90"


def boxed(seed, turns=TURNS, gyro=P):
    """A device in a box that is set from side to side, by 90 deg to half a degree."""
    rng = np.random.default_rng(seed)
    sequence = [part.split(":") for part in turns.split(",")]
    true = [np.radians(float(angle)) * np.eye(3)["xyz".index(axis)] for axis, angle in sequence]
    attitude, rates, force = Rotation.identity(), [], []
    small, swing = Rotation.from_rotvec(ANGLES), (1 - np.cos(2 * np.pi * (np.arange(100) + 0.5) / 100)) / 100
    for turn in [*true, None]:
        set_down = attitude * Rotation.from_rotvec(np.radians(0.5) * rng.standard_normal(3))
        rates.append(np.zeros((200, 3)))
        force.append(np.tile(set_down.inv().apply(G), (200, 1)))
        if turn is not None:
            rates.append(turn * swing[:, None] * 100)
            force.append(np.array([(attitude * Rotation.from_rotvec(turn * s)).inv().apply(G) for s in swing.cumsum()]))
            attitude = attitude * Rotation.from_rotvec(turn)
    rates, force = np.concatenate(rates), np.concatenate(force)
    read = small.inv().apply(rates) @ gyro + 0.01 + 0.002 * rng.standard_normal(rates.shape)
    felt = small.inv().apply(force) @ P + 0.05 + 0.03 * rng.standard_normal(force.shape)
    return sn.Session(
        imu=Imu(t_ns=np.arange(len(read), dtype=np.int64) * 10**7, gyro=read, accel=felt), gravity_m_s2=9.81
    )


def test_known_turns_of_a_box():
    options = AxesOptions(turns=TURNS)
    values = fit((boxed(0),), options).values
    for sensor in ("gyro", "accel"):
        assert axes_of(values, sensor) == [2, -1, 3]
        for axis, true in zip("xyz", np.degrees(ANGLES), strict=True):
            angle = values[f"{sensor}_angle_{axis}"]
            assert angle.value == pytest.approx(true, abs=0.6) and abs(angle.value - true) < 4 * angle.sigma + 0.05
    mirrored = fit((boxed(1, gyro=np.diag([1.0, 1.0, -1.0])),), options)
    assert axes_of(mirrored.values, "gyro") == [1, 2, -3] and "left-handed" in " ".join(mirrored.warnings)


def test_turns_that_do_not_match_the_recording():
    with pytest.raises(CalibrationError, match="9 rests and 4 turns"):
        fit((boxed(0),), AxesOptions(turns="x:90,y:90,z:90,x:90"))
    with pytest.raises(ConfigError, match=r"'q:90'; expected axis:deg"):
        fit((boxed(0),), AxesOptions(turns="x:90,q:90"))
    plain = "z:90,z:90,z:90,z:90"
    with pytest.raises(CalibrationError, match="times what the fit leaves"):
        fit((boxed(2, plain),), AxesOptions(turns=plain))
    with pytest.raises(CalibrationError, match="24 rests"):
        fit((handled(1),), AxesOptions(turns=TURNS))


@pytest.mark.parametrize("part", ["x:nan", "x:inf", ":90", "xy:90", "x", "x:"])
def test_a_turn_is_one_axis_and_a_finite_angle(part):
    with pytest.raises(ConfigError, match=f"{part}'; expected axis:deg"):
        parse_turns(f"x:90,{part}")
    assert parse_turns("Y: -90") == [(1, pytest.approx(-np.pi / 2))]

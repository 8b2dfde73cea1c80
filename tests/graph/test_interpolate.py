"""States inside windows: exact motion between true keyframes, both ends met, no jump."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from exact import GRAVITY, START_NS, angle_deg, eight, kinematics, record
from scipy.spatial.transform import Rotation

from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.graph.interpolate import Kinematics, predicted_at, states_at
from smartnav_graph.graph.keyframes import KeyframeConfig, make_windows
from smartnav_graph.graph.windows import Window
from smartnav_graph.simulation import motions

MOTIONS = {
    "figure eight": lambda: eight(30.0),
    "walk": lambda: motions.walk(30.0, np.random.default_rng(5)),
    "car": lambda: motions.car(30.0, np.random.default_rng(5), start_speed=12.0),
    "rest": lambda: motions.static(30.0),
}


def case(name: str = "figure eight", spacing_s: float = 1.0):
    """Recording, windows with keyframes off the sample grid, their true states."""
    recording = record(MOTIONS[name]())
    at = START_NS + ns_from_seconds(np.arange(0.0037, 29.9, spacing_s))
    windows = make_windows(recording.session.imu, at, [], {}, KeyframeConfig(max_spacing_s=10.0))
    return recording, windows, recording.truth(at)


def inner_times(windows, seed: int = 0, n: int = 2000) -> np.ndarray:
    return np.sort(np.random.default_rng(seed).integers(windows[0].t1_ns, windows[-1].t1_ns, n))


# Coning and sculling of the steps of a walk between 100 Hz samples leave more than the other motions do.
@pytest.mark.parametrize(
    ("name", "metres", "degrees", "metres_per_second"),
    [
        ("figure eight", 2e-4, 0.005, 1e-3),
        ("walk", 5e-4, 0.02, 3e-3),
        ("car", 2e-4, 0.002, 2e-3),
        ("rest", 1e-9, 1e-6, 1e-9),
    ],
)
def test_states_between_true_keyframes_a_second_apart_are_true(name, metres, degrees, metres_per_second):
    recording, windows, truth = case(name)
    t = inner_times(windows)
    found, true = states_at(windows, kinematics(truth), GRAVITY, t), recording.truth(t)
    assert np.linalg.norm(found.p - true.nav_t_body, axis=1).max() < metres
    assert angle_deg(found.R, true.nav_R_body).max() < degrees
    assert np.linalg.norm(found.v - true.nav_v_body, axis=1).max() < metres_per_second


def test_an_interpolation_would_not_pass_that():
    recording, windows, truth = case()
    t = inner_times(windows)
    ends = np.array([w.t1_ns for w in windows])
    line = np.stack([np.interp(t - ends[0], ends - ends[0], column) for column in truth.nav_t_body.T], axis=-1)
    assert np.linalg.norm(line - recording.truth(t).nav_t_body, axis=1).max() > 0.05


def test_keyframes_come_back_as_they_are():
    _, windows, truth = case()
    states = disturbed(truth)
    found = states_at(windows, states, GRAVITY, np.array([w.t1_ns for w in windows]))
    for one, other in zip(found, states, strict=True):
        np.testing.assert_array_equal(one, other)


def disturbed(truth, size: float = 0.05) -> Kinematics:
    """Smoothed states that do not fit the inertial data, each in its own way, with biases that differ."""
    rng = np.random.default_rng(1)
    n = len(truth)
    R = truth.nav_R_body @ Rotation.from_rotvec(size * rng.standard_normal((n, 3))).as_matrix()
    return Kinematics(
        R,
        truth.nav_t_body + size * rng.standard_normal((n, 3)),
        truth.nav_v_body + size * rng.standard_normal((n, 3)),
        0.01 * rng.standard_normal((n, 6)),
    )


@pytest.mark.parametrize("side", [-1, 1])
def test_both_ends_of_every_window_are_met_without_a_jump(side):
    _, windows, truth = case()
    states = disturbed(truth)
    ends = np.array([w.t1_ns for w in windows])
    near = (ends[1:] if side < 0 else ends[:-1]) + side * 1000  # a microsecond: 12 um at 12 m/s
    found = states_at(windows, states, GRAVITY, near)
    rows = slice(1, None) if side < 0 else slice(None, -1)
    np.testing.assert_allclose(found.p, states.p[rows], atol=1e-5)
    np.testing.assert_allclose(found.v, states.v[rows], atol=1e-4)
    assert angle_deg(found.R, states.R[rows]).max() < 1e-3
    np.testing.assert_allclose(found.bias, states.bias[rows], atol=1e-7)


def test_nothing_jumps_between_samples_either():
    _, windows, truth = case()
    states = disturbed(truth)
    grid = windows[3].t0_ns + np.cumsum(np.rint(windows[3].dt * NS).astype(np.int64))[:-1]
    before, after = (states_at(windows, states, GRAVITY, grid + shift) for shift in (-500, 500))
    assert np.abs(after.p - before.p).max() < 1e-5
    assert np.abs(after.v - before.v).max() < 1e-4
    assert angle_deg(after.R, before.R).max() < 1e-3


def test_velocity_is_the_derivative_of_position_where_the_ends_do_not_fit():
    _, windows, truth = case()
    states = disturbed(truth)
    t = inner_times(windows, n=300)
    ends = np.array([w.t1_ns for w in windows])
    t = t[np.abs(t[:, None] - ends).min(axis=1) > NS // 50]
    h = NS // 1000
    ahead, behind = (states_at(windows, states, GRAVITY, t + s).p for s in (h, -h))
    found = states_at(windows, states, GRAVITY, t).v
    np.testing.assert_allclose((ahead - behind) / 2e-3, found, atol=5e-3)  # m/s; the force is held over 10 ms


def test_bias_is_taken_out_and_interpolated():
    recording, windows, truth = case()
    bias = np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.03])
    imu = recording.session.imu
    wrong = replace(imu, accel=imu.accel + bias[:3], gyro=imu.gyro + bias[3:])
    at = np.array([w.t1_ns for w in windows])
    biased = make_windows(wrong, at, [], {}, KeyframeConfig(max_spacing_s=10.0))
    states = kinematics(truth)._replace(bias=np.tile(bias, (len(truth), 1)))
    t = inner_times(windows)
    found, true = states_at(biased, states, GRAVITY, t), recording.truth(t)
    assert np.linalg.norm(found.p - true.nav_t_body, axis=1).max() < 2e-3
    assert angle_deg(found.R, true.nav_R_body).max() < 0.01
    np.testing.assert_allclose(found.bias, np.tile(bias, (len(t), 1)))


@pytest.mark.parametrize(
    ("mistake", "degrees", "metres"),
    # a wrong constant force bends away (gravity included); a wrong turn and wrong axes do not
    [("rate sign", 3.0, 0.03), ("force sign", 0.0, 0.02), ("body axes swapped", 3.0, 0.05)],
)
def test_mistakes_show_between_the_keyframes(mistake, degrees, metres):
    recording, windows, truth = case("walk")
    swap = [1, 0, 2]
    wrong = {
        "rate sign": lambda w: replace(w, gyro=-w.gyro),
        "force sign": lambda w: replace(w, accel=-w.accel),
        "body axes swapped": lambda w: replace(w, accel=w.accel[:, swap], gyro=w.gyro[:, swap]),
    }[mistake]
    t = inner_times(windows)
    found, true = states_at([wrong(w) for w in windows], kinematics(truth), GRAVITY, t), recording.truth(t)
    assert angle_deg(found.R, true.nav_R_body).max() > degrees
    assert np.linalg.norm(found.p - true.nav_t_body, axis=1).max() > metres


def test_fixes_kept_back_are_foretold_through_their_lever_arm():
    # every fifth fix makes a keyframe; the four between are foretold from true states five seconds apart
    recording = record(MOTIONS["car"]())
    gnss = recording.session.gnss
    kept = np.arange(len(gnss)) % 5 == 0
    windows = make_windows(recording.session.imu, gnss.t_ns[kept], [], {}, KeyframeConfig(max_spacing_s=10.0))
    held = gnss.take(~kept & (gnss.t_ns < windows[-1].t1_ns))
    there = states_at(windows, kinematics(recording.truth(gnss.t_ns[kept])), GRAVITY, held.t_ns)
    lever = np.array(recording.session.mount("gnss").body_t)
    assert len(held) >= 20
    assert np.linalg.norm(there.p + there.R @ lever - held.enu, axis=1).max() < 0.02  # m
    assert np.linalg.norm(there.p - held.enu, axis=1).min() > 1.0  # without the lever arm


def test_times_outside_the_windows_are_refused():
    _, windows, truth = case()
    for t in (windows[0].t1_ns - 1, windows[-1].t1_ns + 1):
        with pytest.raises(ValueError, match="a time outside the windows"):
            states_at(windows, kinematics(truth), GRAVITY, np.array([t]))


def test_no_times_no_states():
    _, windows, truth = case()
    assert states_at(windows, kinematics(truth), GRAVITY, np.zeros(0, dtype=np.int64)).p.shape == (0, 3)


def test_the_order_of_the_times_does_not_matter():
    _, windows, truth = case()
    t = inner_times(windows, n=50)
    back = states_at(windows, disturbed(truth), GRAVITY, t[::-1])
    np.testing.assert_allclose(back.p[::-1], states_at(windows, disturbed(truth), GRAVITY, t).p, atol=1e-12)


def integrated_one_by_one(window, states: Kinematics, row: int, t_ns: int) -> tuple[np.ndarray, ...]:
    """State at t_ns inside a window from the keyframe before it, `row`: one interval after the other."""
    R, p, v, bias = (x[row] for x in states)
    left = (t_ns - window.t0_ns) / NS
    for dt, accel, gyro in zip(window.dt, window.accel, window.gyro, strict=True):
        step = min(dt, left)
        a = R @ (accel - bias[:3]) - [0.0, 0.0, GRAVITY]
        p, v = p + v * step + 0.5 * a * step**2, v + a * step
        R = R @ Rotation.from_rotvec((gyro - bias[3:]) * step).as_matrix()
        left -= step
    return R, p, v


def uneven(lengths_s, hertz: int = 100):
    """Windows of these lengths with arbitrary readings, and states of arbitrary motion at their ends."""
    rng = np.random.default_rng(3)
    ends = np.concatenate([[0], np.cumsum(np.rint(np.array(lengths_s) * hertz).astype(np.int64))])
    windows = [Window(0, 0, 0, "first", np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))]
    for k, (first, last) in enumerate(pairwise(ends.tolist()), start=1):
        shape = (last - first, 3)
        accel, gyro = rng.normal([0.0, 0.0, GRAVITY], 1.0, shape), rng.normal(0.0, 0.3, shape)
        span = (first * NS // hertz, last * NS // hertz)
        windows.append(Window(k, *span, "normal", np.full(last - first, 1.0 / hertz), accel, gyro))
    n = len(windows)
    rows = (
        Rotation.random(n, random_state=1).as_matrix(),
        *rng.normal(0.0, 10.0, (2, n, 3)),
        rng.normal(0, 0.01, (n, 6)),
    )
    return windows, Kinematics(*rows)


def test_windows_of_all_lengths_are_integrated_as_each_alone():
    windows, states = uneven([1.0, 0.03, 7.0, 1.0, 0.5, 2.0, 0.01, 1.0, 1.5, 0.2])
    t = inner_times(windows, n=60)
    t = t[~np.isin(t, [w.t1_ns for w in windows])]
    found = predicted_at(windows, states, GRAVITY, t)
    for i, stamp in enumerate(t.tolist()):
        row = int(np.searchsorted([w.t1_ns for w in windows], stamp))
        for part, expected in zip(found, integrated_one_by_one(windows[row], states, row - 1, stamp), strict=False):
            np.testing.assert_allclose(part[i], expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


def test_one_long_window_among_many_costs_no_more_than_its_samples():
    """Ten minutes among 1800 windows of a second: with each padded to the longest, 15 GB."""
    windows, states = uneven([1.0] * 900 + [600.0] + [1.0] * 900)
    t = np.arange(NS // 3, windows[-1].t1_ns, NS // 2)
    tracemalloc.start()
    try:
        states_at(windows, states, GRAVITY, t)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 100e6  # 21 MB

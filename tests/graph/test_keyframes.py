"""Where keyframes stand, what their windows hold, and that nothing of the signal is lost or moved."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from smartnav_graph.core.timebase import NS, Gap, ns_from_seconds
from smartnav_graph.graph.keyframes import (
    GAP_SHARE,
    GAP_SPACING_S,
    MOST_TURN,
    KeyframeConfig,
    inside,
    keyframe_times,
    make_windows,
    turn_times,
)
from smartnav_graph.session.streams import Imu

SECOND = KeyframeConfig()


def ns(*seconds: float) -> np.ndarray:
    return ns_from_seconds(np.array(seconds, dtype=float))


def times(span, aiding=(), gaps=(), config=SECOND) -> list[float]:
    """Keyframe times in seconds."""
    found = keyframe_times((int(span[0] * NS), int(span[1] * NS)), [ns(*a) for a in aiding], gaps, config)
    assert (np.diff(found) > 0).all()
    return (found / NS).tolist()


def gap(start: float, end: float, kind: str = "missing") -> Gap:
    return Gap(round(start * NS), round(end * NS), kind)


# --- where ------------------------------------------------------------------------------------------------------------


def test_keyframes_are_the_union_of_ends_and_aiding_epochs():
    assert times((0, 2), [(0.3, 1.1), (0.7, 1.6)]) == [0, 0.3, 0.7, 1.1, 1.6, 2]


def test_two_streams_on_one_epoch_share_a_keyframe():
    assert times((0, 1), [(0.5,), (0.5, 0.50005)]) == [0, 0.5, 1]
    assert times((0, 1), [(0.5,), (0.5002,)]) == [0, 0.5, 0.5002, 1]
    assert times((0, 1), [(0.5, 0.50006, 0.50015)]) == [0, 0.5, 0.50015, 1]  # near its neighbour, not near a keyframe


def test_a_border_or_end_next_to_aiding_gives_way_to_it():
    assert times((0, 1), [(0.00005, 0.99996)]) == [0.00005, 0.99996]
    assert times((0, 1), [(0.4,)], [gap(0.40005, 0.6)]) == [0, 0.4, 0.6, 1]


def test_no_two_keyframes_stand_further_apart_than_the_spacing():
    found = times((0, 10), [(3.3,)])
    assert max(np.diff(found)) <= 1.0 + 1e-9
    np.testing.assert_allclose(np.diff(found), [0.825] * 4 + [6.7 / 7] * 7)  # evenly spread in between
    assert times((0, 3)) == [0, 1, 2, 3]
    assert times((0, 1), config=KeyframeConfig(max_spacing_s=0.25)) == [0, 0.25, 0.5, 0.75, 1]


def test_windows_inside_a_gap_are_as_fine_as_what_strays_in_it():
    assert times((1, 4), [(), ()], [gap(2.0, 3.2)]) == pytest.approx([1, 2, 2.4, 2.8, 3.2, 4])
    assert times((2, 4), [(2.9,)], [gap(2.5, 3.5)]) == pytest.approx([2, 2.5, 2.9, 3.2, 3.5, 4])
    assert len(times((0, 60), [(), ()], [gap(0.0, 60.0)])) == 21  # a twentieth of a long one


def test_aiding_and_borders_outside_the_span_are_left_out():
    assert times((1, 2), [(0.5, 1.5, 2.5)], [gap(0, 0.9), gap(1.7, 2.2)]) == [1, 1.5, 1.7, 2]


def test_no_aiding_at_all():
    assert times((0, 2)) == [0, 1, 2]


def turning(deg_s: float, hz: int = 1000, seconds: int = 4) -> Imu:
    """At rest for half the time, then turning about x."""
    t = np.arange(seconds * hz + 1) / hz
    gyro = np.zeros((len(t), 3))
    gyro[t > seconds / 2, 0] = np.radians(deg_s)
    return Imu(t_ns=ns_from_seconds(t), gyro=gyro, accel=np.tile([0.0, 0.0, 9.81], (len(t), 1)))


def test_no_window_turns_by_more_than_preintegration_can_take():
    imu, plain = turning(500.0), ns(0, 1, 2, 3, 4)
    found = np.union1d(plain, turn_times(plain, imu))
    assert (found[found <= 2 * NS] == ns(0, 1, 2)).all()  # none where nothing turns
    assert len(found) - len(plain) == 2 * (500 // 90)
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    for window in make_windows(imu, found, (), {}, SECOND)[1:]:
        assert np.linalg.norm((window.gyro * window.dt[:, None]).sum(axis=0)) < 1.01 * MOST_TURN
        pim = gtsam.PreintegratedCombinedMeasurements(params)
        for force, rate, dt in zip(window.accel, window.gyro, window.dt.tolist(), strict=True):
            pim.integrateMeasurement(force, rate, dt)
        assert np.linalg.eigvalsh(pim.preintMeasCov())[0] > 0  # of one window of 1 s it has negative ones


def test_a_keyframe_for_a_turn_depends_on_earlier_samples_only():
    imu, plain = turning(500.0), ns(0, 1, 2, 3, 4)
    found, early = turn_times(plain, imu), turn_times(plain, imu.take(imu.t_ns <= 3 * NS))[:1]
    assert found[0] == early[0]
    assert not len(turn_times(plain, turning(60.0)))  # a car


@given(
    st.lists(st.floats(0, 30), max_size=20),
    st.lists(st.tuples(st.floats(0, 29), st.floats(0.1, 5)), max_size=3),
    st.floats(0.05, 3),
)
def test_rules_that_hold_for_any_aiding_and_gaps(aiding, holes, spacing):
    config = KeyframeConfig(max_spacing_s=spacing)
    gaps = [gap(start, min(start + length, 30.0)) for start, length in holes]
    found = ns(*times((0, 30), [sorted(aiding)], gaps, config))
    assert found[0] <= 100_000 and found[-1] >= 30 * NS - 100_000
    for t in ns(*aiding):  # every aiding row has its keyframe
        assert np.abs(found - t).min() <= 100_000
    middle = found[:-1] + np.diff(found) // 2
    wide = np.diff(found) > spacing * NS + 2
    assert inside(gaps, middle)[wide].all()  # wider than allowed only inside a gap
    longest = max([GAP_SPACING_S, *(GAP_SHARE * g.length_s for g in gaps)])
    assert (np.diff(found)[wide] <= longest * NS + 2).all()


def test_inside_means_strictly_inside():
    assert inside([gap(1, 2)], ns(0.5, 1, 1.5, 2, 2.5)).tolist() == [False, False, True, False, False]
    assert not inside([], ns(1, 2)).any()


# --- windows ----------------------------------------------------------------------------------------------------------


def wave(n: int = 1001, hertz: float = 100.0, seed: int = 0) -> Imu:
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((n, 6))
    return Imu(t_ns=ns_from_seconds(np.arange(n) / hertz), accel=values[:, :3], gyro=values[:, 3:])


def integral(t: np.ndarray, rows: np.ndarray, start: float, end: float) -> np.ndarray:
    """Oracle: the integral of the line through the samples, from its antiderivative."""
    at = np.unique(np.r_[start, t[(t > start) & (t < end)], end])
    values = np.stack([np.interp(at, t, column) for column in rows.T], axis=-1)
    return np.trapezoid(values, at, axis=0)


@given(st.lists(st.integers(0, 10 * NS), min_size=2, max_size=8, unique=True), st.integers(0, 5))
@settings(max_examples=60)
def test_the_integral_of_the_rate_is_that_of_the_signal(stamps, seed):
    imu = wave(seed=seed)
    at = np.sort(np.array(stamps))
    windows = make_windows(imu, at, [], {}, SECOND)
    assert [w.index for w in windows] == list(range(len(at)))
    assert windows[0].kind == "first" and len(windows[0].dt) == 0 and windows[0].length_s == 0
    for window in windows[1:]:
        assert window.dt.sum() == pytest.approx(window.length_s, abs=1e-12) and (window.dt > 0).all()
        expected = integral(imu.t_ns / NS, imu.gyro, window.t0_ns / NS, window.t1_ns / NS)
        np.testing.assert_allclose(window.dt @ window.gyro, expected, atol=1e-10)


@given(st.integers(1, 10 * NS - 1))
@settings(max_examples=30)
def test_a_keyframe_in_between_changes_no_integral(middle):
    imu = wave()
    whole = make_windows(imu, np.array([0, 10 * NS]), [], {}, SECOND)[1]
    parts = make_windows(imu, np.array([0, middle, 10 * NS]), [], {}, SECOND)[1:]
    np.testing.assert_allclose(sum(w.dt @ w.gyro for w in parts), whole.dt @ whole.gyro, atol=1e-10)


def test_borders_between_samples_are_interpolated():
    t = ns_from_seconds(np.arange(11) / 10)
    ramp = np.stack([np.arange(11.0)] * 3, axis=-1)
    imu = Imu(t_ns=t, accel=np.zeros((11, 3)), gyro=ramp)  # rate 10 t
    window = make_windows(imu, ns(0.25, 0.55), [], {}, SECOND)[1]
    np.testing.assert_allclose(window.dt, [0.05, 0.1, 0.1, 0.05])
    np.testing.assert_allclose(window.gyro[:, 0], [2.75, 3.5, 4.5, 5.25])


def test_a_window_shorter_than_a_sample():
    window = make_windows(wave(), ns(1.002, 1.004), [], {}, SECOND)[1]
    assert len(window.dt) == 1 and window.dt[0] == pytest.approx(0.002)


def test_kinds():
    gaps = [gap(2, 3, "bridged"), gap(6, 7)]
    windows = make_windows(wave(), ns(0, 1, 2, 2.5, 3, 6, 7, 8), gaps, {}, SECOND)
    assert [w.kind for w in windows] == ["first", "normal", "normal", "gap", "gap", "normal", "gap", "normal"]


def test_rows_land_at_their_keyframe_and_nowhere_else():
    aiding = {"gnss": ns(0, 1.00004, 2, 2.00005, 3.0), "control": ns(1, 2.5)}
    windows = make_windows(wave(), ns(0, 1, 2, 3), [], aiding, SECOND)
    rows = [{name: r.tolist() for name, r in w.rows.items()} for w in windows]
    assert rows == [{"gnss": [0]}, {"gnss": [1], "control": [0]}, {"gnss": [2, 3]}, {"gnss": [4]}]


@given(st.lists(st.floats(0, 10), max_size=15), st.lists(st.floats(0, 10), max_size=15))
def test_every_row_of_every_stream_is_used_once(one, other):
    aiding = {"gnss": np.sort(ns(*one)), "control": np.sort(ns(*other))}
    at = keyframe_times((0, 10 * NS), list(aiding.values()), [], SECOND)
    windows = make_windows(wave(), at, [], aiding, SECOND)
    for name, stamps in aiding.items():
        pairs = [(row, w.t1_ns) for w in windows for row in w.rows.get(name, ())]
        assert [row for row, _ in pairs] == list(range(len(stamps)))
        assert all(abs(stamps[row] - t) <= 100_000 for row, t in pairs)


# --- the half turn ----------------------------------------------------------------------------------------------------


def spinning(nod_deg: float, hertz: float = 100.0) -> tuple[Imu, Rotation]:
    """Exact readings of one second of a turn at 1 rad/s while the axis nods twice a second, and the first attitude."""
    w, a = 2 * np.pi * 2.0, np.radians(nod_deg)

    def attitude(t: np.ndarray) -> Rotation:
        turn = Rotation.from_rotvec(np.stack([0 * t, 0 * t, t], axis=-1))
        return turn * Rotation.from_rotvec(a * np.stack([np.cos(w * t), np.sin(w * t), 0 * t], axis=-1))

    t, h = np.arange(round(hertz) + 1) / hertz, 1e-5
    rate = (attitude(t - h).inv() * attitude(t + h)).as_rotvec() / (2 * h)
    # nav force: gravity and a steady pull of 2 m/s^2 to the north
    force = attitude(t).inv().apply(np.tile([0.0, 2.0, 9.81], (len(t), 1)))
    return Imu(t_ns=ns_from_seconds(t), accel=force, gyro=rate), attitude(np.zeros(1))[0]


def velocity_error(accel: np.ndarray, gyro: np.ndarray, dt: np.ndarray, start: Rotation) -> float:
    """Velocity error m/s after GTSAM's integration over a second, from the true first attitude."""
    pim = gtsam.PreintegratedImuMeasurements(gtsam.PreintegrationParams.MakeSharedU(9.81), gtsam.imuBias.ConstantBias())
    for a, w, d in zip(accel, gyro, dt, strict=True):
        pim.integrateMeasurement(a, w, d)
    state = gtsam.NavState(gtsam.Rot3(start.as_matrix()), np.zeros(3), np.zeros(3))
    end = pim.predict(state, gtsam.imuBias.ConstantBias())
    return float(np.linalg.norm(end.velocity() - [0.0, 2.0, 0.0]))


@pytest.mark.parametrize(("nod_deg", "bound"), [(0.0, 1e-6), (5.0, 1e-3)])
def test_with_the_half_turn_gtsam_integrates_a_turn_and_coning_right(nod_deg, bound):
    imu, start = spinning(nod_deg)
    window = make_windows(imu, ns(0, 1), [], {}, SECOND)[1]
    assert velocity_error(window.accel, window.gyro, window.dt, start) < bound  # m/s
    # without it half an interval's turn of the pull is missing: 2 m/s^2 * 1 rad/s * 1 s * 5 ms = 0.01 m/s
    plain = 0.5 * (imu.accel[1:] + imu.accel[:-1])
    assert velocity_error(plain, window.gyro, window.dt, start) > 0.005


def test_the_half_turn_is_a_cross_product_with_the_rate():
    # a steady turn with a steady force in nav: the mean force in the axes of an interval's start
    w, dt = np.array([0.0, 0.0, 1.0]), 0.01
    t = np.arange(101) * dt
    force = Rotation.from_rotvec(np.outer(t, w)).inv().apply(np.tile([1.0, 0.0, 9.81], (101, 1)))
    imu = Imu(t_ns=ns_from_seconds(t), accel=force, gyro=np.tile(w, (101, 1)))
    window = make_windows(imu, ns(0, 1), [], {}, SECOND)[1]
    np.testing.assert_allclose(window.accel, force[:-1], atol=1e-4)  # of 0.005 without it

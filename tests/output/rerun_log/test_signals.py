"""What is drawn against time."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import (
    EVALUATION,
    make_session,
    make_solution,
)

from smartnav_graph.graph.solution import POS, Residuals
from smartnav_graph.output.rerun_log import signals


def test_a_long_signal_keeps_its_spikes_and_ends():
    rng = np.random.default_rng(0)
    values = rng.standard_normal((100_003, 3))
    values[[0, 77_777, 100_002, 100_001], [0, 1, 2, 0]] = 99.0, -99.0, 99.0, -99.0  # the last but one is in the rest
    whole = signals.Signal("/imu/accel", "accel", np.arange(len(values)), values)
    some = signals.lowest_and_highest(whole, 3000)
    assert len(some.t_ns) <= 3000 and (np.diff(some.t_ns) > 0).all() and some.t_ns[[0, -1]].tolist() == [0, 100_002]
    np.testing.assert_array_equal(some.values, values[some.t_ns])
    assert (some.values.min(axis=0) == values.min(axis=0)).all() and (
        some.values.max(axis=0) == values.max(axis=0)
    ).all()
    assert signals.lowest_and_highest(whole, len(values)) is whole
    alone = signals.lowest_and_highest(signals.Signal("/pressure", "", whole.t_ns, values[:, 1]), 3000)
    assert alone.values.min() == -99.0 and len(alone.t_ns) <= 3000


def test_biases_and_errors_carry_their_variances(recording):
    solution = make_solution()
    enu, xyz = ("east", "north", "up"), ("x", "y", "z")
    for path, names, values, sigma in (
        ("/bias/accel", xyz, solution.accel_bias, solution.sigmas[:, 9:12]),
        ("/bias/gyro", xyz, solution.gyro_bias, solution.sigmas[:, 12:15]),
        ("/error/position", enu, EVALUATION.error_enu_m, EVALUATION.sigma_enu),
    ):
        for k, name in enumerate(names):
            for where, times in ((f"{path}/{name}", 1), (f"{path}/{name}/three_sigma", 3)):
                np.testing.assert_array_equal(recording.values(where, "Measurements:values").ravel(), values[:, k])
                variances = recording.values(where, "Measurements:variances").ravel()
                np.testing.assert_allclose(np.sqrt(variances), times * sigma[:, k], rtol=1e-12)
    np.testing.assert_array_equal(recording.values("/sigma/position", "Scalars:scalars"), solution.sigmas[:, POS])


def test_inertial_samples_are_all_there_and_end_where_data_stop(recording):
    imu = make_session().imu
    np.testing.assert_array_equal(recording.values("/imu/accel", "Scalars:scalars"), imu.accel)
    ends = recording.index("/imu/accel", "Clear:is_recursive", "elapsed")
    assert ends.tolist() == [25_000_000_000]  # one period after the last sample before the gap


def test_many_residuals_of_one_time_stay_apart():
    rows = Residuals(
        t_ns=np.array([5, 5, 5, 7, 7]),
        sensor=np.array(["cam"] * 5, dtype=object),
        axis=np.array([0, 0, 1, 0, 1]),
        whitened=np.array([1.0, 2.0, 3.0, 4.0, 5.0]),
        weight=np.ones(5),
        used=np.ones(5, dtype=bool),
    )
    t, table = signals.residual_rows(rows, "cam", used=True)
    assert t.tolist() == [5, 5, 7]
    np.testing.assert_array_equal(table, [[1.0, 3.0], [2.0, np.nan], [4.0, 5.0]])


def test_motion_is_the_solution(recording):
    solution = make_solution()
    angles = solution.heading_pitch_roll_deg
    shown = np.concatenate(
        [
            recording.values(path, "Scalars:scalars")
            for path in ("/motion/attitude/heading", "/motion/attitude/tilt", "/motion/height", "/motion/speed")
        ],
        axis=1,
    )
    speed = np.linalg.norm(solution.nav_v_body, axis=1)
    np.testing.assert_array_equal(shown, np.column_stack([angles, solution.nav_t_body[:, 2], speed]))


def test_gross_errors_do_not_flatten_what_is_used():
    used = np.linspace(-3.0, 3.0, 1001)
    assert signals._limit(np.abs(used), np.array([1500.0, 900.0, 20.0])) == pytest.approx(15.0, rel=0.01)
    assert signals._limit(np.abs(used), np.array([4.0, 5.0])) == pytest.approx(1.1 * 4.75, rel=0.01)
    assert signals._limit(np.array([np.nan]), np.array([40.0])) == pytest.approx(15.0)

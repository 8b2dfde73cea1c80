"""Repairs act only when asked, count what they touch, and leave good data as it was."""

from __future__ import annotations

import numpy as np
import pytest

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.session.repair import REPAIRS, check_names, repair
from smartnav_graph.session.streams import GnssFix, Imu, Tracks


def imu_table(n: int = 2000, hertz: float = 100.0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    t = 1_748_772_000 * NS + ns_from_seconds(np.arange(n) / hertz)
    values = rng.standard_normal((n, 6))
    return Imu(t_ns=t, gyro=values[:, :3], accel=values[:, 3:]).columns()


def changed(table, **columns):
    return {name: np.array(columns.get(name, column)) for name, column in table.items()}


def assert_equal(one, other):
    assert list(one) == list(other)
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])


@pytest.mark.parametrize("names", [(), ("order",), ("nan",), ("nan", "order"), ("clock",), ("clock", "order")])
def test_a_good_table_comes_back_as_it_was(names):
    table = imu_table()
    rows, counts = repair(Imu, table, names)
    assert counts == {}
    assert_equal(rows, table)


def test_nothing_is_repaired_unasked():
    table = imu_table()
    table = changed(table, gyro_x_rad_s=np.r_[np.nan, table["gyro_x_rad_s"][1:]])
    rows, counts = repair(Imu, table, ())
    assert counts == {} and np.isnan(rows["gyro_x_rad_s"][0])


def test_swapped_and_repeated_rows_are_sorted_and_dropped():
    table = imu_table(100)
    order = np.r_[0:10, 11, 10, 12:50, 49, 50:100]  # one pair swapped, row 49 twice
    rows, counts = repair(Imu, {k: v[order] for k, v in table.items()}, ["order"])
    assert counts == {"disordered rows sorted": 1, "repeated stamps dropped": 1}
    assert_equal(rows, table)


def test_of_rows_with_one_stamp_the_first_stays():
    table = imu_table(3)
    table = changed(table, t_ns=table["t_ns"][[0, 1, 1]])
    rows, counts = repair(Imu, table, ["order"])
    assert counts == {"repeated stamps dropped": 1}
    np.testing.assert_array_equal(rows["gyro_x_rad_s"], table["gyro_x_rad_s"][:2])


def test_streams_of_several_rows_an_epoch_keep_them():
    table = {"t_ns": np.array([5, 5, 3]), "image_id": np.arange(3), "track_id": np.arange(3)}
    table |= {"x_n": np.zeros(3), "y_n": np.zeros(3)}
    rows, counts = repair(Tracks, table, ["order"])
    assert counts == {"disordered rows sorted": 1}
    assert rows["image_id"].tolist() == [2, 0, 1]


def test_rows_of_one_epoch_keep_their_order():
    t = np.repeat(np.arange(200)[::-1], 5)
    table = {"t_ns": t, "image_id": np.arange(1000), "track_id": np.arange(1000)}
    table |= {"x_n": np.zeros(1000), "y_n": np.zeros(1000)}
    rows, _ = repair(Tracks, table, ["order"])
    assert (np.diff(rows["image_id"].reshape(200, 5), axis=1) == 1).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_rows_with_a_broken_required_value_are_dropped(bad):
    table = imu_table(50)
    table["accel_z_m_s2"] = table["accel_z_m_s2"].copy()
    table["accel_z_m_s2"][[7, 9]] = bad
    rows, counts = repair(Imu, table, ["nan"])
    assert counts == {"non-finite rows dropped": 2}
    np.testing.assert_array_equal(rows["t_ns"], np.delete(table["t_ns"], [7, 9]))


def test_an_unknown_sigma_costs_no_row():
    table = {"t_ns": np.arange(3), "e_m": np.zeros(3), "n_m": np.zeros(3), "u_m": np.zeros(3)}
    table |= {f"sigma_{a}_m": np.array([1.0, np.nan, 1.0]) for a in "enu"}
    assert repair(GnssFix, table, ["nan"])[1] == {}


# --- stamps -----------------------------------------------------------------------------------------------------------


def test_jittered_stamps_are_rebuilt_to_a_tenth_of_their_error():
    table = imu_table(6000)
    true = table["t_ns"]
    jitter = np.rint(3e6 * np.random.default_rng(1).standard_normal(6000)).astype(np.int64)  # 3 ms at a period of 10
    rows, counts = repair(Imu, changed(table, t_ns=true + jitter), ["stamps", "order"])
    assert counts == {"stamps rebuilt": 6000}
    error = (rows["t_ns"] - true) / 1e6
    assert (np.diff(rows["t_ns"]) > 0).all()
    # the mean of 401 stamps: 3 / sqrt(401) = 0.15 ms; twice that at the ends, where half of them are missing
    assert error.std() < 0.25 and np.abs(error).max() < 1.0
    np.testing.assert_array_equal(rows["gyro_x_rad_s"], table["gyro_x_rad_s"])  # the order is the recording's own


def test_steady_stamps_stay_within_a_microsecond():
    table = imu_table(3000)
    rows, _ = repair(Imu, table, ["stamps"])
    assert np.abs(rows["t_ns"] - table["t_ns"]).max() <= 1000


def test_a_gap_is_not_smeared():
    table = {k: np.r_[v[:1000], v[1500:]] for k, v in imu_table(3000).items()}
    jitter = np.rint(1e6 * np.random.default_rng(2).standard_normal(2500)).astype(np.int64)
    rows, _ = repair(Imu, changed(table, t_ns=table["t_ns"] + jitter), ["stamps"])
    step = np.diff(rows["t_ns"]) / NS
    assert step[999] == pytest.approx(5.01, abs=2e-3)  # s
    assert np.delete(step, 999).max() < 0.0125


def test_stamps_of_events_are_what_they_are():
    table = {"t_ns": np.array([0, 900, 2100]), "e_m": np.zeros(3), "n_m": np.zeros(3), "u_m": np.zeros(3)}
    rows, counts = repair(GnssFix, table, ["stamps"])
    assert counts == {}
    assert_equal(rows, table)


def test_a_handful_of_rows_survives_every_repair():
    for n in (0, 1, 2, 3):
        table = {name: column[:n] for name, column in imu_table(10).items()}
        rows, _ = repair(Imu, table, REPAIRS)
        assert len(rows["t_ns"]) == n


def test_names_are_checked_and_put_in_order():
    assert check_names(["order", "nan", "stamps", "nan"]) == ("nan", "stamps", "order")
    with pytest.raises(ConfigError, match="--repair: unknown repair magic; expected some of nan, clock, stamps, order"):
        check_names(["magic", "nan"])


def test_the_given_table_is_left_as_it_was():
    table = imu_table(100)
    before = {k: v.copy() for k, v in table.items()}
    repair(Imu, {k: v[::-1] for k, v in table.items()}, REPAIRS)
    assert_equal(table, before)


@pytest.mark.parametrize("back_s", [10.0, 5.0, 604_800.0])
def test_a_clock_that_was_set_back_is_continued_never_merged(back_s):
    """At 10 s to zero, by half of what is recorded, at the end of a week of GPS time."""
    table = imu_table()
    table["t_ns"] = table["t_ns"] - table["t_ns"][0] + (604_790 * NS if back_s > 1000 else 0)
    late = np.arange(len(table["t_ns"])) >= 1000
    reset = changed(table, t_ns=table["t_ns"] - late * round(back_s * NS))
    with pytest.raises(SessionError, match=r"the clock was set back; .*--repair clock"):
        repair(Imu, reset, ["order"])
    rows, counts = repair(Imu, reset, ["clock"])
    assert counts == {"after a clock was set back, continued": 1000}
    np.testing.assert_allclose(rows["t_ns"], table["t_ns"], atol=20_000_000)


def test_rows_delivered_late_or_twice_are_no_reset():
    table = imu_table()
    late = np.r_[0:500, 800:1200, 500:800, 1200:2000]
    rows, counts = repair(Imu, {k: v[late] for k, v in table.items()}, ["clock", "order"])
    assert "after a clock was set back, continued" not in counts
    assert_equal(rows, table)
    twice = np.r_[0:1000, 700:1000, 1000:2000]
    rows, counts = repair(Imu, {k: v[twice] for k, v in table.items()}, ["clock", "order"])
    assert counts["repeated stamps dropped"] == 300
    assert_equal(rows, table)


def test_bursts_are_spread():
    table = imu_table()
    true = table["t_ns"]
    burst = true // 10**8 * 10**8 + np.arange(len(true)) % 10 * 1000
    rows, counts = repair(Imu, changed(table, t_ns=burst), ["clock"])
    assert counts == {"of bursts, spread evenly": len(true)}
    # all late by the same half of a burst, but for the ends
    off = (rows["t_ns"] - true)[300:-300] / NS
    assert np.ptp(off) < 0.005 and abs(off.mean()) < 0.06

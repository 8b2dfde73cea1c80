"""Clock readings, interpolation, and the two kinds of gap."""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, sosfiltfilt

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import (
    NS,
    Gap,
    find_gaps,
    interpolate,
    nearest,
    ns_from_seconds,
    ns_from_text,
    ns_from_texts,
    seconds_since,
)

# --- decimal text -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("46534.47837579", 46534478375790),  # first stamp of the KITTI drive
        ("1403715273.262142977", 1403715273262142977),  # EuRoC: beyond the 53 bits of a float
        ("0.0000000005", 0),  # half to even
        ("0.0000000015", 2),
        ("0.0000000025", 2),
        ("-0.0000000015", -2),
        (" 1e3 ", 1_000_000_000_000),
        ("9223372036.854775807", 2**63 - 1),
    ],
)
def test_decimal_text_is_exact_to_the_nanosecond(text, expected):
    assert ns_from_text(text) == expected


def test_the_unit_of_the_text():
    assert ns_from_text("1403715273262142976", unit_ns=1) == 1403715273262142976
    assert ns_from_text("12.3456", unit_ns=1_000_000) == 12_345_600
    np.testing.assert_array_equal(ns_from_texts(["1", "2.5"]), [NS, 2_500_000_000])
    assert ns_from_texts([]).dtype == np.int64


@given(st.integers(-(2**62), 2**62))
def test_nanoseconds_survive_text(ns):
    assert ns_from_text(str(Decimal(ns) / NS)) == ns
    assert ns_from_text(str(ns), unit_ns=1) == ns


@pytest.mark.parametrize("text", ["", "abc", "nan", "inf", "-inf", "1,5", "12:30"])
def test_text_that_is_no_number_is_refused(text):
    with pytest.raises(
        SessionError, match=r"time stamp: .* is no number; expected a decimal number of seconds"
    ) as error:
        ns_from_text(text)
    assert repr(text) in str(error.value)


@pytest.mark.parametrize("text", ["9223372036.854775808", "-1e11"])
def test_text_beyond_int64_is_refused(text):
    with pytest.raises(SessionError, match="does not fit int64"):
        ns_from_text(text)


# --- arithmetic -------------------------------------------------------------------------------------------------------


def test_seconds_keep_the_nanosecond_on_a_unix_clock():
    t0 = 1_748_772_000 * NS
    assert seconds_since([t0 + 1, t0 + 86_400 * NS + 1], t0).tolist() == [1e-9, 86400.000000001]
    np.testing.assert_array_equal(ns_from_seconds([0.0, 0.01, 1e-9, -1.5]), [0, 10_000_000, 1, -1_500_000_000])


def test_interpolation_is_linear_between_and_constant_outside():
    at = np.array([0, 10, 20]) * NS + 1_748_772_000 * NS
    values = np.array([[0.0, 5.0], [10.0, 5.0], [0.0, 7.0]])
    found = interpolate(at[0] + np.array([-NS, 0, 2_500_000_000, 15 * NS, 99 * NS]), at, values)
    np.testing.assert_allclose(found, [[0, 5], [0, 5], [2.5, 5], [5, 6], [0, 7]], atol=1e-12)
    np.testing.assert_allclose(interpolate(at[:1] + 5 * NS, at, values[:, 0]), [5.0])


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=30, unique=True), st.integers(-100, 1100))
def test_nearest_is_nearest(stamps, t):
    at = np.sort(np.array(stamps))
    found = nearest(np.array([t]), at)[0]
    assert abs(at[found] - t) == np.abs(at - t).min()


# --- gaps -------------------------------------------------------------------------------------------------------------


def signal(n: int = 6000, seed: int = 0, hertz: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and six noisy axes of a real sensor."""
    rng = np.random.default_rng(seed)
    return ns_from_seconds(np.arange(n) / hertz) + 5 * NS, rng.standard_normal((n, 6)) * [3, 3, 3, 0.1, 0.1, 0.1]


def bridge(values: np.ndarray, first: int, last: int) -> np.ndarray:
    """Rows first .. last drawn as a straight line between both."""
    out, x = values.copy(), np.linspace(0, 1, last - first + 1)[:, None]
    out[first : last + 1] = (1 - x) * values[first] + x * values[last]
    return out


def test_an_honest_signal_has_no_gap():
    assert find_gaps(*signal()) == []


def test_missing_rows_are_one_gap_from_last_to_next_row():
    t, values = signal()
    kept = np.ones(len(t), dtype=bool)
    kept[1000:1200] = False
    assert find_gaps(t[kept], values[kept]) == [Gap(int(t[999]), int(t[1200]), "missing")]
    assert find_gaps(t[kept], values[kept])[0].length_s == pytest.approx(2.01)


@pytest.mark.parametrize(("lost", "found"), [(3, 0), (4, 0), (5, 1)])
def test_a_step_counts_above_fifty_milliseconds(lost, found):
    t, values = signal()
    kept = np.r_[0:1000, 1000 + lost : 6000]  # steps of 40, 50 and 60 ms
    assert len(find_gaps(t[kept], values[kept])) == found


def test_at_a_low_rate_a_step_counts_above_three_periods():
    t, values = signal(hertz=10.0)
    for lost, found in ((2, 0), (3, 1)):
        kept = np.r_[0:1000, 1000 + lost : 6000]
        assert len(find_gaps(t[kept], values[kept])) == found


@pytest.mark.parametrize("jitter_ms", [0.0, 3.0])
def test_a_straight_line_is_a_bridge_whatever_its_stamps(jitter_ms):
    t, values = signal()
    rng = np.random.default_rng(1)
    t = t + np.rint(jitter_ms * 1e6 * np.clip(rng.standard_normal(len(t)), -1.5, 1.5)).astype(np.int64)
    drawn = bridge(bridge(values, 1000, 1155), 4000, 4160)
    expected = [Gap(int(t[a]), int(t[b]), "bridged") for a, b in ((1000, 1155), (4000, 4160))]
    assert find_gaps(t, drawn) == expected


@pytest.mark.parametrize(("rows", "found"), [(3, 0), (4, 0), (5, 1), (6, 1)])
def test_a_bridge_needs_five_rows(rows, found):
    t, values = signal()
    gaps = find_gaps(t, bridge(values, 1000, 1000 + rows - 1))
    assert [gap.length_s for gap in gaps] == pytest.approx([0.01 * (rows - 1)] * found)


def test_two_swapped_rows_do_not_split_a_bridge():
    t, values = signal()
    drawn = bridge(values, 1000, 1155)
    drawn[[1070, 1071]] = drawn[[1071, 1070]]
    assert find_gaps(t, drawn) == [Gap(int(t[1000]), int(t[1155]), "bridged")]


def test_two_bridges_with_honest_rows_between_stay_two():
    t, values = signal()
    drawn = bridge(bridge(values, 1000, 1100), 1110, 1200)
    assert len(find_gaps(t, drawn)) == 2


def test_a_missing_and_a_bridged_stretch_come_in_time_order():
    t, values = signal()
    drawn = bridge(values, 4000, 4100)
    kept = np.r_[0:5000, 5100:6000]
    assert [gap.kind for gap in find_gaps(t[kept], drawn[kept])] == ["bridged", "missing"]
    kept = np.r_[0:2000, 2100:6000]
    assert [gap.kind for gap in find_gaps(t[kept], drawn[kept])] == ["missing", "bridged"]


def test_a_constant_stretch_is_no_bridge():
    t, values = signal()
    values[1000:1300] = values[1000]
    assert find_gaps(t, values) == []
    assert find_gaps(t, np.zeros_like(values)) == []


def test_one_constant_axis_beside_moving_ones_is_no_bridge():
    t, values = signal()
    drawn = bridge(values, 1000, 1100)
    drawn[1000:1101, 3] = drawn[1000, 3]
    assert find_gaps(t, drawn) == []


@pytest.mark.parametrize("step", [0.01, 0.1, 1.0])
def test_a_quantised_signal_is_no_bridge(step):
    t, values = signal(40_000)
    assert find_gaps(t, np.round(values / step) * step) == []


def test_a_slow_quantised_ramp_is_no_bridge():
    t, _ = signal()
    ramp = np.repeat(np.arange(2000)[:, None] * 0.01, 3, axis=0) * np.ones(6)
    assert find_gaps(t, ramp) == []


def test_quiet_noise_after_a_low_pass_is_no_bridge():
    # a device on a table, filtered far below its rate: smooth, yet no straight line
    t, values = signal(20_000)
    for cut in (2.0, 5.0):
        smooth = sosfiltfilt(butter(4, cut, fs=100.0, output="sos"), values, axis=0) * 1e-3
        assert find_gaps(t, smooth) == []


def test_too_few_rows_have_no_gap():
    for n in (0, 1, 2, 3):
        t, values = signal(10)
        assert find_gaps(t[:n], values[:n]) == []


def test_the_signal_is_left_as_it_was():
    t, values = signal()
    before = values.copy()
    find_gaps(t, values)
    np.testing.assert_array_equal(values, before)


# --- real recordings --------------------------------------------------------------------------------------------------


def gaps_of(session) -> list[Gap]:
    imu = session.require_imu()
    return find_gaps(imu.t_ns, np.concatenate([imu.gyro, imu.accel], axis=1))


def test_the_kitti_drive_has_one_missing_and_eight_bridged_holes():
    session = readers.load("gtsam-kitti")
    gaps = gaps_of(session)
    missing, bridged = ([g for g in gaps if g.kind == kind] for kind in ("missing", "bridged"))
    assert [(g.start_ns - session.t0_ns, round(g.length_s, 2)) for g in missing] == [(0, 1.92)]
    starts = [36.4, 198.7, 203.1, 219.7, 236.3, 279.0, 305.6, 307.8]  # s, found by eye
    assert session.seconds([g.start_ns for g in bridged]) == pytest.approx(starts, abs=0.06)
    assert all(1.5 < g.length_s < 1.66 for g in bridged)


def test_the_euroc_half_minute_has_none():
    assert gaps_of(readers.load("gtsam-euroc")) == []


@pytest.mark.parametrize("name", ["car_comma2k19", "euroc_v101"])
def test_recordings_without_holes_have_none(name, dataset):
    assert gaps_of(readers.load(dataset(name))) == []


def test_six_hours_of_a_filtered_phone_at_rest_have_none(dataset):
    data = np.load(dataset("static_galaxy_s5") / "samsung_galaxy_s5_static_10Hz.npz")
    values = np.concatenate([data["gyro_measured_radps"], data["acc_mps2"]], axis=1).astype(np.float64)
    assert find_gaps(ns_from_seconds(np.arange(len(values)) / 10.0), values) == []

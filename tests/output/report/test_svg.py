"""Axes, thinning and numbers: the parts a wrong plot would come from."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lxml import html

from smartnav_graph.output.report.svg import Plot, axis, exact_axis, log_axis, spread_axis, time_axis
from smartnav_graph.output.report.thin import thin_band, thin_dots, thin_line, thin_path
from smartnav_graph.output.report.track import _axes
from smartnav_graph.output.text import Row, Table, count, distance, duration, number


@settings(max_examples=60)
@given(st.floats(-1e6, 1e6), st.floats(1e-4, 1e6))
def test_linear_axis_covers_its_data_with_few_round_ticks(lo: float, span: float) -> None:
    a = axis([lo, lo + span])
    step = a.ticks[1] - a.ticks[0]
    mantissa = step / 10 ** np.floor(np.log10(step) + 1e-6)
    slack = 1e-8 * (span + abs(lo))  # invisible on any screen
    assert a.lo <= lo + slack and a.hi >= lo + span - slack
    assert 2 <= len(a.ticks) <= 8
    assert min(abs(mantissa - m) for m in (1, 2, 5, 10)) < 1e-4
    assert len(set(a.labels)) == len(a.labels)


def test_axes_of_nothing_and_of_one_value_are_still_axes() -> None:
    for values in ([], [np.nan], [3.0], [0.0, 0.0]):
        a = axis(values)
        assert a.hi > a.lo and len(a.ticks) >= 2
        assert log_axis(values).hi > log_axis(values).lo


def test_time_and_log_ticks_are_what_people_expect() -> None:
    assert time_axis(0.0, 469.0).labels == ("0", "60", "120", "180", "240", "300", "360", "420")
    assert time_axis(0.0, 2219.0).ticks[1] == 300.0
    assert log_axis([0.03, 1.8]).labels == ("0.02", "0.05", "0.1", "0.2", "0.5", "1", "2")
    assert spread_axis([0.1, 0.2]).log is False and spread_axis([0.1, 20.0]).log is True


def test_long_labels_have_an_offset_or_powers() -> None:
    high = axis([1234.551, 1234.598])
    assert high.offset == pytest.approx(1234.5) and high.labels[0] == "0.05"
    assert high.titled("Height [m]") == "Height [m], minus 1\u202f234.5"
    assert axis([-4e6, 5e6]).labels == ("−4e6", "−2e6", "0", "2e6", "4e6", "6e6")
    assert log_axis([3e-7, 2e6]).labels[0] == "1e−7"


def test_line_is_drawn_where_the_data_are() -> None:
    plot = Plot(exact_axis(0.0, 10.0), exact_axis(0.0, 5.0), "test")
    plot.line([0.0, 5.0, 10.0], [0.0, np.nan, 5.0], "s0")
    plot.line([0.0, 10.0], [0.0, 5.0], "s1")
    dom = html.fromstring(plot.render())
    broken, whole = (p.get("d") for p in dom.xpath('//path[contains(@class, "line")]'))
    assert whole == "M0 10000l10000-10000"  # up is up
    assert broken == "M0 10000h0M10000 0h0"


def test_thinned_line_keeps_spikes_ends_and_breaks() -> None:
    t = np.arange(200_000) / 100.0
    y = np.sin(t / 50.0)
    y[77_777], y[123_456] = 9.0, np.nan
    x2, y2 = thin_line(t, y)
    assert len(x2) <= 3000
    assert x2[0] == t[0] and x2[-1] == t[-1] and (np.diff(x2) > 0).all()
    assert np.nanmax(y2) == 9.0 and x2[np.nanargmax(y2)] == t[77_777]
    assert np.isnan(y2).sum() == 1


def test_thinned_band_still_holds_the_whole_band() -> None:
    t = np.arange(10_000.0)
    low, high = -1.0 - np.sin(t) ** 2, 1.0 + np.cos(t) ** 2
    x, lo, hi = thin_band(t, low, high)
    assert len(x) <= 600 and lo.min() == low.min() and hi.max() == high.max()
    assert (np.interp(t, x, hi) >= np.interp(t, x, lo)).all()


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_thinned_path_stays_within_its_tolerance(seed: int) -> None:
    xy = np.cumsum(np.random.default_rng(seed).normal(size=(800, 2)), axis=0)
    keep = thin_path(xy, 0.5)
    assert keep[0] == 0 and keep[-1] == 799 and len(keep) < 800
    for a, b in pairwise(keep):
        d, p = xy[b] - xy[a], xy[a : b + 1] - xy[a]
        share = np.clip(p @ d / max(d @ d, 1e-30), 0, 1)
        assert np.linalg.norm(p - share[:, None] * d, axis=1).max() <= 0.5 + 1e-9  # m


def test_thinned_dots_keep_outliers_and_are_spread() -> None:
    special = np.zeros(50_000, dtype=bool)
    special[[3, 40_000]] = True
    rows = thin_dots(special, 1500)
    assert len(rows) == 1500 and {3, 40_000} <= set(rows.tolist())
    assert np.bincount(rows % 9).min() > 100  # every axis of a nine-component residual is seen


@pytest.mark.parametrize("size", [(1000.0, 10.0), (10.0, 1000.0), (0.0, 0.0), (300.0, 400.0)])
def test_map_scales_are_equal(size: tuple[float, float]) -> None:
    x, y, aspect = _axes(np.array([[0.0, 0.0], size]))
    assert (x.hi - x.lo) / (y.hi - y.lo) == pytest.approx(aspect, rel=1e-12)
    assert 1.2 < aspect < 2.5
    assert x.lo <= 0 <= size[0] <= x.hi and y.lo <= 0 <= size[1] <= y.hi


def test_histogram_bars_have_the_area_of_the_data() -> None:
    plot = Plot(exact_axis(0.0, 2.0), exact_axis(0.0, 1.0), "test")
    plot.bars([0.0, 1.0, 2.0], [0.25, 0.75], "s4")
    (d,) = re.findall(r'class="bars s4" d="([^"]+)"', plot.render())
    assert d == "M0 10000V7500H5000V10000zM5000 10000V2500H10000V10000z"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (number(0.12345), "0.123"),
        (number(1234.5), "1\u202f234"),
        (number(-0.0612), "−0.0612"),
        (number(None), "–"),
        (number(float("nan")), "–"),
        (number(0.0000123), "1.2e−5"),
        (count(46535), "46\u202f535"),
        (duration(469.0), "7 min 49 s"),
        (duration(42.06), "42.1 s"),
        (duration(7320), "2 h 02 min"),
        (distance(812.4), "812 m"),
        (distance(4318.27), "4.32 km"),
    ],
)
def test_numbers_read_well(text: str, expected: str) -> None:
    assert text == expected


def test_tables_escape() -> None:
    table = Table(("a|b", "<i>"), [Row(["x|y", '"&'], {"k": '"><script>'})])
    assert "<script>" not in table.html() and "&lt;i&gt;" in table.html()
    assert table.markdown().splitlines()[2] == '| x\\|y | "& |'

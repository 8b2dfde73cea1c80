"""The recording of two runs holds what their comparison found."""

from dataclasses import replace

import numpy as np
import pytest
from recordings import Recording, make_solution

from smartnav_graph.evaluation.compare import compare
from smartnav_graph.output.rerun_log.comparison import PLOTS, write_comparison

SHIFT = np.array([0.5, -0.25, 0.125])


@pytest.fixture(scope="module")
def runs():
    """The second shifted, by four times as much at one epoch, and twice as unsure."""
    first = make_solution()
    shift = np.tile(SHIFT, (len(first), 1))
    shift[7] *= 4.0
    return first, replace(first, nav_t_body=first.nav_t_body + shift, covariance=4.0 * first.covariance)


@pytest.fixture(scope="module")
def recording(runs, tmp_path_factory):
    path = tmp_path_factory.mktemp("comparison") / "both.rrd"
    write_comparison(path, *runs, compare(*runs), names=("one", "two"), clock_epoch="unix", report_markdown="# Figures")
    return Recording(path)


def test_differences_row_by_row_with_the_larger_sigma(runs, recording):
    first, second = runs
    for k, axis in enumerate(("east", "north", "up")):
        values = recording.values(f"/difference/position/{axis}", "Measurements:values").ravel()
        np.testing.assert_allclose(values, (second.nav_t_body - first.nav_t_body)[:, k], atol=1e-6)
        variances = recording.values(f"/difference/position/{axis}", "Measurements:variances").ravel()
        np.testing.assert_allclose(variances, second.sigmas[:, 3 + k] ** 2, rtol=1e-6)


def test_both_paths_and_what_each_plot_needs(runs, recording):
    for name, solution in zip(("first", "second"), runs, strict=True):
        points = recording.values(f"/world/{name}/now", "Points3D:positions")[:, 0]
        np.testing.assert_allclose(points, solution.nav_t_body, rtol=1e-6, atol=1e-4)
        assert recording.rows(f"/world/{name}/path", "LineStrips3D:strips", static=True)
    there = {
        path for path, *_, lines in PLOTS for path in ([path] if len(lines) == 1 else [f"{path}/{x}" for x in lines])
    }
    assert there <= recording.paths


def test_time_lines_of_every_row(runs, recording):
    for timeline in ("elapsed", "utc"):
        stamps = recording.index("/difference/position/up", "Measurements:values", timeline)
        assert stamps[7] - stamps[0] == runs[0].t_ns[7] - runs[0].t_ns[0], timeline


def test_the_log_leads_to_the_largest_difference(runs, recording):
    first = runs[0]
    texts = recording.texts("/log", "TextLog:text")
    (largest,) = [text for text in texts if text.startswith("1. ")]
    metres = 4.0 * float(np.linalg.norm(SHIFT))
    assert largest.startswith(f"1. at {first.seconds[7]:.2f} s: {metres:.3f} m")
    at = recording.index("/log", "TextLog:text", "elapsed")[texts.index(largest)]
    assert at == first.t_ns[7] - first.t0_ns


def test_views_name_the_runs(recording):
    names = recording.view_names()
    assert any(name.startswith("one blue, two orange") for name in names)
    assert "Figures" in names


def test_equal_runs_have_no_difference_to_magnify(runs, tmp_path):
    first, _ = runs
    write_comparison(tmp_path / "same.rrd", first, first, compare(first, first))
    assert "/difference/position/east" in Recording(tmp_path / "same.rrd").paths

"""What summary.json says of a run."""

from __future__ import annotations

import json

import numpy as np
import pytest
from sessions import on_control, recorded, with_gnss

import smartnav_graph as sn
from smartnav_graph.estimate import preparation
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.result.summary import peak_memory_mb, versions
from smartnav_graph.estimate.reweight import update
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.factors.imu import ImuConfig

KEYS = {
    *("mode", "duration_s", "path_m", "keyframes", "factors", "chi2_per_dof", "iterations", "converged", "states"),
    *("timings_s", "real_time_factor", "peak_memory_mb", "gaps", "dropped", "rejected", "withheld", "initialisation"),
    *("warnings", "versions"),
}


@pytest.fixture(scope="module")
def eight():
    return recorded()


@pytest.fixture(scope="module")
def summary(eight):
    return sn.run(eight, withhold=("gnss:outage=40-45",)).summary


def test_everything_promised_is_there_and_is_json(summary):
    assert set(summary) >= KEYS
    assert json.loads(json.dumps(summary)) == summary


def test_counts(summary, eight):
    assert summary["mode"] == "batch" and summary["keyframes"] == 62  # start, 60 fixes, and the end of the rest
    assert summary["duration_s"] == pytest.approx(59.99)
    rest = {"static": 7, "static_turn": 6}  # the first five seconds, cut by fixes and by the end of the rest
    assert summary["factors"] == {"prior": 3, "gnss": 55, "imu": 61, "imu_bias": 61, **rest}
    assert summary["used"] == {"gnss": 55} and summary["withheld"]["gnss"]["count"] == 5
    truth = np.linalg.norm(np.diff(eight.reference.enu, axis=0), axis=1).sum()
    assert summary["path_m"] == pytest.approx(truth, rel=0.1)
    assert summary["real_time_factor"] == pytest.approx(59.99 / summary["timings_s"]["total"], rel=0.01)


def test_chi_square_is_one_where_the_noise_is_what_is_assumed():
    """Mean over five seeds: 175 degrees of freedom of fixes each, so 1 +- 0.05 (one sigma)."""
    found = [sn.run(recorded(seed=seed)).summary["chi2_per_dof"] for seed in range(5)]
    assert np.mean([one["overall"] for one in found]) == pytest.approx(1.0, abs=0.2)
    assert np.mean([one["gnss"] for one in found]) == pytest.approx(1.0, abs=0.2)


def test_chi_square_follows_the_sigmas(monkeypatch, eight):
    monkeypatch.setattr(preparation, "CLAIM", np.inf)
    monkeypatch.setattr(update, "TAILS", 0.0)
    told = [
        sn.run(with_gnss(eight, sigma=eight.gnss.sigma * factor)).summary["chi2_per_dof"]["gnss"]
        for factor in (0.5, 1.0, 2.0)
    ]
    assert told[0] > 2.5 * told[1] and told[2] < told[1] / 2.5


def test_a_misfit_is_a_warning(eight, summary):
    assert not any(text.startswith("solve:") for text in summary["warnings"])
    half = np.arange(len(eight.gnss)) > len(eight.gnss) // 2
    torn = eight.nav_position(eight.gnss) + np.where(half, 60.0, 0.0)[:, None] * [1.0, 0.0, 0.0]
    rigid = Config(imu=ImuConfig(estimate_noise=False), gnss=GnssConfig(loss="none"))
    found = sn.run(with_gnss(eight, lla=None, enu=torn), rigid).summary
    assert found["chi2_per_dof"]["overall"] > 4.0
    assert any("measurements contradict each other or their sigmas are too small" in text for text in found["warnings"])


def test_sigmas_four_times_too_small_are_a_warning(eight):
    found = sn.run(with_gnss(eight, sigma=eight.gnss.sigma / 4)).summary
    assert any("scatter" in text for text in found["warnings"])
    assert 0.6 < found["chi2_per_dof"]["gnss"] < 1.4


def test_a_sigma_found_on_the_way_is_a_state(eight, summary):
    """Fixes without sigmas and of 0.1 m, where the class default is 3 m."""
    assert "gnss_sigma_m" not in summary["states"]
    fine = recorded(white_m=0.1)
    fine = with_gnss(fine.replace(calibration=None), sigma=None)
    states = sn.run(fine).summary["states"]
    found = states["gnss_sigma_m"]
    assert found["held"] is False and found["sigma"] is None
    assert found["value"][0] == pytest.approx(0.1, rel=0.5)


def test_dead_reckoning_is_a_mode_of_its_own(eight):
    summary = sn.run(eight.replace(gnss=None)).summary
    assert summary["mode"] == "dead-reckoning" and summary["used"] == {}
    assert summary["position_sigma_m"]["max"] > summary["position_sigma_m"]["median"]


def test_images_without_positions_are_visual_inertial_odometry():
    summary = sn.run(sn.simulate("room-30s", 1), end_s=8.0).summary
    assert summary["mode"] == "visual-inertial odometry" and summary["used"] == {}
    assert any(text.startswith("visual-inertial odometry: no absolute position") for text in summary["warnings"])


def test_control_points_count_as_absolute(eight):
    session = eight.replace(gnss=None, sensors={}, control=on_control(eight, slice(0, None, 5), 0.05, 0))
    summary = sn.run(session).summary
    assert summary["mode"] == "batch" and summary["used"] == {"control": 12}
    assert set(summary["chi2_per_dof"]) >= {"overall"}


def test_standstills_are_told(summary):
    """A rest of five seconds at the start, and the slow beginning of the motion."""
    found = summary["standstills"]
    assert found["count"] == 1 and not found["on_foot"]
    assert 5.0 <= found["at_rest_s"] <= found["total_s"] <= 6.0
    assert found["spans_s"] == [[0.0, found["total_s"]]]


def test_initialisation_is_told(summary):
    start = summary["initialisation"]
    assert start["method"] == "static" and "rest of" in start["sentence"]
    assert 0.0 <= start["heading_deg"] < 360.0 and 0.0 < start["sigma_heading_deg"] < 90.0
    assert start["starts"] >= 1 and 0.0 < start["stretch_s"] <= 60.0


def test_versions_and_memory():
    assert {"python", "smartnav-graph", "gtsam", "numpy", "rerun-sdk"} <= set(versions())
    assert versions()["gtsam"].startswith("4.3")
    assert 30.0 < peak_memory_mb() < 20_000.0

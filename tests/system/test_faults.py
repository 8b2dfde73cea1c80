"""Outlying fixes and broken rows on the drive that comes with gtsam; every rejection reported."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from sessions import recorded, with_gnss

import smartnav_graph as sn
from smartnav_graph.core.timebase import interpolate
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.output.report.usage import rejections_table
from smartnav_graph.simulation.degrade import Degrade, degrade, write_degraded
from smartnav_graph.simulation.fixes import Outliers
from smartnav_graph.smoothers.incremental import ReplayConfig

KINDS = {
    "isolated": Outliers("isolated", 0.05, 50.0, 200.0),
    "bursts": Outliers("burst", 0.05, 50.0, 200.0),
    "a fifth": Outliers("isolated", 0.20, 50.0, 200.0),
}


def faulty(drive, kind: str, seed: int):
    """Phone noise and outliers; the same without the outlying fixes; their mask."""
    bad = degrade(drive, Degrade(gnss_white=3.0, gnss_gm=(4.0, 60.0), outliers=KINDS[kind]), seed)
    mask = np.asarray(bad.gnss.extra["is_outlier"]) == 1
    return bad, bad.replace(gnss=bad.gnss.take(~mask)), mask


def rms(drive, solution) -> float:
    t_ns = np.clip(drive.gnss.t_ns, solution.t_ns[0], solution.t_ns[-1])
    off = interpolate(t_ns, solution.t_ns, solution.nav_t_body) - drive.gnss.enu
    return float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean()))


def assert_separated(drive, kind: str, seed: int, vehicle: str = "none", loss: str = "gate") -> None:
    bad, good, mask = faulty(drive, kind, seed)
    config = Config(gnss=GnssConfig(loss=loss))
    run, clean = (sn.run(session, config, vehicle=vehicle) for session in (bad, good))
    rejected = {one["row"] for one in run.summary["rejections"] if one["sensor"] == "gnss"}
    assert set(np.flatnonzero(mask)) <= rejected  # none missed
    assert len(rejected - set(np.flatnonzero(mask))) <= 0.01 * (~mask).sum()
    assert rms(drive, run.solution) <= 1.05 * rms(drive, clean.solution)
    assert len(rejected) == run.summary["rejected"]["gnss"]


@pytest.mark.parametrize(("kind", "seed"), [("isolated", 3), pytest.param("a fifth", 5, marks=pytest.mark.slow)])
def test_among_fixes_of_centimetres_too(kitti, kind, seed):
    """No loss as narrow as these fixes finds the way that inertial data foretell to metres."""
    bad = degrade(kitti, Degrade(outliers=KINDS[kind]), seed)
    mask = np.asarray(bad.gnss.extra["is_outlier"]) == 1
    reported = np.zeros(len(mask), dtype=bool)
    reported[[one["row"] for one in sn.run(bad).summary["rejections"]]] = True
    assert (reported | ~mask).all() and (reported & ~mask).sum() <= 2


def test_a_fifth_of_outliers_is_separated(kitti):
    assert_separated(kitti, "a fifth", 2)  # the first fix is one of them


@pytest.mark.slow
@pytest.mark.parametrize("vehicle", ["none", "car"])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", KINDS)
def test_outliers_are_separated(kitti, kind, seed, vehicle):
    assert_separated(kitti, kind, seed, vehicle)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_graduated_non_convexity_tells_them_apart_too(kitti, kind):
    assert_separated(kitti, kind, 1, loss="gnc")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_burst_does_not_destroy_the_causal_solution(kitti, kind):
    bad, good, _ = faulty(kitti, kind, 0)
    config = replace(Config(), replay=ReplayConfig(polish=False))
    one, other = (rms(kitti, sn.run(session, config, causal=True).causal) for session in (bad, good))
    assert one <= 1.05 * other  # 1.66 where only five-fold surprises count


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_broken_rows_cost_nothing(kitti, tmp_path, seed):
    """Repeated, swapped, jittered rows and rows that are no numbers, all at once."""
    options = Degrade(duplicates=0.01, swaps=0.005, nan_rows=0.001, jitter_ms=30.0)
    write_degraded(kitti, options, seed, tmp_path / "session")
    found, sound = (
        sn.run(session, withhold=("gnss:every=5",)).summary["withheld"]["gnss"]["rms_horizontal_m"]
        for session in (sn.load(tmp_path / "session"), kitti)
    )
    assert found <= 1.05 * sound


@pytest.fixture(scope="module")
def rejecting():
    """A minute with one fix 80 m north of where it should be."""
    session = recorded()
    lla = session.gnss.lla.copy()
    lla[30, 0] += 80.0 / 111_200.0
    return session, sn.run(with_gnss(session, lla=lla)).summary


def test_a_rejection_is_reported_with_time_sensor_and_size(rejecting):
    session, summary = rejecting
    (reported,) = summary["rejections"]
    assert reported["sensor"] == "gnss" and reported["row"] == 30
    assert reported["t_s"] == pytest.approx(float(session.seconds(session.gnss.t_ns[30])), abs=1e-3)
    assert reported["size_m"] == pytest.approx(80.0, abs=4.0) and reported["size_sigma"] == pytest.approx(80.0, abs=4.0)
    assert json.loads(json.dumps(summary["rejections"])) == summary["rejections"]


def test_the_report_lists_every_rejection(rejecting):
    _, summary = rejecting
    table = rejections_table(summary)
    assert len(table.rows) == 1 and table.rows[0].cells[1] == "GNSS"
    assert not rejections_table(summary | {"rejections": []}).rows

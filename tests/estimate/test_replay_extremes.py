"""Replay of what is rare and possible: turns within a second, and fixes that are far away or nearly exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.replay import replay
from smartnav_graph.session.streams import GnssFix, Imu
from smartnav_graph.simulation.scenarios import find_scenario
from smartnav_graph.smoothers.incremental import ReplayConfig

SMOOTHERS = ("isam2", "fixed-lag")


def configured(smoother: str) -> Config:
    return Config(replay=ReplayConfig(smoother=smoother, polish=False))


@pytest.mark.parametrize("smoother", SMOOTHERS)
def test_a_device_that_spins_at_500_deg_s_is_replayed(smoother):
    hz, seconds = 200, 8
    t, rng = np.arange(hz * seconds) / hz, np.random.default_rng(0)
    gyro = np.zeros((len(t), 3))
    gyro[t > 2.0, 2] = np.radians(500.0)
    accel = [0.0, 0.0, STANDARD_GRAVITY] + 0.02 * rng.standard_normal((len(t), 3))
    fixes = np.arange(0, len(t), hz)
    session = sn.Session(
        imu=Imu(t_ns=ns_from_seconds(t), gyro=gyro, accel=accel),
        gnss=GnssFix(
            t_ns=ns_from_seconds(t[fixes]),
            enu=0.5 * rng.standard_normal((seconds, 3)),
            sigma=np.full((seconds, 3), 0.5),
        ),
    )
    run = replay(session, configured(smoother))
    assert np.isfinite(run.solution.covariance).all() and run.summary["heading_known"] is False
    assert np.linalg.norm(run.solution.nav_t_body[:, :2], axis=1).max() < 2.0  # m: fixes of 0.5 m


@pytest.mark.parametrize("smoother", SMOOTHERS)
def test_a_fix_a_thousand_kilometres_away_does_not_stop_a_replay(smoother):
    session = replace(find_scenario("figure-eight-60s"), seconds=30.0)(0)
    gnss = session.gnss
    lla = gnss.lla.copy()
    lla[20, 0] += 9.0
    run = replay(session.replace(gnss=replace(gnss, lla=lla)), configured(smoother))
    at = np.isin(session.reference.t_ns, run.solution.t_ns)
    error = run.solution.nav_t_body[np.isin(run.solution.t_ns, session.reference.t_ns)] - session.reference.enu[at]
    assert np.linalg.norm(error[:, :2], axis=1).max() < 4.0  # m: fixes of 1 m

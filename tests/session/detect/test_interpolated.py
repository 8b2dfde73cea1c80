"""Fixes that were interpolated with the inertial data are off by the bow of the path."""

from __future__ import annotations

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.factors.gnss import PositionBuilder
from smartnav_graph.graph.update import one_of
from smartnav_graph.session.detect.interpolated import interpolation_error
from smartnav_graph.session.streams import Imu

RATE = 100


def turning(speed=10.0, rate=0.4, seconds=60.0) -> Imu:
    """A circle from 30 s on, straight ahead before."""
    t = np.arange(0.0, seconds, 1.0 / RATE)
    turns = t >= 30.0
    accel = np.stack([0.0 * t, speed * rate * turns, np.full_like(t, 9.81)], axis=1)
    gyro = np.stack([0.0 * t, 0.0 * t, rate * turns], axis=1)
    return Imu(t_ns=np.round(t * NS).astype(np.int64), accel=accel, gyro=gyro)


def gap(start_s: float, end_s: float, kind: str = "bridged") -> Gap:
    return Gap(round(start_s * NS), round(end_s * NS), kind)


def test_the_error_is_the_height_of_the_arc_over_its_chord():
    imu, radius, angle = turning(), 25.0, 0.4 * 1.5
    t_ns = np.array([20, 31, 33]) * NS + np.array([0, NS // 4, 0])
    found = interpolation_error(t_ns, imu, [gap(19.5, 21.0), gap(30.5, 32.0)])
    assert found[0] == 0.0 and found[2] == 0.0  # straight ahead; outside
    assert found[1] == pytest.approx(radius * (1.0 - np.cos(angle / 2.0)), rel=0.02)


@pytest.mark.parametrize(("kind", "offset_ns"), [("missing", 0), ("bridged", 1)])
def test_fixes_with_stamps_of_their_own_and_gaps_without_samples_have_none(kind, offset_ns):
    assert interpolation_error(np.array([31 * NS + offset_ns]), turning(), [gap(30.5, 32.0, kind)]) == 0.0


def test_kept_fixes_that_were_interpolated_do_not_bend_the_drive(kitti):
    """Fixes of the drive inside its gaps lie on a line up to 1 m off the path, by all the others."""
    kept = sn.run(kitti, start_s=150.0, end_s=240.0)
    builder = one_of(kept.problem.builders, PositionBuilder)
    doubtful = builder.interpolated > 0.3
    assert 4 <= doubtful.sum() <= 6
    without = kitti.gnss.take(~np.isin(kitti.gnss.t_ns, kept.session.gnss.t_ns[doubtful]))
    other = sn.smooth(kitti.replace(gnss=without), start_s=150.0, end_s=240.0)
    known = np.isin(kept.solution.t_ns, other.t_ns)
    same = np.isin(other.t_ns, kept.solution.t_ns)
    apart = kept.solution.nav_t_body[known] - other.nav_t_body[same]
    assert np.abs(apart[:, :2]).max() < 0.3  # m, where a line is 0.9 m off
    assert kept.summary["rejected"] == {}

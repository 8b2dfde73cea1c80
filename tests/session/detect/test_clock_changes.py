"""Jumps of the clock of fixes, and a clock of another rate, are found with time and size; a steady one is neither."""

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS
from smartnav_graph.session import health
from smartnav_graph.session.detect.clock import FixTrack
from smartnav_graph.session.detect.clock_changes import ClockChange, find_clock_change
from smartnav_graph.session.detect.motion import levelled_motion
from smartnav_graph.session.session import Session


def change_of(session: Session) -> ClockChange | None:
    motion, fixes = levelled_motion(session.imu), session.gnss
    return find_clock_change(motion, FixTrack.of(fixes.t_ns, session.nav_position(fixes), motion.start_ns))


def jumping(session: Session, at_s: float, by_s: float) -> Session:
    late = session.seconds(session.gnss.t_ns) > at_s
    t_ns = session.gnss.t_ns + late * round(by_s * NS)
    rows = t_ns > np.concatenate([[-1], np.maximum.accumulate(t_ns)[:-1]])
    return session.replace(gnss=replace(session.gnss.take(rows), t_ns=t_ns[rows]))


def stretched(session: Session, by: float) -> Session:
    t_ns = session.imu.t_ns
    since = np.rint((t_ns - t_ns[0]) * (1.0 + by)).astype(np.int64)
    return session.replace(imu=replace(session.imu, t_ns=t_ns[0] + since))


@pytest.mark.parametrize("by_s", [5.0, -5.0, 8.0])
def test_a_jump_is_found(kitti, by_s: float) -> None:
    found = change_of(jumping(kitti, 240.0, by_s))
    assert found is not None and not found.is_rate
    assert abs(found.size - by_s) < 0.5 and abs(found.at_s - 240.0) < 40.0


@pytest.mark.parametrize("by", [0.01, -0.01])
def test_another_rate_is_found(kitti, by: float) -> None:
    found = change_of(stretched(kitti, by))
    assert found is not None and found.is_rate and abs(found.size + by) < 0.002
    (text,) = [text for text in health.inspect(stretched(kitti, by)).warnings() if "clock runs" in text]
    assert "1.0 % fast" in text if by > 0 else "1.0 % slow" in text


@pytest.mark.parametrize("name", ["", "phone-car-5min", "car-all-2min", "walk-all-2min", "figure-eight-60s"])
def test_a_steady_clock_does_not_change(kitti, name: str) -> None:
    assert change_of(sn.simulate(name, 3) if name else kitti) is None


def test_phone_noise_is_no_change_and_hides_no_jump(kitti) -> None:
    rng = np.random.default_rng(0)
    enu = kitti.nav_position(kitti.gnss) + rng.normal(0.0, 3.0, (len(kitti.gnss), 3))
    noisy = kitti.replace(gnss=replace(kitti.gnss, enu=enu, lla=None))
    assert change_of(noisy) is None
    found = change_of(jumping(noisy, 240.0, 5.0))
    assert found is not None and abs(found.size - 5.0) < 1.0


def test_a_jump_is_reported_with_its_time(kitti) -> None:
    findings = health.inspect(jumping(kitti, 240.0, 5.0)).findings
    (finding,) = [finding for finding in findings if "stamps jump by" in finding.text]
    assert finding.where == "gnss" and abs((finding.start_ns - kitti.t0_ns) / NS - 240.0) < 40.0

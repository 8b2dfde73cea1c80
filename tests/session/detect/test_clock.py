"""The clock of fixes is found from the motion that both sensors see, or it is said to be unknown."""

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.detect.clock import ClockOffset, FixTrack, find_clock_offset
from smartnav_graph.session.detect.motion import STEP_S, levelled_motion
from smartnav_graph.session.session import Session


def offset(session: Session, shift_s: float = 0.0, change=lambda p: p) -> ClockOffset | None:
    motion, fixes = levelled_motion(session.imu), session.gnss
    t_ns = fixes.t_ns + round(shift_s * NS)
    return find_clock_offset("gnss", motion, FixTrack.of(t_ns, change(session.nav_position(fixes)), motion.start_ns))


def part(session: Session, begin_s: float, end_s: float) -> Session:
    def cut(stream):
        t = session.seconds(stream.t_ns)
        return stream.take((t >= begin_s) & (t <= end_s))

    return session.replace(imu=cut(session.imu), gnss=cut(session.gnss))


def test_motion_of_exact_inertial_data_is_the_true_one() -> None:
    session = sn.simulate("phone-car-5min", 3)
    truth, motion = session.reference, levelled_motion(session.imu)
    t = session.seconds(truth.t_ns)
    heading = np.unwrap(np.arctan2(truth.velocity[:, 1], truth.velocity[:, 0]))
    moving = np.linalg.norm(truth.velocity, axis=1) > 3.0
    found = np.interp(t, (np.arange(len(motion.heading)) + 0.5) * STEP_S, motion.heading)
    left = (found - heading)[moving]
    # a constant gyro bias that is left turns it slowly: 0.002 rad/s
    left -= np.polyval(np.polyfit(t[moving], left, 1), t[moving])
    assert np.std(left) < 0.1  # rad; bias walk and sideslip
    assert abs(np.ptp(heading)) > 2.0


@pytest.mark.parametrize("shift_s", [0.0, 0.5, -0.5, 5.0, 18.0, -18.0, 3600.0, 315_964_800.0])
def test_a_shift_of_the_stamps_is_found(kitti, shift_s: float) -> None:
    found = offset(part(kitti, 60.0, 180.0), shift_s)
    # the drive's fixes are 0.06 s early
    assert found.known and abs(found.lag_s - shift_s + 0.06) < 0.06


@pytest.mark.parametrize(("name", "seed"), [("car-all-2min", 1), ("phone-car-5min", 1)])
def test_simulated_drives_have_no_offset(name: str, seed: int) -> None:
    found = offset(sn.simulate(name, seed), 18.0)
    assert found.known and abs(found.lag_s - 18.0) < 2.0 * found.sigma_s + 0.1


def test_phone_noise_in_fixes(kitti) -> None:
    rng = np.random.default_rng(0)
    found = offset(kitti, 5.0, lambda p: p + rng.normal(0.0, 3.0, p.shape))
    assert found.known and abs(found.lag_s - 5.0) < 0.3


@pytest.mark.parametrize("seed", range(2))
def test_fixes_of_another_motion_have_no_known_offset(kitti, seed: int) -> None:
    other = sn.simulate("phone-car-5min", seed)
    enu = other.nav_position(other.gnss)[:300]
    both = kitti.replace(gnss=replace(kitti.gnss.take(slice(0, 300)), enu=enu, lla=None))
    assert not offset(both).known
    assert not offset(kitti, 0.0, lambda p: p[::-1]).known


@pytest.mark.parametrize("name", ["static-60s", "walk-60s", "figure-eight-60s"])
def test_where_nothing_shows_the_lag_it_is_unknown_or_right(name: str) -> None:
    found = offset(sn.simulate(name, 1))
    assert not found.known or abs(found.lag_s) < 0.5


def test_too_few_fixes_are_not_compared(kitti) -> None:
    assert levelled_motion(part(kitti, 60.0, 68.0).imu) is None
    short = part(kitti, 60.0, 120.0)
    assert offset(short.replace(gnss=short.gnss.take(slice(None, None, 10)))) is None

"""Steps of preparation: fixes on another clock are brought to that of the inertial data."""

import numpy as np
import pytest
from sessions import shifted

import smartnav_graph as sn
from smartnav_graph.core.timebase import interpolate


@pytest.fixture(scope="module")
def drive(kitti):
    def cut(stream):
        t = kitti.seconds(stream.t_ns)
        return stream.take((t >= 60.0) & (t <= 130.0))

    return kitti.replace(imu=cut(kitti.imu), gnss=cut(kitti.gnss))


@pytest.fixture(scope="module")
def solution(drive):
    return sn.smooth(drive, rate="10")


@pytest.mark.parametrize(("shift_s", "causal"), [(18.0, False), (5.0, True)])
def test_fixes_on_another_clock_give_the_same_solution(drive, solution, shift_s: float, causal: bool) -> None:
    late = shifted(drive, shift_s)
    late = late.replace(gnss=late.gnss.take(late.gnss.t_ns <= late.imu.t_ns[-1]))
    run = sn.run(late, rate="10", causal=causal)
    clock = run.summary["clock"]["gnss"]
    assert clock["known"] and clock["applied"] and abs(clock["lag_s"] - shift_s) < 0.1
    assert any("stamps are" in text and "corrected" in text for text in run.summary["warnings"])
    assert any("where gnss is on the corrected clock" in text for text in run.summary["warnings"])
    assert late.seconds(run.solution.t_ns[-1]) < late.seconds(late.gnss.t_ns[-1]) - shift_s + 0.2  # no dead reckoning
    same = interpolate(run.solution.t_ns, solution.t_ns, solution.nav_t_body)
    apart = np.linalg.norm((run.solution.nav_t_body - same)[:, :2], axis=1)
    assert np.sqrt(np.mean(apart**2)) < 0.2  # m


def test_fixes_in_time_are_left_as_they_are(drive) -> None:
    run = sn.run(drive, withhold=("gnss:outage=40-45",))
    clock = run.summary["clock"]["gnss"]
    assert clock["known"] and not clock["applied"]
    assert not any("stamps are" in text for text in run.summary["warnings"])


def test_rows_outside_after_the_correction_are_counted(drive) -> None:
    """Of fixes of 10 s before the inertial data, all inside by their stamps."""
    short = drive.replace(imu=drive.imu.take(drive.seconds(drive.imu.t_ns) >= 10.0))
    run = sn.run(shifted(short, 18.0))
    assert run.summary["clock"]["gnss"]["applied"]
    assert 9 <= run.summary["dropped"]["gnss"]["outside the inertial span"] <= 11


def test_a_replay_says_what_its_first_seconds_do_not_show(drive) -> None:
    """Of 18 s more, 12 s of fixes are known after 30 s: not enough to correct them by, all rows name the offset."""
    late = shifted(drive, 18.0)
    run = sn.run(late.replace(gnss=late.gnss.take(late.seconds(late.gnss.t_ns) <= 70.0)), causal=True, end_s=45.0)
    assert run.summary["clock"]["gnss"]["known"] and not run.summary["clock"]["gnss"]["applied"]
    assert any("18 leap seconds" in text for text in run.summary["warnings"])

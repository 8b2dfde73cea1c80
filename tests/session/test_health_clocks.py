"""Offsets of clocks are named, and corrected where the state of a clock does not reach them."""

import numpy as np
import pytest
from sessions import shifted

from smartnav_graph.session import health
from smartnav_graph.session.detect.clock import ClockOffset
from smartnav_graph.session.health.clocks import apply_offsets, beyond_state, compare_clocks


@pytest.fixture(scope="module")
def drive(kitti):
    def cut(stream):
        t = kitti.seconds(stream.t_ns)
        return stream.take((t >= 60.0) & (t <= 180.0))

    return kitti.replace(imu=cut(kitti.imu), gnss=cut(kitti.gnss))


@pytest.mark.parametrize(
    ("shift_s", "name"),
    [
        (18.0, "GPS time against UTC (18 leap seconds)"),
        (-3600.0, "1 hours: local time of a time zone"),
        (19800.0, "5.5 hours: local time"),
        (5.0, "4.9"),
    ],
)
def test_an_offset_is_named_and_corrected(drive, shift_s: float, name: str) -> None:
    late = shifted(drive, shift_s)
    warnings = [str(finding) for finding in health.inspect(late).findings if finding.level == "warning"]
    assert any(text.startswith("gnss: stamps are") and name in text for text in warnings)
    corrected, report = apply_offsets(late, compare_clocks(late))
    assert report.offsets[0].applied
    assert np.abs(corrected.gnss.t_ns - drive.gnss.t_ns).max() < 0.15e9
    assert not compare_clocks(corrected).findings


@pytest.mark.parametrize("shift_s", [0.0, 0.8, -0.8])
def test_the_lag_of_a_receiver_is_no_finding_and_small_enough_for_its_state(drive, shift_s: float) -> None:
    session, report = apply_offsets(shifted(drive, shift_s), compare_clocks(shifted(drive, shift_s)))
    assert report.offsets[0].known and not report.findings
    assert report.offsets[0].applied == (shift_s != 0.0)
    assert np.abs(session.gnss.t_ns - drive.gnss.t_ns).max() < 0.2e9


def test_a_session_without_fixes_or_inertial_data(drive) -> None:
    assert not compare_clocks(drive.replace(gnss=None)).offsets
    assert not compare_clocks(drive.replace(imu=None)).offsets


def test_an_offset_that_may_be_no_more_than_a_receiver_is_late_is_left_to_the_state():
    def offset(lag_s: float, sigma_s: float) -> ClockOffset:
        return ClockOffset("gnss", lag_s, sigma_s, 50.0, True, lag_s, lag_s)

    assert beyond_state(offset(-1.9, 0.3)) and beyond_state(offset(1.6, 0.05))
    assert not beyond_state(offset(-1.7, 0.3)) and not beyond_state(offset(1.4, 0.05))  # s

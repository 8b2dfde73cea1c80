"""Wrong signs, order and hand of axes are found by the motion that fixes and inertial data both see."""

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.session import health
from smartnav_graph.session.detect.axes import AXES, AxesFault, find_axes_fault
from smartnav_graph.session.detect.clock import FixTrack
from smartnav_graph.session.session import Device, Session


def fault_of(session: Session) -> AxesFault | None:
    start = int(session.imu.t_ns[0])
    fixes = FixTrack.of(session.gnss.t_ns, session.nav_position(session.gnss), start)
    return find_axes_fault(session.imu, fixes, start)


def with_axes(session: Session, axes) -> Session:
    imu = replace(session.imu, gyro=session.imu.gyro @ axes.gyro, accel=session.imu.accel @ axes.accel)
    enu = session.nav_position(session.gnss)
    enu = enu[:, [1, 0, 2]] if axes.mirrored else enu
    return session.replace(imu=imu, gnss=replace(session.gnss, enu=enu, lla=None))


@pytest.fixture(scope="module")
def drive(kitti):
    return kitti.replace(gnss=replace(kitti.gnss, sigma=None))


@pytest.mark.parametrize("axes", AXES, ids=lambda axes: f"{axes.sensor} {axes.text}")
def test_every_fault_of_a_clean_drive_is_found_and_named(drive, axes) -> None:
    found = fault_of(with_axes(drive, axes))
    assert found is not None and axes.text in [one.text for one in found.axes]
    # all but the hand of fixes against the sign of accel
    assert len(found.axes) == 1 or {one.sensor for one in found.axes} == {"accel", "fixes"}


@pytest.mark.parametrize("name", ["phone-car-5min", "car-all-2min", "walk-all-2min", "figure-eight-60s", "static-60s"])
def test_true_axes_are_no_fault(drive, name: str) -> None:
    assert fault_of(drive) is None
    assert fault_of(sn.simulate(name, 2)) is None


@pytest.mark.parametrize("axes", [axes for axes in AXES if axes.text in ("all axes negated", "z negated")])
def test_signs_show_beside_phone_noise(drive, axes) -> None:
    enu = drive.nav_position(drive.gnss) + np.random.default_rng(1).normal(0.0, 3.0, (len(drive.gnss), 3))
    found = fault_of(with_axes(drive.replace(gnss=replace(drive.gnss, enu=enu, lla=None)), axes))
    assert found is not None and axes.sensor in [one.sensor for one in found.axes]


def test_without_motion_nothing_is_said(drive) -> None:
    t = drive.seconds(drive.gnss.t_ns)
    line = np.stack([7.0 * t, 7.0 * t, 0.0 * t], axis=1)
    assert fault_of(drive.replace(gnss=replace(drive.gnss, enu=line, lla=None))) is None


def warnings(session: Session) -> list[str]:
    return [text for text in health.inspect(session).warnings() if "gap" not in text]


def test_gravity_decides_between_the_sign_of_accel_and_the_hand_of_fixes(drive) -> None:
    mirrored = next(axes for axes in AXES if axes.mirrored)
    negated = next(axes for axes in AXES if axes.sensor == "accel" and axes.text == "all axes negated")
    (text,) = warnings(with_axes(drive, mirrored))
    assert text.startswith("gnss: fixes turn and accelerate against the inertial data") and "accel all" not in text
    one, other = sorted(warnings(with_axes(drive, negated)))
    assert one.startswith("imu: accel contradicts") and "flip the sign of accel" in other


@pytest.mark.parametrize(("up", "said"), [("+z", ""), ("+y", "9"), ("-z", "17")])
def test_up_axis_against_gravity(drive, up: str, said: str) -> None:
    session = drive.replace(device=Device(forward="+x", up=up))
    found = [text for text in warnings(session) if "up axis" in text]
    assert len(found) == bool(said) and all(f"points {said}" in text or "points 8" in text for text in found)

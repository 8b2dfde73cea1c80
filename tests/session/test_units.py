"""Readings in another unit are converted by the repair, left out without it, or refused; never used as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import ABOVE_SEA, ELLIPSOIDAL, PARTLY_ABOVE_SEA
from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.session import folder
from smartnav_graph.session.health import inspect
from smartnav_graph.session.health.units import in_right_units
from smartnav_graph.session.session import Mount
from smartnav_graph.session.streams import ControlPoint, GnssFix

DEG, G = 180.0 / np.pi, 9.80665


@pytest.fixture(scope="module")
def car():
    return sn.simulate("car-all-2min", 1)


def changed(session, name, **factors):
    stream = getattr(session, name)
    values = {field: factor * getattr(stream, field) for field, factor in factors.items()}
    return session.replace(**{name: replace(stream, **values)})


WRONG = {
    "barometer": {"pressure_hpa": 100.0},
    "magnetometer": {"field_ut": 10.0},
    "wheel": {"speed": 3.6},
    "imu": {"gyro": DEG, "accel": 1.0 / G},
}


@pytest.mark.parametrize("name", WRONG)
def test_the_repair_gives_the_readings_back(car, name):
    repaired = in_right_units(changed(car, name, **WRONG[name]))
    for field in WRONG[name]:
        np.testing.assert_allclose(
            getattr(getattr(repaired, name), field), getattr(getattr(car, name), field), rtol=1e-9
        )
    assert repaired.dropped[name][f"with {field} multiplied by {1 / WRONG[name][field]:.6g}"] == len(getattr(car, name))
    assert in_right_units(car) is car


@pytest.mark.parametrize("name", ["barometer", "magnetometer", "wheel"])
def test_without_the_repair_they_are_not_used(car, name):
    problem = prepare(changed(car, name, **WRONG[name]), Config())
    assert getattr(problem.session, name) is None
    assert any(f"of {name}: not used, because it is in another unit" in text for text in problem.warnings)
    assert getattr(prepare(car, Config()).session, name) is not None


@pytest.mark.parametrize("field", ["gyro", "accel"])
def test_inertial_data_in_another_unit_are_refused(car, field):
    with pytest.raises(SessionError, match=r"multiply .*, or add --repair units"):
        prepare(changed(car, "imu", **{field: WRONG["imu"][field]}), Config())


def test_velocity_of_fixes_in_another_unit_leaves_their_positions(car):
    problem = prepare(changed(car, "gnss", velocity=3.6), Config())
    assert problem.session.gnss.velocity is None and len(problem.session.gnss) == len(car.gnss)


def test_the_repair_of_a_folder(car, tmp_path):
    folder.save(changed(car, "barometer", pressure_hpa=100.0), tmp_path / "s")
    loaded = folder.load(tmp_path / "s", repairs=("units",))
    np.testing.assert_allclose(loaded.barometer.pressure_hpa, car.barometer.pressure_hpa, rtol=1e-9)


def test_hard_iron_is_no_milligauss(car):
    """An offset of some hundreds of microtesla does not turn with the device; milligauss do."""
    field, offset = car.magnetometer.field_ut, np.array([300.0, -150.0, 200.0])
    iron = car.replace(magnetometer=replace(car.magnetometer, field_ut=field + offset))
    assert any("calibrate its hard iron" in text for text in inspect(iron).warnings())
    both = car.replace(magnetometer=replace(car.magnetometer, field_ut=10.0 * field + offset))
    assert any("it looks like milligauss" in text for text in inspect(both).warnings())


@pytest.mark.parametrize(
    ("lla", "found"),
    [
        ([4900.123, 825.4, 100.0], "ddmm.mmmm of NMEA"),
        ([49.0, 825.4, 100.0], "lon_deg is 825.4 .*ddmm.mmmm"),
        ([490123456.0, 84000000.0, 100.0], "degrees x 1e7"),
    ],
)
def test_latitude_outside_its_range_is_refused(lla, found):
    with pytest.raises(SessionError, match=f"{found}.*expected -"):
        GnssFix(t_ns=ns_from_seconds([0.0, 1.0]), lla=[[49.0, 8.4, 100.0], lla])
    assert len(GnssFix(t_ns=ns_from_seconds([0.0]), lla=[[-90.0, 359.9, 0.0]])) == 1


def without_heights(session, rows=slice(None)):
    lla = session.gnss.lla.copy()
    lla[rows, 2] = np.nan
    return session.replace(gnss=replace(session.gnss, lla=lla))


def test_fixes_without_height_are_used_horizontally():
    session = sn.simulate("figure-eight-60s", 1)
    whole, flat = (sn.run(s).solution for s in (session, without_heights(session)))
    truth = session.reference
    rows = np.isin(truth.t_ns, flat.t_ns)
    errors = [
        np.linalg.norm((s.nav_t_body[np.isin(s.t_ns, truth.t_ns)] - truth.enu[rows])[:, :2], axis=1).mean()
        for s in (whole, flat)
    ]
    assert errors[1] < 1.3 * errors[0]  # every fix in use
    height = flat.nav_t_body[np.isin(flat.t_ns, truth.t_ns), 2] - truth.enu[rows, 2]
    assert (np.abs(height) < 3.0 * flat.sigmas[np.isin(flat.t_ns, truth.t_ns), 5]).all()
    assert flat.sigmas[:, 5].min() > 10.0 * whole.sigmas[:, 5].max()  # nothing says how high


def test_some_heights_are_enough():
    session = sn.simulate("figure-eight-60s", 1)
    found = sn.run(without_heights(session, np.arange(len(session.gnss)) % 2 == 1))
    assert found.summary["used"]["gnss"] == len(session.gnss)
    assert found.solution.sigmas[:, 5].max() < 10.0  # m
    assert [f.level for f in inspect(found.session).findings if "no height" in f.text] == ["info"]


def test_nan_repair_keeps_fixes_without_height(tmp_path):
    session = without_heights(sn.simulate("figure-eight-60s", 1))
    folder.save(session, tmp_path / "s")
    assert len(folder.load(tmp_path / "s", repairs=("nan",)).gnss) == len(session.gnss)


def test_a_latitude_that_is_no_number_is_refused():
    with pytest.raises(SessionError, match="lat_deg is nan at row 0"):
        GnssFix(t_ns=ns_from_seconds([0.0]), lla=[[np.nan, 8.4, 100.0]])


def test_one_spike_of_the_accelerometer_does_not_move_the_path():
    session = sn.simulate("figure-eight-60s", 1)
    accel = session.imu.accel.copy()
    accel[3000] = [1000.0, 0.0, 0.0]
    clean = sn.run(session).solution
    found = sn.run(session.replace(imu=replace(session.imu, accel=accel)))
    assert any("at row 3000, 30.000 s" in text for text in found.summary["warnings"])
    assert np.abs(found.solution.nav_t_body - clean.nav_t_body).max() < 0.05  # m; one row of 6000 is missing


def test_heights_above_the_sea_need_the_geoid_and_are_lifted_by_it(tmp_path):
    session = sn.simulate("figure-eight-60s", 1)
    lla = session.gnss.lla - [0.0, 0.0, 46.5]
    above_sea = session.replace(gnss=replace(session.gnss, lla=lla), sensors={"gnss": Mount(frame="msl")})
    warning = next(text for text in prepare(above_sea, Config()).warnings if "geoid" in text)
    assert "so are those of the result; for heights above the ellipsoid give geoid_m" in warning
    point = ControlPoint(t_ns=session.gnss.t_ns[:1], lla=lla[:1], point_id=np.array(["A"], dtype=object))
    both = above_sea.replace(control=point)
    assert [one.heights for one in (session, above_sea, both)] == [ELLIPSOIDAL, ABOVE_SEA, PARTLY_ABOVE_SEA]
    folder.save(above_sea, tmp_path / "t")
    again = folder.load(tmp_path / "t")
    assert again.mount("gnss").above_sea and np.isnan(again.mount("gnss").geoid_m)
    folder.save(above_sea.replace(sensors={"gnss": Mount(frame="msl", geoid_m=46.5)}), tmp_path / "s")
    known = folder.load(tmp_path / "s")
    np.testing.assert_allclose(known.nav_position(known.gnss), session.nav_position(session.gnss), atol=1e-6)  # m
    assert known.heights == ELLIPSOIDAL
    prepare(known, Config())

"""Local frame against pyproj, gravity against published values, angles against hand-made rotations."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from differences import wrap_deg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from smartnav_graph.core import frames
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import (
    LocalFrame,
    Origin,
    heading_pitch_roll_deg,
    nav_R_body_from_heading,
    normal_gravity,
)

ORIGINS = [Origin(52.0, 11.0, 100.0), Origin(-33.9, 151.2, -20.0), Origin(0.0, 0.0, 0.0), Origin(78.0, -179.9, 3000.0)]
TO_ECEF = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")


def enu_by_ecef(origin: Origin, lla: np.ndarray) -> np.ndarray:
    """Oracle: difference of Earth-centred positions, turned by the textbook matrix."""
    ecef = np.stack(TO_ECEF.transform(*lla.T), axis=-1)
    zero = np.array(TO_ECEF.transform(origin.lat_deg, origin.lon_deg, origin.height_m))
    lat, lon = np.radians([origin.lat_deg, origin.lon_deg])
    east = [-np.sin(lon), np.cos(lon), 0.0]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return (ecef - zero) @ np.stack([east, np.cross(up, east), up]).T


def near(origin: Origin, n: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array([origin.lat_deg, origin.lon_deg, origin.height_m]) + rng.uniform(-1, 1, (n, 3)) * [0.3, 0.3, 500.0]


# --- local frame ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", ORIGINS, ids=str)
def test_geodetic_to_local_is_pyproj_through_ecef(origin):
    lla = near(origin)
    np.testing.assert_allclose(LocalFrame(origin).nav_from_lla(lla), enu_by_ecef(origin, lla), atol=1e-6)  # m


@pytest.mark.parametrize("origin", ORIGINS, ids=str)
def test_there_and_back(origin):
    frame, lla = LocalFrame(origin), near(origin)
    back = frame.lla_from_nav(frame.nav_from_lla(lla))
    np.testing.assert_allclose(back[:, 0], lla[:, 0], atol=1e-11)  # deg: a micrometre
    np.testing.assert_allclose(wrap_deg(back[:, 1] - lla[:, 1]), 0.0, atol=1e-10)
    np.testing.assert_allclose(back[:, 2], lla[:, 2], atol=1e-6)


@pytest.mark.parametrize("origin", ORIGINS, ids=str)
def test_earth_centred_to_local(origin):
    lla = near(origin)
    ecef = np.stack(TO_ECEF.transform(*lla.T), axis=-1)
    np.testing.assert_allclose(LocalFrame(origin).nav_from_ecef(ecef), enu_by_ecef(origin, lla), atol=1e-6)
    enu = enu_by_ecef(origin, lla)
    np.testing.assert_allclose((ecef[1:] - ecef[0]) @ LocalFrame(origin).nav_R_ecef.T, enu[1:] - enu[0], atol=1e-6)


def test_axes_are_east_north_up():
    frame = LocalFrame(Origin(52.0, 11.0, 100.0))
    east, north, up = frame.nav_from_lla([[52.0, 11.001, 100.0], [52.001, 11.0, 100.0], [52.0, 11.0, 101.0]])
    # one millidegree on the WGS84 radii at 52 deg: (N + h) cos(lat) = 3 935 020 m, M + h = 6 375 250 m
    np.testing.assert_allclose(east, [68.679, 0.0, 0.0], atol=2e-3)
    np.testing.assert_allclose(north, [0.0, 111.269, 0.0], atol=2e-3)
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(frame.nav_from_lla([52.0, 11.0, 100.0]), [[0, 0, 0]], atol=1e-9)


def test_an_origin_of_numpy_numbers_is_the_same_place():
    one = LocalFrame(Origin(np.float64(52.0), np.float32(11.0), np.float64(100.0)))
    np.testing.assert_allclose(one.nav_from_lla([52.0, 11.0, 100.0]), [[0, 0, 0]], atol=1e-9)


@pytest.mark.parametrize("wrong", [(91.0, 0, 0), (0, 361.0, 0), (0, 0, np.nan), (np.nan, 0, 0), (0, np.inf, 0)])
def test_an_impossible_origin_is_refused(wrong):
    with pytest.raises(SessionError, match=r"session\.toml \[origin\]: lat_deg .*; expected latitude in \[-90, 90\]"):
        Origin(*wrong)


# --- gravity ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("latitude", "published"),  # NIMA TR8350.2 (2000), table 3.4; 45 deg by Somigliana's formula
    [(0.0, 9.7803253359), (45.0, 9.80619777), (90.0, 9.8321849379), (-45.0, 9.80619777)],
)
def test_normal_gravity_on_the_ellipsoid(latitude, published):
    assert normal_gravity(latitude, 0.0) == pytest.approx(published, abs=1e-7)


def test_gravity_falls_with_height():
    for latitude in (0.0, 45.0, 90.0):
        gradient = (normal_gravity(latitude, 10.0) - normal_gravity(latitude, -10.0)) / 20.0
        assert gradient == pytest.approx(-3.086e-6, abs=4e-9)  # 1/s^2, the free-air gradient
    # inverse square of the distance, to the order that flattening and rotation allow
    assert normal_gravity(45.0, 10_000.0) == pytest.approx(9.80619777 * (6371 / 6381) ** 2, abs=2e-4)


# --- attitude ---------------------------------------------------------------------------------------------------------

HALF = np.sqrt(0.5)
# Axes of the body (columns: x, y, z) in nav, written down by hand.
NORTH_FLAT = np.eye(3)  # y to the north, z up
EAST_FLAT = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # y to the east, x to the south


@pytest.mark.parametrize(
    ("axes", "R", "expected"),
    [
        # phone lying flat
        (("+y", "+z"), NORTH_FLAT, (0, 0, 0)),
        (("+y", "+z"), EAST_FLAT, (90, 0, 0)),
        (("+y", "+z"), EAST_FLAT.T, (270, 0, 0)),
        (("+y", "+z"), [[1, 0, 0], [0, HALF, -HALF], [0, HALF, HALF]], (0, 45, 0)),  # top up
        (("+y", "+z"), [[HALF, 0, HALF], [0, 1, 0], [-HALF, 0, HALF]], (0, 0, 45)),  # right side down
        # car: x forward, y left, z up
        (("+x", "+z"), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, 0)),  # x north, y west
        (("+x", "+z"), np.eye(3), (90, 0, 0)),  # x east
        (("+x", "+z"), [[HALF, 0, -HALF], [0, 1, 0], [HALF, 0, HALF]], (90, 45, 0)),  # nose up, to the east
        (("+x", "+z"), [[1, 0, 0], [0, HALF, HALF], [0, -HALF, HALF]], (90, 0, -45)),
        # forward, right, down
        (("+x", "-z"), [[0, 1, 0], [1, 0, 0], [0, 0, -1]], (0, 0, 0)),  # x north, y east, z down
        (("+x", "-z"), [[1, 0, 0], [0, -1, 0], [0, 0, -1]], (90, 0, 0)),  # x east, y south
        (("+x", "-z"), [[0, HALF, -HALF], [1, 0, 0], [0, -HALF, -HALF]], (0, 0, 45)),  # right side down
        (("+x", "-z"), [[0, 1, 0], [HALF, 0, HALF], [HALF, 0, -HALF]], (0, 45, 0)),  # nose up
    ],
)
def test_heading_pitch_and_roll_of_hand_made_attitudes(axes, R, expected):
    R = np.array(R, dtype=float)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    found = heading_pitch_roll_deg(R, *axes)[0]
    np.testing.assert_allclose(wrap_deg(found - np.array(expected)), 0.0, atol=1e-9)


@pytest.mark.parametrize("axes", [("+y", "+z"), ("+x", "+z"), ("+x", "-z"), ("-z", "+y")])
@given(heading=st.floats(0, 359.99), pitch=st.floats(-80, 80), roll=st.floats(-170, 170))
@settings(max_examples=30)
def test_nautical_angles_of_any_attitude(axes, heading, pitch, roll):
    # Oracle: the aerospace sequence in north-east-down, forward-right-down
    ned_R_frd = Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix()
    enu_R_ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    flu_R_frd = np.diag([1.0, -1.0, -1.0])
    nav_R_body = enu_R_ned @ ned_R_frd @ flu_R_frd.T @ frames.body_R_vehicle(*axes).T
    found = heading_pitch_roll_deg(nav_R_body, *axes)[0]
    np.testing.assert_allclose(wrap_deg(found - [heading, pitch, roll]), 0.0, atol=1e-6)


def test_pitch_of_ninety_degrees_is_finite_and_right():
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # a phone held upright: top up, screen to the south
    found = heading_pitch_roll_deg(upright)
    assert np.isfinite(found).all() and found[0, 1] == pytest.approx(90.0)
    past = upright * (1 + 1e-15)  # rounding must not give arcsin of more than one
    assert np.isfinite(heading_pitch_roll_deg(past)).all()


@given(st.floats(0, 359.99), st.floats(-60, 60), st.floats(-60, 60), st.sampled_from(["+y", "+x", "-x", "-y"]))
def test_a_heading_and_a_vertical_make_the_attitude(heading, one, other, forward):
    body_up = Rotation.from_euler("xy", [one, other], degrees=True).apply([0.0, 0.0, 1.0])
    R = nav_R_body_from_heading(heading, 9.81 * body_up, forward)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R @ body_up, [0, 0, 1], atol=1e-12)
    found = heading_pitch_roll_deg(R, forward, "+z")[0, 0]
    assert abs(wrap_deg(found - heading)) < 1e-9


def test_a_forward_axis_along_gravity_still_gives_an_attitude():
    R = nav_R_body_from_heading(30.0, [0.0, 1.0, 0.0], "+y")  # upright phone
    np.testing.assert_allclose(R @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    x = R @ [1, 0, 0]
    assert np.degrees(np.arctan2(x[0], x[1])) == pytest.approx(30.0)


def test_axes_must_be_axes_and_differ():
    with pytest.raises(SessionError, match=r"axis 'y'; expected one of \+x, -x"):
        frames.axis_vector("y")
    with pytest.raises(SessionError, match=r"forward '\+x' and up '-x'; expected two different axes"):
        frames.body_R_vehicle("+x", "-x")
    frames.axis_vector("+x")[0] = 5.0  # a copy: the table stays as it is
    np.testing.assert_array_equal(frames.axis_vector("+x"), [1, 0, 0])


def test_vehicle_axes_are_forward_left_up():
    np.testing.assert_array_equal(frames.body_R_vehicle("+y", "+z"), [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(frames.body_R_vehicle("+x", "+z"), np.eye(3))
    np.testing.assert_array_equal(frames.body_R_vehicle("+x", "-z"), np.diag([1, -1, -1]))


def test_angles_wrap_to_half_a_turn():
    np.testing.assert_allclose(wrap_deg([0, 180, -180, 190, -190, 360, 725]), [0, -180, -180, -170, 170, 0, 5])


def test_the_magnetic_field_is_that_of_the_published_test_values():
    # WMM2025 test values, 2025.0, height 0: X, Y, Z in nT at 80 N, 0 E and at 0 N, 120 E
    for origin, (x, y, z) in (
        (frames.Origin(80.0, 0.0, 0.0), (6521.6, 145.9, 54791.5)),
        (frames.Origin(0.0, 120.0, 0.0), (39677.8, -109.6, -10580.2)),
    ):
        expected = np.array([y, x, -z]) / 1000.0  # north, east, down -> ENU
        np.testing.assert_allclose(frames.magnetic_field_ut(origin, 2025.0), expected, atol=1e-3)

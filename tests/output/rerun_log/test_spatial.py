"""The scene read back row by row: what the viewer shows is what was estimated."""

from __future__ import annotations

import numpy as np
from recordings import (
    REJECTED_ROWS,
    N,
    make_session,
    make_solution,
    truth,
    write,
)
from scipy.spatial.transform import Rotation

from smartnav_graph.graph.solution import POS
from smartnav_graph.output.rerun_log import spatial
from smartnav_graph.session.streams import GnssFix


def test_poses_are_the_solution_row_by_row(recording):
    solution = make_solution()
    at = recording.values("/world/est/body", "Transform3D:translation")[:, 0]
    np.testing.assert_array_equal(at, solution.nav_t_body.astype(np.float32))
    xyzw = recording.values("/world/est/body", "Transform3D:quaternion")[:, 0]
    np.testing.assert_allclose(Rotation.from_quat(xyzw).as_matrix(), solution.nav_R_body, atol=1e-6)
    path = recording.values("/world/est/path", "LineStrips3D:strips", static=True)[0, 0]
    np.testing.assert_array_equal(path, solution.nav_t_body.astype(np.float32))
    arrows = recording.values("/world/est/velocity", "Arrows3D:vectors")[:, 0]
    np.testing.assert_array_equal(arrows, solution.nav_v_body.astype(np.float32))


def test_ellipsoids_hold_the_position_covariance(recording):
    half = recording.values("/world/est/covariance", "Ellipsoids3D:half_sizes")[:, 0]
    xyzw = recording.values("/world/est/covariance", "Ellipsoids3D:quaternions")[:, 0]
    axes = Rotation.from_quat(xyzw).as_matrix()
    covariance = np.einsum("nij,nj,nkj->nik", axes, (half / 3.0) ** 2, axes)
    np.testing.assert_allclose(covariance, make_solution().covariance[:, POS, POS], atol=1e-5)


def test_ellipsoid_axes_are_a_rotation_even_when_eigenvectors_are_a_mirror():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(50, 3, 3))
    covariance = root @ root.transpose(0, 2, 1)
    vectors = np.linalg.eigh(covariance)[1]
    assert (np.linalg.det(vectors) < 0).any()  # the case at hand occurs
    half, xyzw = spatial.ellipsoids(covariance)
    axes = Rotation.from_quat(xyzw).as_matrix()
    np.testing.assert_allclose(np.einsum("nij,nj,nkj->nik", axes, half**2, axes), covariance, atol=1e-9)


def test_ellipsoids_along_the_path_are_magnified_by_a_round_factor_that_the_view_names(recording):
    half = recording.values("/world/est/covariances", "Ellipsoids3D:half_sizes", static=True)[0]
    true = recording.values("/world/est/covariance", "Ellipsoids3D:half_sizes")[:, 0]
    factor = half / true
    np.testing.assert_allclose(factor, factor[0, 0], rtol=1e-5)
    assert f"Path (ENU), 3σ ellipsoids ×{factor[0, 0]:g}" in recording.view_names()


def test_one_long_outage_does_not_bury_the_path_under_ellipsoids():
    covariance = (
        np.eye(3) * np.where(np.arange(100) < 95, 0.1, 100.0)[:, None, None] ** 2
    )  # sigmas 0.1 m, five of 100 m
    assert spatial.magnification(covariance, 1000.0) == 0.05
    assert spatial.magnification(covariance[:95], 1000.0) == 10.0


def test_ellipsoids_that_show_at_their_true_size_are_never_shrunk():
    covariance = np.eye(3) * np.linspace(0.1, 0.6, 50)[:, None, None] ** 2  # 3 sigma of up to 3.1 m in all
    assert spatial.magnification(covariance, 35.0) == 1.0
    assert spatial.magnification(covariance, 10.0) < 1.0  # they would hide the path


def test_rejected_fixes_and_residuals_are_apart(recording):
    session = make_session()
    enu = session.nav_position(session.gnss)
    drawn = recording.values("/world/gnss/rejected", "Points3D:positions", static=True)[0]
    np.testing.assert_array_equal(drawn, enu[REJECTED_ROWS].astype(np.float32))
    used = np.delete(enu, REJECTED_ROWS, axis=0)
    drawn = recording.values("/world/gnss/fixes", "Points3D:positions", static=True)[0]
    np.testing.assert_array_equal(drawn, used.astype(np.float32))
    geo = recording.values("/geo/gnss/rejected", "GeoPoints:positions", static=True)[0]
    np.testing.assert_allclose(geo, session.gnss.lla[REJECTED_ROWS, :2], atol=1e-10)  # degrees, doubles
    whitened = make_solution().residuals.whitened.reshape(-1, 3)
    rejected = recording.values("/residuals/gnss/rejected", "Scalars:scalars")
    np.testing.assert_array_equal(rejected, whitened[REJECTED_ROWS])
    kept = recording.values("/residuals/gnss", "Scalars:scalars")
    np.testing.assert_array_equal(kept, np.delete(whitened, REJECTED_ROWS, axis=0))


def test_without_origin_the_path_is_seen_from_above_and_far_coordinates_keep_centimetres(tmp_path):
    far = np.array([691_000.0, 5_334_000.0, 500.0])
    gnss = GnssFix(t_ns=make_session().gnss.t_ns, enu=truth(np.arange(N - 8)) + far)
    session = make_session(origin=None, gnss=gnss, reference=None, control=None)
    solution = make_solution(origin=None, nav_t_body=truth(np.arange(N)) + far)
    found = write(tmp_path / "run.rrd", session=session, solution=solution)
    assert "Top view (ENU)" in found.view_names() and "Map" not in found.view_names()
    at = found.values("/world/est/body", "Transform3D:translation")[:, 0].astype(float)
    assert np.abs(at - (truth(np.arange(N)) + far - [691_000.0, 5_334_000.0, 0.0])).max() < 1e-3  # m
    texts = found.texts("/log", "TextLog:text")
    assert [text for text in texts if "minus 691000, 5334000, 0 m" in text]


def test_unknown_positions_are_left_out_of_the_scene(tmp_path):
    position = truth(np.arange(N))
    position[5] = np.nan
    found = write(tmp_path / "run.rrd", solution=make_solution(nav_t_body=position), evaluation=None)
    for path, component in (
        ("/world/est/path", "LineStrips3D:strips"),
        ("/world/est/body", "Transform3D:translation"),
        ("/world/est/covariance", "Ellipsoids3D:centers"),
    ):
        values = found.values(path, component, static=path.endswith("path"))
        assert np.isfinite(values).all(), path
    assert 5 not in found.index("/world/est/body", "Transform3D:translation", "keyframe")

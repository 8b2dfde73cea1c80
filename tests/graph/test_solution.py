"""Solution: columns of the run folder and back, angles and sigmas in the axes they are told in."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.core.files import write_table
from smartnav_graph.core.frames import Origin
from smartnav_graph.graph import solution
from smartnav_graph.graph.solution import ACCEL_BIAS, GYRO_BIAS, POS, ROT, VEL, Residuals, Solution

ORIGIN = Origin(52.0, 11.0, 100.0)
T0 = 1_748_772_000_000_000_000
TRAJECTORY = [
    *("t_ns", "e_m", "n_m", "u_m", "lat_deg", "lon_deg", "height_m", "qw", "qx", "qy"),
    *("qz", "ve_m_s", "vn_m_s", "vu_m_s", "heading_deg", "pitch_deg", "roll_deg"),
    *("sigma_e_m", "sigma_n_m", "sigma_u_m", "sigma_heading_deg"),
]


def example(n: int = 5, origin: Origin | None = ORIGIN) -> Solution:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((n, 15, 15))
    return Solution(
        t_ns=T0 + np.arange(n) * 1_000_000_007,
        nav_R_body=Rotation.random(n, rng=0).as_matrix(),
        nav_t_body=rng.uniform(-100, 100, (n, 3)),
        nav_v_body=rng.uniform(-10, 10, (n, 3)),
        accel_bias=rng.uniform(-1, 1, (n, 3)),
        gyro_bias=rng.uniform(-1, 1, (n, 3)),
        covariance=root @ root.transpose(0, 2, 1),
        t0_ns=T0 - 2_000_000_000,
        origin=origin,
    )


def test_the_columns_of_the_trajectory_are_those_promised():
    columns = example().trajectory_columns()
    assert list(columns) == TRAJECTORY
    assert np.isfinite(np.stack([columns[name] for name in TRAJECTORY])).all()


def test_without_an_origin_only_the_geodetic_columns_are_empty():
    columns = example(origin=None).trajectory_columns()
    empty = [name for name, column in columns.items() if not np.isfinite(column).all()]
    assert empty == ["lat_deg", "lon_deg", "height_m"]


def test_columns_hold_what_they_say():
    s = example()
    columns = s.all_columns()
    np.testing.assert_array_equal(columns["u_m"], s.nav_t_body[:, 2])
    np.testing.assert_array_equal(columns["sigma_n_m"], np.sqrt(s.covariance[:, 4, 4]))
    np.testing.assert_allclose(columns["sigma_heading_deg"], np.degrees(np.sqrt(s.covariance[:, 2, 2])))
    np.testing.assert_array_equal(columns["gyro_bias_y_rad_s"], s.gyro_bias[:, 1])
    np.testing.assert_array_equal(columns["cov_rot_e__vel_u"], s.covariance[:, 0, 8])
    assert sum(name.startswith("cov_") for name in columns) == 15 * 16 // 2


def test_blocks_of_the_covariance():
    names = np.array(solution.COVARIANCE_NAMES)
    for block, text in ((ROT, "rot_"), (POS, "pos_"), (VEL, "vel_"), (ACCEL_BIAS, "accel_bias_"), (GYRO_BIAS, "gyro_")):
        assert all(name.startswith(text) for name in names[block])


def test_disk_and_back(tmp_path):
    s = example()
    write_table(s.all_columns(), tmp_path / "solution.parquet")
    back = solution.from_columns(
        solution.read(tmp_path / "solution.parquet"), t0_ns=s.t0_ns, origin=s.origin, forward=s.forward, up=s.up
    )
    for field in ("t_ns", "nav_t_body", "nav_v_body", "accel_bias", "gyro_bias", "covariance"):
        np.testing.assert_array_equal(getattr(back, field), getattr(s, field))
    np.testing.assert_allclose(back.nav_R_body, s.nav_R_body, atol=1e-14)
    assert back.origin == s.origin and back.t0_ns == s.t0_ns and len(back) == 5
    np.testing.assert_allclose(back.seconds[:2], [2.0, 3.000000007])


def test_quaternions_are_scalar_first_and_canonical():
    quarter = Rotation.from_euler("z", [[90], [350]], degrees=True).as_matrix()
    s = dataclasses.replace(example(2), nav_R_body=quarter)
    np.testing.assert_allclose(s.quat_wxyz[0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)
    assert (s.quat_wxyz[:, 0] >= 0).all()
    assert s.heading_pitch_roll_deg[:, 0] == pytest.approx([270.0, 10.0])


def test_path_length():
    s = dataclasses.replace(example(3), nav_t_body=np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 12]]))
    assert s.path_length() == pytest.approx(17.0)


def test_pandas():
    frame = example().to_pandas()
    assert list(frame.columns[:21]) == TRAJECTORY and "cov_rot_e__rot_e" not in frame.columns
    assert frame.index.name == "seconds" and frame.index[0] == pytest.approx(2.0)


def test_residuals_by_sensor():
    assert len(Residuals.empty()) == 0
    r = Residuals(
        t_ns=np.arange(3),
        sensor=np.array(["imu", "gnss", "imu"], dtype=object),
        axis=np.zeros(3, dtype=int),
        whitened=np.zeros(3),
        weight=np.ones(3),
        used=np.ones(3, dtype=bool),
    )
    assert r.of("imu").tolist() == [True, False, True] and not r.of("none").any()

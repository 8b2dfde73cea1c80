from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from planted_run import T0, make_reference, make_solution
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_seconds, ns_from_texts
from smartnav_graph.evaluation import evaluate
from smartnav_graph.evaluation.align import fit_alignment, states_of_solution
from smartnav_graph.graph.solution import Solution
from smartnav_graph.session.streams import Reference


def moved(solution, R, t, scale=1.0):
    """The solution in another frame, so that p_ref = scale R p_est + t."""
    return dataclasses.replace(
        solution,
        nav_t_body=(solution.nav_t_body - t) @ R / scale,
        nav_v_body=solution.nav_v_body @ R / scale,
        nav_R_body=R.T @ solution.nav_R_body,
    )


@pytest.mark.parametrize(
    ("method", "R", "scale"),
    [
        ("yaw", Rotation.from_euler("z", 170.0, degrees=True), 1.0),
        ("yaw", Rotation.from_euler("z", -180.0, degrees=True), 1.0),
        ("se3", Rotation.from_euler("ZYX", [100.0, 20.0, -50.0], degrees=True), 1.0),
        ("sim3", Rotation.from_euler("ZYX", [100.0, 20.0, -50.0], degrees=True), 1.7),
    ],
)
def test_planted_alignment_is_recovered(seconds, method, R, scale):
    R, t = R.as_matrix(), np.array([100.0, -2000.0, 30.0])
    result = evaluate(moved(make_solution(seconds), R, t, scale), make_reference(seconds), align=method)
    assert np.abs(result.alignment.R - R).max() < 1e-9
    assert np.abs(result.alignment.t - t).max() < 1e-9 * 2000 * scale  # m, at 2 km from the origin
    assert result.alignment.scale == pytest.approx(scale, abs=1e-9)
    assert result.ape_m.max < 1e-9 * 2000
    assert result.rotation_deg.max < 1e-6


def test_yaw_leaves_tilt_alone(seconds):
    R = Rotation.from_euler("x", 5.0, degrees=True).as_matrix()
    result = evaluate(moved(make_solution(seconds), R, np.zeros(3)), make_reference(seconds), align="yaw")
    assert result.rotation_deg.mean > 4.0
    assert result.alignment.R[2] == pytest.approx([0.0, 0.0, 1.0])


def test_alignment_turns_the_covariance_too(seconds):
    R = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    P = np.diag(np.r_[np.ones(3), 9.0, 1.0, 4.0, np.ones(9)])
    result = evaluate(moved(make_solution(seconds, P), R, np.zeros(3)), make_reference(seconds), align="yaw")
    assert result.sigma_enu[10] == pytest.approx([1.0, 3.0, 2.0])


def test_interpolation_is_linear_and_slerp():
    solution = make_solution(np.array([0.0, 1.0]))
    R0 = solution.nav_R_body[0]
    R1 = R0 @ Rotation.from_rotvec([0.0, 0.0, np.radians(100.0)]).as_matrix()
    solution = dataclasses.replace(solution, nav_R_body=np.stack([R0, R1]))
    between = states_of_solution(solution).at(np.array([T0 + NS // 4]))
    assert between.position[0] == pytest.approx(0.75 * solution.nav_t_body[0] + 0.25 * solution.nav_t_body[1])
    turned = Rotation.from_matrix(R0.T @ between.rotation[0]).as_rotvec(degrees=True)
    assert turned == pytest.approx([0.0, 0.0, 25.0])


@pytest.mark.parametrize("planted", [0.0, 0.237, -1.418, 3600.5, -1.7e9])
@pytest.mark.parametrize("align", ["none", "yaw"])
def test_planted_time_offset_is_found(seconds, planted, align):
    reference = make_reference(np.arange(5.0, 55.0, 0.05))
    early = dataclasses.replace(reference, t_ns=reference.t_ns - round(planted * NS))
    result = evaluate(make_solution(seconds), early, align=align, time_offset_s="auto")
    assert result.time_offset_s == pytest.approx(planted, abs=0.005)  # s
    assert result.ape_m.rmse < 0.02


def test_time_offset_sign(seconds):
    reference = make_reference(seconds)
    late = dataclasses.replace(reference, t_ns=reference.t_ns + 2 * NS)
    assert evaluate(make_solution(seconds), late, time_offset_s=-2.0).ape_m.max < 1e-9
    assert evaluate(make_solution(seconds), late).ape_m.rmse > 5.0


def test_spans_that_do_not_meet_are_named(seconds):
    reference = make_reference(seconds)
    late = dataclasses.replace(reference, t_ns=reference.t_ns + 1000 * NS)
    with pytest.raises(SessionError, match=r"spans 1000\.000 to 1059\.900 s.*solution 0\.000 to 59\.900 s.*--time-off"):
        evaluate(make_solution(seconds), late)


def test_a_still_reference_cannot_be_aligned(seconds):
    reference = make_reference(seconds)
    still = dataclasses.replace(reference, enu=np.zeros_like(reference.enu))
    for method in ("yaw", "se3", "sim3"):
        with pytest.raises(SessionError, match=f"--align {method}.*do not determine the rotation"):
            evaluate(make_solution(seconds), still, align=method)


def test_unknown_method_is_refused(seconds):
    with pytest.raises(SessionError, match="one of none, yaw, se3, sim3"):
        evaluate(make_solution(seconds), make_reference(seconds), align="se2")


def test_fit_agrees_with_a_numerical_minimum():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(30, 3)), rng.normal(size=(30, 3))
    found = fit_alignment("yaw", a, b)

    def cost(psi):
        R = Rotation.from_euler("z", psi).as_matrix()
        d = (b - b.mean(0)) - (a - a.mean(0)) @ R.T
        return (d**2).sum()

    grid = np.linspace(-np.pi, np.pi, 3601)
    best = grid[np.argmin([cost(psi) for psi in grid])]
    psi = np.arctan2(found.R[1, 0], found.R[0, 0])
    assert psi == pytest.approx(best, abs=2e-3)


DATASETS = Path(os.environ.get("SMARTNAV_DATASETS", Path(__file__).parents[3] / "shared" / "datasets"))


@pytest.mark.skipif(not DATASETS.is_dir(), reason=f"no real recordings at {DATASETS} (SMARTNAV_DATASETS)")
def test_real_clocks_and_frames_are_matched_by_themselves():
    """KITTI: the positions of the gtsam wheel against the camera poses, which count time from their first frame.

    An independent fit puts frame 0 at 46534.94 s and finds the scale 0.9981 (reference to fixes).
    """
    import gtsam

    file = gtsam.findExampleDataFile("KittiGps_converted.txt")
    enu = np.loadtxt(file, delimiter=",", skiprows=1, usecols=(1, 2, 3))
    n = len(enu)
    fixes = Solution(
        t_ns=ns_from_texts([line.split(",")[0] for line in Path(file).read_text().splitlines()[1:]]),
        nav_R_body=np.repeat(np.eye(3)[None], n, axis=0),
        nav_t_body=enu,
        nav_v_body=np.zeros((n, 3)),
        accel_bias=np.zeros((n, 3)),
        gyro_bias=np.zeros((n, 3)),
        covariance=np.repeat(np.eye(15)[None], n, axis=0),
        t0_ns=46_534_478_375_790,
    )
    folder = DATASETS / "kitti00_reference"
    poses = np.loadtxt(folder / "poses_00.txt").reshape(-1, 3, 4)
    cam_t_imu = [-0.32, 0.72, -1.11]  # m, near enough for the position of the IMU
    reference = Reference(t_ns=ns_from_seconds(np.loadtxt(folder / "times.txt")), enu=poses @ np.r_[cam_t_imu, 1.0])
    result = evaluate(fixes, reference, align="sim3", time_offset_s="auto")
    assert result.time_offset_s == pytest.approx(46534.94, abs=0.01)  # s
    assert result.alignment.scale == pytest.approx(1 / 0.9981, abs=3e-4)
    assert result.ape_m.p50 < 0.15  # m; linear interpolation over 1 s
    assert result.matched == 4539 and result.unmatched == 2


def test_inertial_data_carry_the_attitude_of_a_walk_between_keyframes():
    session = sn.simulate("walk-60s", 1)
    keyframes, dense = (sn.run(session, rate=rate).solution for rate in ("keyframes", "imu"))
    carried, known, straight = (
        evaluate(solution, session.reference).rotation_deg.rmse
        for solution in (keyframes, dense, dataclasses.replace(keyframes, imu=None))
    )
    assert len(keyframes) < 100 < len(dense)
    assert carried == pytest.approx(known, rel=0.05)  # the end discrepancy of a window is spread alike
    assert straight > 5.0 * carried  # a step turns the body by degrees


def test_time_offset_is_found_at_states_carried_by_inertial_data():
    session = sn.simulate("figure-eight-60s", 1)
    solution = sn.run(session).solution
    late = dataclasses.replace(session.reference, t_ns=session.reference.t_ns + NS // 4)
    at_once, shifted = (
        evaluate(solution, reference, align="yaw", time_offset_s="auto").time_offset_s
        for reference in (session.reference, late)
    )
    assert shifted == pytest.approx(at_once - 0.25, abs=0.01)  # s

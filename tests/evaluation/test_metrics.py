from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from planted_run import make_reference, make_solution, make_truth
from scipy.spatial.transform import Rotation

from smartnav_graph.evaluation import Statistics, evaluate
from smartnav_graph.evaluation.consistency import average_nees_bounds


def noisy(seconds, rng, sigma_m=0.3, sigma_rad=0.05):
    solution = make_solution(seconds)
    turn = Rotation.from_rotvec(sigma_rad * rng.normal(size=(len(seconds), 3))).as_matrix()
    return dataclasses.replace(
        solution,
        nav_t_body=solution.nav_t_body + sigma_m * rng.normal(size=(len(seconds), 3)),
        nav_R_body=turn @ solution.nav_R_body,
    )


def evo_path(seconds, position, rotation):
    from evo.core.trajectory import PoseTrajectory3D

    quat = Rotation.from_matrix(rotation).as_quat()[:, [3, 0, 1, 2]]
    return PoseTrajectory3D(position, quat, seconds)


@pytest.mark.parametrize("method", ["none", "se3", "sim3"])
def test_absolute_errors_equal_evo(seconds, method):
    from evo.core import metrics

    solution = noisy(seconds, np.random.default_rng(5))
    result = evaluate(solution, make_reference(seconds), align=method)
    position, _, rotation = make_truth(seconds)
    truth = evo_path(seconds, position, rotation)
    estimate = evo_path(seconds, solution.nav_t_body, solution.nav_R_body)
    if method != "none":
        estimate.align(truth, correct_scale=method == "sim3")
    for relation, ours in (
        (metrics.PoseRelation.translation_part, result.ape_m),
        (metrics.PoseRelation.rotation_angle_deg, result.rotation_deg),
    ):
        ape = metrics.APE(relation)
        ape.process_data((truth, estimate))
        assert ours.rmse == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
        assert ours.max == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), rel=1e-6)


def test_relative_errors_equal_evo(seconds):
    from evo.core import metrics

    solution = noisy(seconds, np.random.default_rng(6))
    result = evaluate(solution, make_reference(seconds), rpe_deltas_s=(1.0,))
    position, _, rotation = make_truth(seconds)
    pair = (evo_path(seconds, position, rotation), evo_path(seconds, solution.nav_t_body, solution.nav_R_body))
    for relation, ours in (
        (metrics.PoseRelation.translation_part, result.rpe[0].translation_m),
        (metrics.PoseRelation.rotation_angle_deg, result.rpe[0].rotation_deg),
    ):
        rpe = metrics.RPE(relation, delta=10, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data(pair)
        assert ours == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)
    assert result.rpe[0].pairs == len(seconds) - 10


def test_relative_error_of_a_constant_drift():
    seconds = np.arange(0.0, 30.0, 0.5)
    drift = np.array([0.1, 0.0, 0.0])  # m/s
    solution = make_solution(seconds)
    solution = dataclasses.replace(solution, nav_t_body=solution.nav_t_body + seconds[:, None] * drift)
    result = evaluate(solution, make_reference(seconds, attitude=False), rpe_deltas_s=(1.0, 5.0, 100.0))
    assert [r.translation_m for r in result.rpe] == [pytest.approx(0.1), pytest.approx(0.5), None]
    assert [r.rotation_deg for r in result.rpe] == [None, None, None]


def test_pairs_take_uneven_stamps():
    seconds = np.array([0.0, 0.9, 2.0, 2.9, 4.0])  # period 1.0 s: pairs 0.5 to 1.5 s apart
    result = evaluate(make_solution(seconds), make_reference(seconds), rpe_deltas_s=(1.0, 2.0))
    assert [r.pairs for r in result.rpe] == [4, 3]


def test_statistics_and_percentiles():
    s = Statistics.of(np.arange(101.0))
    assert (s.mean, s.p50, s.p67, s.p95, s.max) == pytest.approx((50.0, 50.0, 67.0, 95.0, 100.0))
    assert s.rmse == pytest.approx(np.sqrt(3350.0))


def test_matched_and_unmatched_are_counted(seconds):
    result = evaluate(make_solution(seconds), make_reference(np.arange(-5.05, 70.0, 1.0)))
    assert result.matched == 59 and result.unmatched == 17
    assert len(result.t_ns) == len(result.error_enu_m) == len(result.sigma_enu) == 59


def test_heading_error_across_180_deg(seconds):
    solution = make_solution(seconds)
    a, b = (Rotation.from_euler("z", angle, degrees=True).as_matrix() for angle in (179.0, -179.0))
    n = len(seconds)
    solution = dataclasses.replace(solution, nav_R_body=np.repeat(a[None], n, axis=0))
    quat = np.repeat(Rotation.from_matrix(b).as_quat()[None, [3, 0, 1, 2]], n, axis=0)
    result = evaluate(solution, dataclasses.replace(make_reference(seconds), quat=quat))
    assert result.rotation_deg.max == pytest.approx(2.0)
    assert result.nees["yaw"] == pytest.approx(np.radians(2.0) ** 2 / 0.01)


@pytest.mark.parametrize(("scale", "inside"), [(1.0, True), (2.0, False), (0.5, False)])
def test_nees_of_sampled_errors(seconds, scale, inside):
    rng = np.random.default_rng(11)
    A = 0.1 * rng.normal(size=(15, 15))
    P = A @ A.T / 15 + 1e-4 * np.eye(15)
    solution, e = make_solution(seconds, scale * P), rng.multivariate_normal(np.zeros(15), P, size=len(seconds))
    solution = dataclasses.replace(
        solution,
        nav_R_body=Rotation.from_rotvec(-e[:, :3]).as_matrix() @ solution.nav_R_body,
        nav_t_body=solution.nav_t_body + e[:, 3:6],
        nav_v_body=solution.nav_v_body + e[:, 6:9],
    )
    result = evaluate(solution, make_reference(seconds))
    for name, dof in (("position", 3), ("velocity", 3), ("attitude", 3), ("yaw", 1)):
        low, high = average_nees_bounds(dof, len(seconds), 0.9999)
        assert bool(low < result.nees[name] < high) is inside, name


def test_attitude_errors_are_weighed_in_nav_axes(seconds):
    """2 sigma about east, while the device heads east: in body axes it would be 0.2 sigma."""
    n = len(seconds)
    heading = Rotation.from_euler("z", 90.0, degrees=True)
    quat = np.repeat((Rotation.from_rotvec([0.02, 0.0, 0.0]) * heading).as_quat()[None, [3, 0, 1, 2]], n, axis=0)
    P = np.diag(np.r_[0.01**2, 0.1**2, 0.1**2, np.ones(12)])
    solution = dataclasses.replace(
        make_solution(seconds, P), nav_R_body=np.repeat(heading.as_matrix()[None], n, axis=0)
    )
    result = evaluate(solution, dataclasses.replace(make_reference(seconds), quat=quat))
    assert result.nees["attitude"] == pytest.approx(4.0)
    assert result.nees["yaw"] == pytest.approx(0.0, abs=1e-9)


def test_nees_of_sparse_keyframes_is_not_spoilt_by_interpolation():
    keyframes = np.arange(0.0, 60.0, 1.0)
    solution = make_solution(keyframes, 1e-4 * np.eye(15))  # 1 cm
    result = evaluate(solution, make_reference(np.arange(0.05, 60.0, 0.1)))
    assert result.ape_m.max > 0.05  # m: the bend between keyframes
    assert result.nees["position"] < 0.1
    holed = make_reference(np.concatenate([np.arange(0.05, 20.0, 0.1), np.arange(28.0, 60.0, 0.1)]))
    assert evaluate(solution, holed).nees["position"] < 0.1


def test_a_noisy_reference_says_so_itself(seconds):
    rng = np.random.default_rng(2)
    reference = make_reference(seconds)
    n = len(seconds)
    reference = dataclasses.replace(
        reference, enu=reference.enu + 0.5 * rng.normal(size=(n, 3)), sigma=np.full((n, 3), 0.5)
    )
    low, high = average_nees_bounds(3, n, 0.9999)
    assert low < evaluate(make_solution(seconds, 1e-6 * np.eye(15)), reference).nees["position"] < high


def test_what_is_unknown_is_none(seconds):
    solution = make_solution(seconds, np.zeros((15, 15)))
    result = evaluate(solution, make_reference(seconds, attitude=False, velocity=False))
    assert result.rotation_deg is None and result.rotation_error_deg is None
    assert result.nees == {"position": None, "velocity": None, "attitude": None, "yaw": None}
    assert any("not positive definite at 600 of 600" in note for note in result.notes)
    assert any("no velocity" in note for note in result.notes)


def test_json_has_the_documented_keys(seconds):
    result = evaluate(
        make_solution(seconds), make_reference(seconds), solution_name="causal", reference_name="truth.csv"
    )
    data = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    names = "solution reference align time_offset_s matched unmatched ape_m rotation_deg rpe nees"
    assert list(data) == names.split()
    assert list(data["ape_m"]) == list(data["rotation_deg"]) == ["rmse", "mean", "p50", "p67", "p95", "max"]
    assert [list(r) for r in data["rpe"]] == [["delta_s", "translation_m", "rotation_deg"]] * 3
    assert set(data["nees"]) >= {"position", "velocity", "attitude"}
    assert data["solution"] == "causal" and data["reference"] == "truth.csv"


def test_alignment_leaves_the_home_folder_alone(tmp_path):
    code = (
        "import numpy as np, sys; from smartnav_graph.evaluation.align import fit; "
        "x = np.random.default_rng(0).normal(size=(9, 3)); fit('se3', x, x); "
        "assert 'matplotlib' not in sys.modules"
    )
    env = {**os.environ, "HOME": str(tmp_path)}
    env.pop("DISPLAY", None)
    subprocess.run([sys.executable, "-c", code], check=True, env=env)
    assert list(tmp_path.iterdir()) == []

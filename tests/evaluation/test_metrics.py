from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from differences import average_nees_bounds
from planted_run import make_reference, make_solution
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core.errors import InputTypeError
from smartnav_graph.evaluation import Statistics, evaluate
from smartnav_graph.evaluation.metrics import nees, nees_verdict


def noisy(seconds, rng, sigma_m=0.3, sigma_rad=0.05):
    solution = make_solution(seconds)
    turn = Rotation.from_rotvec(sigma_rad * rng.normal(size=(len(seconds), 3))).as_matrix()
    return dataclasses.replace(
        solution,
        nav_t_body=solution.nav_t_body + sigma_m * rng.normal(size=(len(seconds), 3)),
        nav_R_body=turn @ solution.nav_R_body,
    )


# RMS and maximum of position (m) and attitude (deg): computed once with evo 1.38.1 from the same arrays,
# PoseTrajectory3D.align(truth, correct_scale) and metrics.APE(translation_part | rotation_angle_deg).
ABSOLUTE = {
    "none": (0.5297221491944357, 1.1723215079237665, 4.851794067318751, 10.587397257919058),
    "se3": (0.528933068209007, 1.1890752653332501, 4.854630712616748, 10.608857029613754),
    "sim3": (0.5284184308525096, 1.1585902556837873, 4.854630712616748, 10.608857029613754),
}


@pytest.mark.parametrize("method", sorted(ABSOLUTE))
def test_absolute_errors_equal_those_of_evo(seconds, method):
    result = evaluate(noisy(seconds, np.random.default_rng(5)), make_reference(seconds), align=method)
    found = (result.ape_m.rmse, result.ape_m.max, result.rotation_deg.rmse, result.rotation_deg.max)
    assert found == pytest.approx(ABSOLUTE[method], rel=1e-9)


def test_relative_errors_equal_those_of_evo(seconds):
    """Computed once with evo 1.38.1: metrics.RPE(delta=10, delta_unit=frames, all_pairs=True), rmse."""
    result = evaluate(noisy(seconds, np.random.default_rng(6)), make_reference(seconds), rpe_deltas_s=(1.0,))
    assert result.rpe[0].translation_m == pytest.approx(0.7578357841204187, rel=1e-9)
    assert result.rpe[0].rotation_deg == pytest.approx(7.09423623290292, rel=1e-9)
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
    names = "solution reference align time_offset_s matched unmatched ape_m rotation_deg rpe nees nees_verdict"
    assert list(data) == names.split()
    assert list(data["ape_m"]) == list(data["rotation_deg"]) == ["rmse", "mean", "p50", "p67", "p95", "max"]
    assert [list(r) for r in data["rpe"]] == [["delta_s", "translation_m", "rotation_deg"]] * 3
    assert set(data["nees"]) >= {"position", "velocity", "attitude"}
    assert data["solution"] == "causal" and data["reference"] == "truth.csv"


def test_percentiles_need_twenty_errors():
    few, enough = Statistics.of(np.arange(19.0)), Statistics.of(np.arange(20.0))
    assert (few.p50, few.p67, few.p95) == (None, None, None)
    assert few.max == 18.0 and few.mean == 9.0
    assert enough.p50 == 9.5


@pytest.mark.parametrize(
    ("scale", "constant", "verdict"),
    [
        (1.0, False, "sigmas right"),
        (2.0, False, "sigmas 2.1 times too small"),
        (0.5, False, "sigmas 1.9 times too large"),
        (1.5, True, "sigmas right"),  # one draw at 1.5 sigma, however often it is seen
        (9.0, True, "sigmas 9 times too small"),
    ],
)
def test_nees_in_words_counts_independent_errors(scale, constant, verdict):
    errors = np.random.default_rng(4).normal(size=(400, 3))
    if constant:
        errors = np.ones((400, 3))
    covariances = np.tile(np.eye(3), (400, 1, 1))
    average = float(nees(scale * errors, covariances).mean())
    assert nees_verdict(average, scale * errors, covariances) == verdict


def test_a_session_stands_for_its_reference(seconds):
    solution, reference = make_solution(seconds), make_reference(seconds)
    session = sn.simulate("figure-eight-60s", 1).replace(reference=reference)
    assert evaluate(solution, session).ape_m == evaluate(solution, reference).ape_m
    with pytest.raises(InputTypeError, match=r"reference: is a Session without reference; expected a Reference, or a"):
        evaluate(solution, session.replace(reference=None))
    with pytest.raises(InputTypeError, match=r"reference: is str; expected a Reference"):
        evaluate(solution, "truth.csv")
    with pytest.raises(InputTypeError, match=r"solution: is Session; expected a Solution; sn\.smooth"):
        evaluate(session, reference)

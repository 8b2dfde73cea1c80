"""Two solutions that differ by what was planted, and tables that differ where they were changed."""

from dataclasses import replace

import numpy as np
import pytest
from planted_run import make_solution
from scipy.spatial.transform import Rotation

from smartnav_graph.core.errors import SessionError
from smartnav_graph.evaluation.compare import MEASURES, compare, figure_differences, rejected_sets

SECONDS = np.arange(0.0, 20.0, 0.5)
BY_NAME = {measure.name: measure for measure in MEASURES}


@pytest.fixture
def first():
    return make_solution(SECONDS)


@pytest.fixture
def second(first):
    """3 m east, 4 m north, 2 m up of the first (at 10 s ten times as much), turned by 0.1 rad, twice as unsure."""
    shift = np.tile([3.0, 4.0, 2.0], (len(first), 1))
    shift[20] *= 10.0
    turn = Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix()
    return replace(
        first,
        nav_t_body=first.nav_t_body + shift,
        nav_R_body=turn @ first.nav_R_body,
        nav_v_body=first.nav_v_body + np.array([0.0, 0.3, 0.4]),
        gyro_bias=first.gyro_bias + np.radians([0.0, 0.0, 0.5]),
        covariance=4.0 * first.covariance,
    )


def test_what_was_planted_is_reported(first, second):
    found = compare(first, second)
    assert len(found) == len(first)
    assert found.statistics(BY_NAME["horizontal_m"]).statistics.p50 == pytest.approx(5.0)
    assert found.statistics(BY_NAME["height_m"]).statistics.max == pytest.approx(20.0)
    assert found.statistics(BY_NAME["heading_deg"]).statistics.rmse == pytest.approx(np.degrees(0.1))
    assert found.statistics(BY_NAME["rotation_deg"]).statistics.max == pytest.approx(np.degrees(0.1))
    assert found.statistics(BY_NAME["velocity_m_s"]).statistics.mean == pytest.approx(0.5)
    assert found.statistics(BY_NAME["gyro_bias_deg_s"]).statistics.max == pytest.approx(0.5)
    assert found.statistics(BY_NAME["accel_bias_m_s2"]).statistics.max == 0.0
    np.testing.assert_allclose(found.difference[0, 3:6], [3.0, 4.0, 2.0])  # second less first
    np.testing.assert_allclose(found.difference[0, :3], [0.0, 0.0, 0.1], atol=1e-12)


def test_where_it_is_largest_and_how_much_of_a_sigma(first, second):
    one = compare(first, second).statistics(BY_NAME["position_m"])
    assert one.largest_at_s == 10.0
    # of the two the second is the less sure: 0.2 m on each axis
    assert one.largest_sigmas == pytest.approx(10 * np.sqrt(29) / (0.2 * np.sqrt(3)))
    assert one.sigma_ratio == pytest.approx(2.0)


def test_the_largest_differences_stay_apart(first, second):
    found = compare(first, second)
    rows = found.largest(3, 4.0)
    assert rows[0] == 20
    assert (np.abs(np.diff(np.sort(found.seconds[rows]))) >= 4.0).all()


def test_other_epochs_are_compared_by_interpolation(first):
    """A run at other epochs: linear in between, so a smooth path differs by its curvature only."""
    found = compare(first, make_solution(SECONDS[:-1] + 0.25))
    assert len(found) == len(first) - 2
    assert found.statistics(BY_NAME["position_m"]).statistics.max < 0.05


def test_runs_without_a_common_time_are_refused(first):
    with pytest.raises(SessionError, match="no time in common; expected two runs of one session"):
        compare(first, make_solution(SECONDS + 100.0))


def test_rejected_rows_that_only_one_run_has():
    def summary(**rows):
        return {"rejections": [{"sensor": name, "row": row} for name, numbers in rows.items() for row in numbers]}

    found = rejected_sets(summary(gnss=[1, 2, 3], image_pairs=[7]), summary(gnss=[3, 2, 9]))
    assert found["gnss"] == {"both": 2, "only_first": [1], "only_second": [9]}
    assert found["image_pairs"] == {"both": 0, "only_first": [7], "only_second": []}
    assert rejected_sets({}, {}) == {}


def test_only_figures_that_differ_are_reported():
    one = {
        "mode": "batch",
        "path_m": 3.0,
        "chi2_per_dof": {"overall": 1.0},
        "withheld": {"gnss": {"rms_horizontal_m": 2}},
    }
    other = {"mode": "batch", "path_m": 4.0, "chi2_per_dof": {"overall": 1.5}, "used": {"gnss": 7}}
    assert figure_differences(one, other) == {
        "path_m": (3.0, 4.0),
        "chi2_per_dof.overall": (1.0, 1.5),
        "withheld.gnss": (2, None),
        "used.gnss": (None, 7),
    }
    assert figure_differences(one, one) == {}


def test_rounding_is_no_difference(first):
    """One unit in the last place of every number: two runs on two machines."""
    changed = {name: np.nextafter(getattr(first, name), np.inf) for name in ("nav_t_body", "nav_v_body", "gyro_bias")}
    found = compare(first, replace(first, **changed))
    assert (found.difference == 0.0).all() and found.statistics(BY_NAME["position_m"]).statistics.max == 0.0
    off = compare(first, replace(first, nav_t_body=first.nav_t_body + 1e-6))  # a micrometre is more than rounding
    assert found.t_ns is not None and (off.difference[:, 3:6] != 0.0).all()
    assert figure_differences({"path_m": 18.7299001}, {"path_m": 18.7299002}) == {}
    assert figure_differences({"path_m": 18.7299}, {"path_m": 18.7300}) == {"path_m": (18.7299, 18.7300)}

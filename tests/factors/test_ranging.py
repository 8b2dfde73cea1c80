"""Ranges to anchors: the model by hand, the start by multilateration, outliers, batch and replay, covariance."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from differences import average_nees_bounds
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core import frames
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.estimate.alignment.multilateration import multilaterate
from smartnav_graph.evaluation.metrics import nees
from smartnav_graph.factors.ranging import AnchorRange, RangeConfig
from smartnav_graph.readers import load
from smartnav_graph.session.calibration.model import Calibration, RangeNoise
from smartnav_graph.session.session import Session
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.fixes import RangeModel
from smartnav_graph.simulation.recording import Scenario

# A walk of a minute goes east and south, up to 60 m; anchors of one height would hardly tell that of the walker.
AROUND = ((-15.0, 20.0, 0.0), (50.0, 15.0, 12.0), (45.0, -60.0, 2.0), (-15.0, -65.0, 15.0), (15.0, -20.0, 8.0))
ARM = (0.05, 0.10, 0.02)


def walk(seed: int, *, seconds: float = 30.0, **model: object) -> Session:
    """A walk with ranges and the inertial data alone."""
    ranges = RangeModel(**{"anchors": AROUND, "body_t_sensor": ARM, **model})
    return Scenario("walk", seconds, motions.walk, "none", ranges=ranges)(seed)


@cache
def detours() -> Session:
    """One range of twenty is two to eight metres too long."""
    return walk(1, seconds=60.0, detours=0.05)


@cache
def run(causal: bool) -> object:
    return sn.run(detours(), causal=causal)


def errors(session: Session, solution: sn.Solution) -> np.ndarray:
    """True minus estimated position (n, 3) at the epochs of the truth."""
    _, rows, true = np.intersect1d(solution.t_ns, session.reference.t_ns, return_indices=True)
    return session.reference.enu[true] - solution.nav_t_body[rows]


# --- model ------------------------------------------------------------------------------------------------------------


def test_a_range_by_hand():
    # 3-4-5: the sensor is 1 m ahead of a body that is turned to the left by 90 deg
    turned = np.array([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    data = np.array([[3.0, 5.0, 0.0, 1.0, 0.0, 0.0, 5.3, 0.1]])
    residual, by_state, (by_bias,) = AnchorRange(("R",)).observe(
        turned, np.zeros((1, 3)), np.zeros((1, 3)), [np.array([[0.2]])], data
    )
    assert residual == pytest.approx((5.0 + 0.2 - 5.3) / 0.1)
    np.testing.assert_allclose(by_state[0, 0], [0, 0, 6, -6, -8, 0, 0, 0, 0], atol=1e-12)  # closer by turning right
    assert by_bias == pytest.approx(10.0)


@pytest.mark.parametrize("wrong", [{"loss": "cauchy"}, {"gate_probability": 1.0}])
def test_wrong_options_are_refused(wrong):
    with pytest.raises(ConfigError, match=r"config \[ranges\]"):
        RangeConfig(**wrong)


def test_a_negative_range_is_refused():
    ranges = walk(0, seconds=2.0).ranges
    with pytest.raises(SessionError, match=r"range_m is -1\.0 at row 2"):
        replace(ranges, range_m=np.where(np.arange(len(ranges)) == 2, -1.0, ranges.range_m))


# --- start ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("anchors", [3, 4, 5])
def test_multilateration_of_exact_ranges_is_within_the_prior_of_the_height(anchors):
    session = walk(0, sigma_m=1e-6, bias_sigma_m=0.0, anchors=AROUND[:anchors], body_t_sensor=(0.0, 0.0, 0.0))
    found = multilaterate(session.ranges, session.nav_position(session.ranges), np.full(len(session.ranges), 0.1))
    true = session.reference.enu[np.searchsorted(session.reference.t_ns, found.t_ns)]
    assert len(found.t_ns) == 60
    assert np.abs(found.position - true)[:, :2].max() < 1.0  # m: the height is off by 6 m, 40 m away
    assert np.abs(found.position - true)[:, 2].max() < 8.0


def test_anchors_heard_one_after_the_other_make_groups_of_one_round():
    session = walk(0, sigma_m=1e-6, bias_sigma_m=0.0)
    ranges = session.ranges
    one_each = ranges.take(np.arange(0, len(ranges), 6))  # A0 at 0 s, A1 at 0.5 s, A2 at 1 s
    with pytest.raises(SessionError, match="no 3 anchors within 1 s"):
        multilaterate(one_each, session.nav_position(one_each), np.full(len(one_each), 0.1))
    found = multilaterate(ranges, session.nav_position(ranges), np.full(len(ranges), 0.1))
    assert found.row.tolist() == list(range(0, len(ranges), 5))


@pytest.mark.parametrize(
    ("anchors", "what"),
    [(AROUND[:2], "2 anchors"), (((0, 9, 3), (10, 9, 3), (20, 9, 4), (30, 9, 3)), "all 4 anchors on a line")],
)
def test_a_start_that_the_anchors_leave_ambiguous_is_refused(anchors, what):
    with pytest.raises(SessionError, match=f"{what}: the position is ambiguous.*--initial"):
        sn.smooth(walk(0, seconds=10.0, anchors=anchors))


def test_two_anchors_are_enough_beside_a_given_start():
    session = walk(0, anchors=AROUND[:2])
    R = Rotation.from_quat(session.reference.quat[:1, [1, 2, 3, 0]]).as_matrix()
    heading = frames.heading_pitch_roll_deg(R, session.device.forward)[0, 0]
    east, north, up = session.reference.enu[0]
    solution = sn.smooth(session, initial=f"{east},{north},{up},{heading},0.5,5")
    assert np.linalg.norm(errors(session, solution)[:, :2], axis=1).max() < 3.0


# --- runs -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("causal", [False, True])
def test_ranges_alone_are_no_dead_reckoning(causal):
    summary = run(causal).summary
    assert summary["mode"].startswith("replay" if causal else "batch")
    assert not any("dead reckoning" in text or "no absolute" in text for text in summary["warnings"])
    assert summary["factors"]["ranges"] == len(detours().ranges)
    assert summary["chi2_per_dof"]["ranges"] == pytest.approx(1.0, abs=0.15)
    assert set(summary["states"]) >= {f"ranges_bias_A{i}_m" for i in range(5)}


def test_detours_are_left_out_and_good_ranges_stay():
    is_outlier = detours().ranges.extra["is_outlier"].astype(bool)
    rejected = np.zeros(len(is_outlier), dtype=bool)
    rejected[[one["row"] for one in run(False).summary["rejections"] if one["sensor"] == "ranges"]] = True
    assert rejected[is_outlier].mean() > 0.95
    assert rejected[~is_outlier].mean() < 0.01
    assert np.sqrt((errors(detours(), run(False).solution)[:, :2] ** 2).mean()) < 0.15  # m; biases have 0.2 m


def test_a_gate_that_lets_everything_in_shows():
    kept = sn.smooth(detours(), sn.Config(ranges=RangeConfig(loss="none")))
    assert np.sqrt((errors(detours(), kept)[:, :2] ** 2).mean()) > 0.3


def test_replay_is_near_as_soon_as_it_has_begun():
    causal = errors(detours(), run(True).causal)
    assert np.sqrt((causal[len(causal) // 3 :, :2] ** 2).mean()) < 0.4


def test_a_late_range_is_used_at_its_own_time():
    session = walk(2)
    late = session.replace(ranges=replace(session.ranges, arrival_ns=session.ranges.t_ns + 300_000_000))
    used, causal = sn.run(late, causal=True), errors(session, sn.run(session, causal=True).causal)
    assert used.summary["factors"]["ranges"] >= 0.98 * len(session.ranges)
    half = errors(session, used.causal)
    rms = [float(np.sqrt((rows[len(rows) // 2 :, :2] ** 2).mean())) for rows in (half, causal)]
    assert rms[0] < rms[1] + 0.15, rms  # taken as of their arrival they would be off by 0.4 m: 0.3 s at 1.35 m/s


def test_a_folder_of_csv_files_has_ranges(tmp_path):
    session = walk(0, seconds=3.0)
    for name in ("imu", "ranges"):
        columns = getattr(session, name).columns()
        rows = zip(*columns.values(), strict=True)
        text = "\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)])
        (tmp_path / f"{name}.csv").write_text(text + "\n")
    origin = "[origin]\nlat_deg = 52.0\nlon_deg = 11.0\nheight_m = 100.0\n"
    (tmp_path / "session.toml").write_text(f"schema = 1\n{origin}[sensors.ranges]\nbody_t = [0.05, 0.1, 0.02]\n")
    back = load(tmp_path)
    np.testing.assert_array_equal(back.ranges.range_m, session.ranges.range_m)
    assert back.ranges.anchor_id.tolist() == session.ranges.anchor_id.tolist()
    assert back.mount("ranges").body_t == ARM


# --- covariance -------------------------------------------------------------------------------------------------------

SEEDS = 8


@cache
def averages(scale: float) -> dict[str, float]:
    """Mean NEES over the seeds, divided by its dimension, in the middle of the walk; `scale` is a factor on the noise
    that the estimator assumes of the ranges."""
    found: dict[str, list[float]] = {"position": [], "velocity": [], "yaw": []}
    for seed in range(SEEDS):
        session = walk(seed)
        noise = RangeNoise(0.1 * scale, 0.2 * scale)
        known = replace(session.calibration or Calibration(), range_noise=noise)
        ranges = replace(session.ranges, sigma=np.full(len(session.ranges), noise.sigma))
        solution = sn.smooth(session.replace(calibration=known, ranges=ranges))
        row = int(np.searchsorted(solution.t_ns, session.t0_ns + 15_000_000_000))
        at = int(np.searchsorted(session.reference.t_ns, solution.t_ns[row]))
        truth, P = session.reference, solution.covariance[row]
        R = Rotation.from_quat(truth.quat[at, [1, 2, 3, 0]]).as_matrix()
        turn = Rotation.from_matrix(R @ solution.nav_R_body[row].T).as_rotvec()
        off = np.concatenate(
            [turn, truth.enu[at] - solution.nav_t_body[row], truth.velocity[at] - solution.nav_v_body[row]]
        )
        for name, part in (("position", slice(3, 6)), ("velocity", slice(6, 9)), ("yaw", slice(2, 3))):
            found[name].append(float(nees(off[None, part], P[None, part, part])[0]) / (part.stop - part.start))
    return {name: float(np.mean(values)) for name, values in found.items()}


@pytest.mark.parametrize(("part", "dof"), [("position", 3), ("velocity", 3), ("yaw", 1)])
def test_the_covariance_is_that_of_the_errors(part, dof):
    low, high = (bound / dof for bound in average_nees_bounds(dof, SEEDS, 0.998))
    assert low < averages(1.0)[part] < high


@pytest.mark.parametrize("scale", [0.3, 3.0])
def test_that_bound_sees_a_wrong_noise(scale):
    low, high = (bound / 3 for bound in average_nees_bounds(3, SEEDS, 0.998))
    assert not low < averages(scale)["position"] < high

"""Errors between fixes: what counts, what is predicted, what is generated from a reference."""

import json

import numpy as np
import pytest
from exact import record
from scipy.spatial.transform import Rotation

from smartnav_graph.cli import main
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.evaluation.intervals import FIXES, FixesFromReference, intervals, with_fixes
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.session.streams import Reference
from smartnav_graph.simulation import motions

GOOD = FixesFromReference(0.01, 0.5)


@pytest.fixture(scope="module")
def walk():
    """A walk of 50 s with fixes of a decimetre each second, and its truth at 20 Hz."""
    made = record(motions.walk(45.0, np.random.default_rng(2)), noise=DEVICE_CLASSES["mems"], fix_sigma=0.1, seed=1)
    session = made.session.replace(control=None)
    t_ns = session.imu.t_ns[::5]
    truth = made.truth(t_ns)
    quat = Rotation.from_matrix(truth.nav_R_body).as_quat(canonical=True)[:, [3, 0, 1, 2]]
    return session.replace(reference=Reference(t_ns=t_ns, enu=truth.nav_t_body, quat=quat))


@pytest.fixture(scope="module")
def found(walk):
    rows = list(intervals(walk, walk.reference, (1.0, 3.0), generated=GOOD))
    return {(row.every_s, row.kind): row for row in rows}


def test_fixes_are_generated_from_the_reference(walk):
    made = with_fixes(walk, walk.reference, 2.0, FixesFromReference(0.5, 3.0, 1.0), seed=4)
    assert made.gnss is None and made.control is None
    fixes = made.pose_fixes
    assert np.unique(np.diff(fixes.t_ns)).tolist() == [2 * NS]
    assert (fixes.arrival_ns - fixes.t_ns == NS).all()
    rows = np.searchsorted(walk.reference.t_ns, fixes.t_ns)
    error = fixes.enu - walk.reference.enu[rows]
    assert 0.35 < error.std() < 0.65 and (fixes.sigma == 0.5).all()  # 69 draws of 0.5 m
    again = with_fixes(walk, walk.reference, 2.0, FixesFromReference(0.5, 3.0), seed=4).pose_fixes
    assert (again.enu == fixes.enu).all() and again.arrival_ns is None
    other = with_fixes(walk, walk.reference, 2.0, FixesFromReference(0.5), seed=5).pose_fixes
    assert other.quat is None and (other.enu != fixes.enu).all()


def test_a_lost_stretch_of_the_reference_gives_no_fix(walk):
    seconds = walk.seconds(walk.reference.t_ns)
    lost = walk.reference.take((seconds < 10.0) | (seconds > 13.5))
    times = walk.seconds(with_fixes(walk, lost, 1.0, GOOD, 0).pose_fixes.t_ns)
    assert not ((times > 10.0) & (times < 13.5)).any()
    assert np.diff(times).max() == pytest.approx(4.0, abs=0.1)  # 10 s, the row just before, then 14 s


def test_kinds_and_counts(found, walk):
    assert [kind for every, kind in found if every == 1.0] == ["smoothed", "causal", "causal_end"]
    assert found[1.0, "smoothed"].n == 1000 - 50  # 50 s at 20 Hz up to the last fix, less the fixes
    # one end an interval, of the 20 s after the initialisation
    assert 18 <= found[1.0, "causal_end"].n <= 20 and 6 <= found[3.0, "causal_end"].n <= 7
    for row in found.values():
        assert row.horizontal_mean_m <= row.mean_m <= row.rmse_m and row.seed == 0
        if row.n < 20:
            assert row.p67_m is None and row.horizontal_p95_m is None
        else:
            assert row.p67_m <= row.p95_m and row.rmse_m <= row.p95_m


def test_smoothed_beats_causal_beats_the_end_and_longer_is_worse(found):
    for every in (1.0, 3.0):
        kinds = [found[every, kind].mean_m for kind in ("smoothed", "causal", "causal_end")]
        assert kinds == sorted(kinds)
    assert found[3.0, "causal_end"].mean_m > 2.0 * found[1.0, "causal_end"].mean_m
    assert found[1.0, "smoothed"].mean_m < 0.02  # m, fixes of 0.01 m


def test_the_end_is_predicted_not_known(walk):
    # were the fix at the interval's end known, the error were that of the fix itself, 0.016 m in space
    rows = list(intervals(walk, walk.reference, (3.0,), generated=FixesFromReference(0.01)))
    assert rows[2].kind == "causal_end" and rows[2].mean_m > 0.05


def test_latency_lengthens_the_causal_error_and_spares_the_smoothed(walk, found):
    late = list(intervals(walk, walk.reference, (3.0,), generated=FixesFromReference(0.01, 0.5, 1.0)))
    assert late[0].mean_m == pytest.approx(found[3.0, "smoothed"].mean_m, rel=0.05)
    assert late[2].mean_m > found[3.0, "causal_end"].mean_m


def test_own_fixes_are_thinned(walk):
    rows = list(intervals(walk, walk.reference, (5.0,)))
    assert [row.kind for row in rows] == ["smoothed", "causal", "causal_end"]
    assert rows[0].mean_m < 0.6 and rows[2].n <= 5


def test_what_is_refused(walk):
    with pytest.raises(SessionError, match=r"1 fixes with one in 100 s; expected at least two"):
        next(iter(intervals(walk, walk.reference, (100.0,))))
    with pytest.raises(ConfigError, match="--every: 0; expected spacings > 0 s"):
        next(iter(intervals(walk, walk.reference, (0,))))
    with pytest.raises(ConfigError, match=r"--fix-sigma, --latency: 0.0 m"):
        FixesFromReference(0.0)
    bare = Reference(t_ns=walk.reference.t_ns, enu=walk.reference.enu)
    with pytest.raises(SessionError, match="reference: has no attitude"):
        with_fixes(walk, bare, 1.0, GOOD, 0)
    away = Reference(t_ns=walk.reference.t_ns + 10**15, enu=walk.reference.enu)
    with pytest.raises(SessionError, match="reference: has no row inside the inertial span"):
        with_fixes(walk, away, 1.0, GOOD, 0)


def test_the_command(walk, tmp_path, capsys):
    path = tmp_path / "walk"
    session_folder.save(walk, path)
    made = ["--fixes-from-reference", "--fix-sigma", "0.01,0.5", "--seeds", "1", "--sensors", FIXES, "--quiet"]
    asked = ["intervals", str(path), "--every", "3", "--reference", str(path), *made]
    assert main([*asked, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["kind"] for row in rows] == ["smoothed", "causal", "causal_end"]
    assert {"every_s", "kind", "seed", "n", "mean_m", "p67_m", "p95_m", "rmse_m"} <= set(rows[0])
    assert main(["intervals", str(path), "--every", "x", "--reference", str(path)]) == 1
    assert "--every: 'x'; expected numbers separated by commas" in capsys.readouterr().err
    session_folder.save(walk.replace(reference=None), tmp_path / "bare")
    assert main(["intervals", str(tmp_path / "bare"), "--every", "1", "--reference", str(tmp_path / "bare")]) == 1
    assert "contains no reference" in capsys.readouterr().err

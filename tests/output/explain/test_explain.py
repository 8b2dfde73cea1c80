"""What determines a state of a run: the right epoch, the right sentences, and errors with a remedy."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.evaluation.influence import Group, Influence, Keyframes, Measurements
from smartnav_graph.graph.states import key
from smartnav_graph.output.explain import explain
from smartnav_graph.output.explain.nearby import nearby
from smartnav_graph.output.explain.sentences import _in_use
from smartnav_graph.output.run_folder import plain, read_run, write_run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    write_run(sn.run(sn.simulate("figure-eight-60s", 3), end_s=20.0), path, report=False, recording=False)
    return path


@pytest.fixture
def stored(folder):
    return read_run(folder)


def sentence_of(found, start: str) -> str:
    """The one sentence that begins so."""
    (sentence,) = [sentence for sentence in found.sentences if sentence.startswith(start)]
    return sentence


def test_without_a_time_the_least_certain_epoch_is_explained(stored):
    found = explain(stored)
    horizontal = np.hypot(*stored.solution.sigmas[:, 3:5].T)
    t_s = stored.solution.seconds[horizontal.argmax()]
    assert sentence_of(found, "Largest position").startswith(f"Largest position uncertainty of the run: at {t_s:.2f} s")
    (sigma,) = re.findall(r"position ([0-9.]+) m horizontal", sentence_of(found, "1 sigma"))
    assert float(sigma) == pytest.approx(horizontal.max(), rel=0.01)  # less errors of sensors that are no states


def test_a_time_is_explained_by_the_nearest_keyframe(stored):
    at = float(stored.solution.seconds[10])
    assert sentence_of(explain(stored, at), "At ").startswith(f"At {at:.2f} s (keyframe 11 of {len(stored.solution)}")
    assert f"the keyframe nearest to {at + 0.1:.2f} s" in explain(stored, at + 0.1).sentences[0]


def test_figures_add_up(stored):
    figures = explain(stored, 10.0).to_dict()
    for component in figures["components"]:
        assert sum(component["share"].values()) == pytest.approx(1.0), component["name"]
    assert figures["balanced"]
    for side in ("east", "north", "up", "heading_clockwise"):
        assert sum(shift[side] for shift in figures["shift_sigmas"].values()) == pytest.approx(0.0, abs=0.01)
    assert json.loads(json.dumps(plain(figures), allow_nan=False))["sentences"]


def test_positions_depend_on_the_only_fixes(stored):
    found = explain(stored, 10.0)
    assert re.search(r"position\b.* not observable", sentence_of(found, "Without the source GNSS"))
    east = found.to_dict()["components"][0]
    assert east["name"] == "east" and "gnss" in east["depends_on"] and east["sigma_factor_without"]["gnss"] is None
    assert not [sentence for sentence in found.sentences if sentence.startswith("Without the source Calibration")]


def test_a_single_fix_with_priors(stored, tmp_path):
    """One fix of 3 m and priors: the fix has all of the position, the prior all of the heading."""
    x, v, b = (np.array([[key(letter, 0)]], dtype=np.uint64) for letter in "XVB")
    t_ns, row = stored.solution.t_ns[:1], np.array([0])

    def group(sensor, keys, J, pull=0.0):
        return Group(sensor, t_ns, row, keys, np.column_stack([J, np.full(len(J), pull)])[None])

    known = [group("prior", x, np.eye(6)[:3]), group("prior", v, np.eye(3)), group("prior", b, np.eye(6))]
    frames = Keyframes(np.array([0]), t_ns, np.array(["first"], dtype=object), np.eye(3)[None])
    Influence([*known, group("gnss", x, np.eye(6)[3:] / 3.0)], frames).write(tmp_path)
    found = explain(replace(stored, path=tmp_path), float(stored.solution.seconds[0]))
    assert sentence_of(found, "Horizontal position").endswith("variance by source: GNSS 100 %.")
    assert "Heading variance by source: Initial state 100 %" in " ".join(found.sentences)
    assert "heading, tilt and velocity not observable" in sentence_of(found, "Without the source Initial state")
    assert "position 4.243 m horizontal" in sentence_of(found, "1 sigma")  # 3 m on each of two axes
    assert "measurements at this epoch: east 100 %, north 100 %" in sentence_of(found, "Share")
    assert "keyframe 1 of 1, the first" in found.sentences[0]


def test_what_is_near():
    summary = {
        "gaps": [{"start_s": 1.0, "length_s": 2.0, "kind": "bridged"}, {"start_s": 20.0, "length_s": 1.0, "kind": "m"}],
        "standstills": {"spans_s": [[0.0, 4.0], [30.0, 31.0]]},
        "rejections": [{"t_s": 3.0, "sensor": "gnss", "row": 3, "size_sigma": 9.0}, {"t_s": 9.0, "sensor": "a"}],
    }
    run = SimpleNamespace(summary=summary, solution=SimpleNamespace(t0_ns=0))
    stamps = np.array([4.0, 7.5, 5.0]) * 1e9
    source, zeros = np.array(["gnss", "gnss", "imu"], dtype=object), np.zeros((3, 1))
    rows = Measurements(source, stamps.astype(np.int64), zeros, zeros, zeros, np.zeros(3, bool))
    found = nearby(run, rows, 5.0)
    assert (found.gap.start_s, found.gap.away_s, found.gap.length_s) == (1.0, -2.0, 2.0)
    assert (found.standstill.start_s, found.standstill.away_s) == (0.0, -1.0)
    assert (found.rejection.sensor, found.rejection.away_s) == ("gnss", -2.0)
    assert set(found.used) == {"gnss"}
    assert (found.used["gnss"].before_s, found.used["gnss"].after_s) == (1.0, 2.5)
    assert nearby(run, rows, 2.0).gap.away_s == 0.0
    nothing = nearby(SimpleNamespace(summary={}, solution=run.solution), rows, 5.0)
    assert (nothing.gap, nothing.standstill, nothing.rejection) == (None, None, None)


def test_in_an_outage_only_real_fixes_are_near():
    """Fixes every second with none from 20 to 30 s, and a tie of their correlated error every second."""
    fixes = np.array([*range(21), *range(30, 41)], dtype=np.int64)
    stamps = np.concatenate([fixes, np.arange(41)]) * 10**9
    part = np.arange(len(stamps)) >= len(fixes)
    source = np.full(len(stamps), "gnss", dtype=object)
    rows = Measurements(source, stamps, *[np.zeros((len(stamps), 1))] * 3, part)
    run = SimpleNamespace(summary={}, solution=SimpleNamespace(t0_ns=0))
    found = nearby(run, rows, 26.0)
    assert (found.used["gnss"].before_s, found.used["gnss"].after_s) == (6.0, 4.0)
    assert list(_in_use(found)) == [
        "Nearest measurements in use: GNSS 6.00 s before, 4.00 s after.",
        "This epoch is inside an outage: no GNSS in use between 20.0 and 30.0 s.",
    ]
    assert nearby(run, rows, 45.0).outages == {"gnss": (40.0, None)}
    assert not nearby(run, rows, 10.0).outages and not nearby(run, rows, 20.0).outages
    assert not nearby(run, rows, 35.5).outages


def test_ties_of_a_correlated_error_are_no_measurements(tmp_path):
    """A phone's fixes, those of ten seconds withheld."""
    run = sn.run(sn.simulate("phone-car-5min", 3), start_s=10.0, end_s=60.0, withhold=("gnss:outage=30-40",))
    write_run(run, tmp_path / "run", report=False, recording=False)
    found = explain(read_run(tmp_path / "run"), 35.0)
    assert "gnss_correlated_error" in {group.sensor for group in found.figures.influence.groups}
    assert "no GNSS in use between 29." in sentence_of(found, "This epoch is inside an outage")
    assert all(row["row"] >= 0 for row in found.to_dict()["measurements"] if row["source"] == "gnss")


@pytest.mark.parametrize("at", [-0.5, 20.5, float("nan")])
def test_a_time_outside_the_run_is_refused(stored, at):
    with pytest.raises(ConfigError, match=r"--at: .* s; expected 0\.\d* to \d+\.\d* s, the time span of the run"):
        explain(stored, at)


@pytest.mark.parametrize("missing", ["influence.parquet", "keyframes.parquet"])
def test_a_run_without_its_system_is_refused(stored, tmp_path, missing):
    for name in {"influence.parquet", "keyframes.parquet"} - {missing}:
        (tmp_path / name).write_bytes((stored.path / name).read_bytes())
    with pytest.raises(SessionError, match=f"holds no {missing}; expected a run with its linear system; smooth the"):
        explain(replace(stored, path=tmp_path), 10.0)


def test_a_damaged_system_is_refused(stored, tmp_path):
    for name in ("influence.parquet", "keyframes.parquet"):
        (tmp_path / name).write_bytes(b"nothing")
    with pytest.raises(SessionError, match="cannot be read"):
        explain(replace(stored, path=tmp_path), 10.0)

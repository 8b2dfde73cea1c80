"""The run folder: complete or not at all, and what is read back is what was written."""

import csv
import errno
import json
import math
import os
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import smartnav_graph as sn
from smartnav_graph.core.errors import SessionError
from smartnav_graph.estimate import config
from smartnav_graph.output import rerun_log
from smartnav_graph.output.run_folder import check_out, config_differences, plain, read_run, recorded, write_run
from smartnav_graph.session.calibration import model as calibration_model
from smartnav_graph.session.session import Mount

OPTIONS = {"end_s": 20.0, "initial": "0,0,0,0,3,30"}


@pytest.fixture(scope="module")
def session():
    return sn.simulate("figure-eight-60s", 3)


@pytest.fixture(scope="module")
def run(session):
    return sn.run(session, withhold=("gnss:every=2",), **OPTIONS)


@pytest.fixture(scope="module")
def replayed(session):
    return sn.run(session, causal=True, **OPTIONS)


def columns(path: Path) -> dict[str, list]:
    return pq.read_table(path).to_pydict()


def test_every_file_of_a_batch_run(run, tmp_path):
    write_run(run, tmp_path / "run")
    expected = {"trajectory.csv", "solution.parquet", "residuals.parquet", "withheld.parquet", "summary.json"}
    expected |= {"config.toml", "calibration.toml", "report.html", "run.rrd", "influence.parquet", "keyframes.parquet"}
    expected |= {"imu.parquet", "report.json", "settings.csv"}
    assert {file.name for file in (tmp_path / "run").iterdir()} == expected
    assert [file.name for file in tmp_path.iterdir()] == ["run"]  # no temporary left beside it


def test_states_covariance_and_residuals_read_back_exactly(run, tmp_path):
    write_run(run, tmp_path / "run", report=False, recording=False)
    stored = read_run(tmp_path / "run")
    for name in ("t_ns", "nav_t_body", "nav_v_body", "accel_bias", "gyro_bias", "covariance"):
        np.testing.assert_array_equal(getattr(stored.solution, name), getattr(run.solution, name), err_msg=name)
    np.testing.assert_allclose(stored.solution.nav_R_body, run.solution.nav_R_body, atol=1e-12)  # through a quaternion
    assert (stored.solution.t0_ns, stored.solution.origin) == (run.solution.t0_ns, run.solution.origin)
    assert (stored.solution.forward, stored.solution.up) == ("+y", "+z")
    assert (stored.causal, stored.clock_epoch) == (None, "unix")
    for name in ("t_ns", "sensor", "axis", "whitened", "weight", "used"):
        np.testing.assert_array_equal(getattr(stored.solution.residuals, name), getattr(run.solution.residuals, name))
    with pytest.raises(SessionError, match="no causal solution; expected a replayed run"):
        stored.named("causal")


def test_a_session_without_origin_reads_back_without_one(session, tmp_path):
    fix = session.gnss
    local = replace(fix, enu=session.nav_position(fix), lla=None)
    run = sn.run(session.replace(origin=None, gnss=local), **OPTIONS)
    write_run(run, tmp_path / "run", report=False, recording=False)
    assert read_run(tmp_path / "run").solution.origin is None
    with (tmp_path / "run" / "trajectory.csv").open() as file:
        assert {row["lat_deg"] for row in csv.DictReader(file)} == {""}


def test_heights_above_the_sea_are_known_to_the_folder(session, tmp_path):
    run = sn.run(session.replace(sensors={"gnss": Mount(frame="msl")}), **OPTIONS)
    write_run(run, tmp_path / "run", report=False, recording=False)
    assert read_run(tmp_path / "run").solution.heights == "above mean sea level (geoid not known)"


def test_withheld_rows_give_the_figures_of_the_summary(run, tmp_path):
    summary = write_run(run, tmp_path / "run", report=False, recording=False)
    rows = columns(tmp_path / "run" / "withheld.parquet")
    assert list(rows) == ["t_ns", "sensor", "de_m", "dn_m", "du_m"]
    told = summary["withheld"]["gnss"]
    assert told["count"] == len(rows["t_ns"]) == 10  # of fixes 0 ... 20 s every second one
    rms = math.sqrt(np.mean(np.square(rows["de_m"]) + np.square(rows["dn_m"])))
    assert told["rms_horizontal_m"] == pytest.approx(rms, rel=1e-12)


def test_report_and_recording_see_the_rows_kept_back(run, session):
    whole = recorded(run)
    kept = np.isin(whole.gnss.t_ns, run.session.gnss.t_ns)
    np.testing.assert_array_equal(kept, np.arange(21) % 2 == 0)  # every second one of 20 s, each at its place
    np.testing.assert_array_equal(whole.gnss.lla, session.gnss.lla[:21])
    np.testing.assert_array_equal(whole.gnss.sigma, session.gnss.sigma[:21])


def test_a_replay_keeps_both_solutions(replayed, tmp_path):
    summary = write_run(replayed, tmp_path / "run")
    stored = read_run(tmp_path / "run")
    np.testing.assert_array_equal(stored.named("causal").nav_t_body, replayed.causal.nav_t_body)
    assert summary["update_ms"]["p99"] >= summary["update_ms"]["median"] > 0
    headings = [
        (tmp_path / "run" / name).read_text().splitlines()[0].split(",") for name in ("causal.csv", "trajectory.csv")
    ]
    assert headings[0] == headings[1]


def test_summary_is_plain_json_with_load_and_write_in_the_timings(run, tmp_path):
    broken = replace(run, summary={**run.summary, "cost": math.nan, "states": {"x": {"value": np.float32(math.inf)}}})
    write_run(broken, tmp_path / "run", report=False, recording=False, load_s=1.25)
    text = (tmp_path / "run" / "summary.json").read_text()
    assert not {"NaN", "Infinity"} & set(text.replace(",", " ").split())
    summary = json.loads(text)
    assert summary["cost"] is None and summary["states"]["x"]["value"] is None
    timings = summary["timings_s"]
    assert timings["load"] == 1.25 and timings["write"] > 0
    parts = sum(value for name, value in timings.items() if name != "total")
    assert timings["total"] == pytest.approx(parts, abs=0.05)  # s, what lies between the stages
    assert summary["real_time_factor"] == pytest.approx(summary["duration_s"] / timings["total"], rel=0.01)


def test_config_and_calibration_are_those_of_the_run(run, session, tmp_path):
    write_run(run, tmp_path / "run", report=False, recording=False)
    assert config.load(tmp_path / "run" / "config.toml") == run.problem.config
    assert calibration_model.load_calibration(tmp_path / "run" / "calibration.toml") == session.calibration
    assert tomllib.loads((tmp_path / "run" / "config.toml").read_text())["run"]["withhold"] == ["gnss:every=2"]


def test_differences_of_two_configurations(run, replayed, tmp_path):
    write_run(run, tmp_path / "a", report=False, recording=False)
    write_run(replayed, tmp_path / "b", report=False, recording=False)
    assert config_differences(tmp_path / "a", tmp_path / "b") == {"run.withhold": (("gnss:every=2",), ())}


@pytest.mark.parametrize(
    ("fault", "raised", "text"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), SessionError, "No space left on device"),
        (KeyboardInterrupt(), KeyboardInterrupt, None),
        (RuntimeError("anything else"), RuntimeError, "anything else"),
    ],
)
def test_a_failed_write_leaves_the_old_run_untouched(run, tmp_path, monkeypatch, fault, raised, text):
    write_run(run, tmp_path / "run", report=False, recording=False)
    before = {file.name: file.read_bytes() for file in (tmp_path / "run").iterdir()}

    def fail(*_args, **_options):
        raise fault

    monkeypatch.setattr(rerun_log, "write_recording", fail)  # by then the tables are written
    with pytest.raises(raised, match=text):
        write_run(run, tmp_path / "run", force=True)
    assert {file.name: file.read_bytes() for file in (tmp_path / "run").iterdir()} == before
    assert [file.name for file in tmp_path.iterdir()] == ["run"]


def test_a_full_disk_is_told_of_the_run_and_not_of_a_temporary(run, tmp_path, monkeypatch):
    move = os.replace

    def full(source, target):
        if Path(target).name == "run.rrd":
            raise OSError(errno.ENOSPC, "No space left on device")
        move(source, target)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(SessionError) as caught:
        write_run(run, tmp_path / "run")
    assert str(caught.value).startswith(f"{tmp_path / 'run'}: could not be written (No space left on device)")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_replaced_without_force_and_no_foreign_folder_with_it(run, tmp_path):
    write_run(run, tmp_path / "run", report=False, recording=False)
    with pytest.raises(SessionError, match="exists already"):
        write_run(run, tmp_path / "run")
    write_run(run, tmp_path / "run", force=True, report=False, recording=False)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").write_bytes(b"1")
    with pytest.raises(SessionError, match=r"holds no summary\.json, so it is not replaced"):
        write_run(run, tmp_path / "photos", force=True)
    assert (tmp_path / "photos" / "holiday.jpg").read_bytes() == b"1"
    (tmp_path / "empty").mkdir()
    check_out(tmp_path / "empty", force=False)


def test_what_is_no_run_is_named(run, tmp_path):
    with pytest.raises(SessionError, match="nowhere: is no folder; expected a run folder; make one with"):
        read_run(tmp_path / "nowhere")
    with pytest.raises(SessionError, match=r"holds no summary\.json"):
        read_run(tmp_path)
    write_run(run, tmp_path / "run", report=False, recording=False)
    (tmp_path / "run" / "solution.parquet").write_bytes(b"junk")
    with pytest.raises(SessionError, match=r"solution\.parquet: cannot be read"):
        read_run(tmp_path / "run")
    (tmp_path / "run" / "summary.json").write_text("{}")
    with pytest.raises(SessionError, match=r"summary\.json: cannot be read"):
        read_run(tmp_path / "run")


def test_plain_types():
    given = {"a": np.int64(3), "b": (np.float32(0.5), float("inf")), 7: np.array([1.0, np.nan]), "p": Path("x")}
    found = plain(given)
    assert found == {"a": 3, "b": [0.5, None], "7": [1.0, None], "p": "x"}
    assert type(found["a"]) is int and type(found["b"][0]) is float

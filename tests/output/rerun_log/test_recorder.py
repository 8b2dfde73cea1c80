"""What a recording is as a file: time lines, identity, all or nothing."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from recordings import EVALUATION, SUMMARY, T0, N, make_session, make_solution, replayed, stamps, write

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, utc_from_gps
from smartnav_graph.graph.solution import Residuals
from smartnav_graph.output.rerun_log import recorder, viewer, write_recording


def test_time_lines_count_from_time_zero_and_stand_everywhere(recording):
    t = make_solution().t_ns
    component = "Transform3D:translation"
    np.testing.assert_array_equal(recording.index("/world/est/body", component, "elapsed"), t - T0)
    np.testing.assert_array_equal(recording.index("/world/est/body", component, "utc"), t)
    np.testing.assert_array_equal(recording.index("/world/est/body", component, "keyframe"), np.arange(N))
    rows = [chunk for chunk in recording.chunks if not chunk.is_static]
    assert {frozenset(chunk.timeline_names) for chunk in rows} == {frozenset({"elapsed", "utc", "keyframe"})}


def test_a_sample_counts_to_the_keyframe_that_ends_its_window(recording):
    numbers = recording.index("/imu/accel", "Scalars:scalars", "keyframe")
    ends = make_solution().t_ns[numbers]
    t = make_session().imu.t_ns
    inside = t <= make_solution().t_ns[-1]
    assert (t[inside] <= ends[inside]).all() and (ends[inside] - t[inside] < NS).all()
    assert (numbers[~inside] == N - 1).all()


def test_raw_clock_stands_in_for_a_clock_that_is_no_date(tmp_path):
    found = write(tmp_path / "run.rrd", session=make_session(clock_epoch="boot"))
    names = {name for chunk in found.chunks for name in chunk.timeline_names}
    assert names == {"elapsed", "device", "keyframe"}
    imu = make_session().imu
    raw = found.index("/imu/gyro", "Scalars:scalars", "device")
    np.testing.assert_array_equal(raw, imu.t_ns)


def test_gps_time_is_shown_as_utc():
    # GPS week 2295, second 0 began 2023-12-31 00:00:00 GPS = 2023-12-30 23:59:42 UTC: 18 leap seconds since 2017.
    shown = utc_from_gps(np.array([2295 * 604_800 * NS, 0]))
    assert str(shown[:1].astype("datetime64[ns]")[0]).startswith("2023-12-30T23:59:42.000")
    assert shown[1] == np.datetime64("1980-01-06", "ns").astype(np.int64)
    # the last second of 2016 was a leap second: 17 s before it, 18 s after it
    epoch = np.datetime64("1980-01-06", "ns")
    gps = np.array(["2017-01-01T00:00:16", "2017-01-01T00:00:18"], "datetime64[ns]") - epoch
    utc = utc_from_gps(gps.astype(np.int64)).astype("datetime64[ns]").astype("datetime64[s]")
    assert [str(t) for t in utc] == ["2016-12-31T23:59:59", "2017-01-01T00:00:00"]
    assert not recorder.RecordingClock(46_534 * NS, "gps").is_date  # seconds of a day


def test_same_data_give_the_same_recording_and_other_data_another(tmp_path):
    first, second = tmp_path / "a.rrd", tmp_path / "b.rrd"
    one, two = write(first), write(second)
    assert one.identity == two.identity and one.application == "smartnav_graph"
    components = {name for chunk in one.chunks for name in chunk.to_record_batch().schema.names}
    assert not components & {"log_time", "log_tick", "RecordingInfo:start_time"}  # no wall clock
    binary = str(viewer.executable())
    verified = subprocess.run([binary, "rrd", "verify", str(first)], capture_output=True, text=True)
    assert verified.returncode == 0, verified.stderr
    compared = subprocess.run([binary, "rrd", "compare", str(first), str(second)], capture_output=True, text=True)
    assert compared.returncode == 0, compared.stderr
    bias = make_solution().accel_bias.copy()
    bias[0, 0] += 1e-12
    assert write(second, solution=make_solution(accel_bias=bias)).identity != one.identity
    assert write(second, report_markdown="# Other").identity != one.identity
    assert write(second, summary=SUMMARY | {"timings_s": {"total": 3.0}}).identity == one.identity


def test_nothing_is_left_behind_and_the_old_file_stands_when_the_disk_is_full(tmp_path):
    pytest.importorskip("resource")
    target = tmp_path / "run.rrd"
    target.write_text("old")
    program = (
        "import resource, signal, sys; sys.path.insert(0, 'tests');"
        "from recordings import write; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000));"
        f"write({str(target)!r})"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "run.rrd: could not be written" in done.stderr and "SessionError" in done.stderr
    assert target.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["run.rrd"]


def test_existing_file_is_kept_without_force(tmp_path):
    (tmp_path / "run.rrd").write_text("old")
    with pytest.raises(SessionError, match=r"run\.rrd: exists already"):
        write_recording(tmp_path / "run.rrd", session=make_session(), solution=None, force=False)


def test_only_a_recording_loads_rerun():
    code = "import sys, smartnav_graph.cli.runs, smartnav_graph.output.run_folder; print('rerun' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-1.0, 2.0, (-1.09, 2.09)),  # -1 to 2
        (0.0, 0.07, (-0.0021, 0.1021)),  # 0 and 0.1 instead of 0 alone
        (-0.061, 0.04, (-0.10303, 0.04303)),
        (-0.45, 0.15, (-0.468, 0.168)),  # -0.4 to 0.1
        (0.31, 0.39, (0.2976, 0.4024)),  # 0.3 and 0.4
        (-0.31, 0.29, (-0.328, 0.308)),  # six numbers
        (-0.35, 0.33, (-0.3704, 0.3504)),  # -1 or 1 would be too far
    ],
)
def test_a_small_plot_has_two_numbers_at_its_axis(low, high, expected):
    assert recorder.readable(low, high) == pytest.approx(expected)


def test_what_is_unknown_does_not_make_equal_recordings_differ(tmp_path):
    """NaN is never equal to NaN: rows of unknown values are left out, residuals of fewer axes stand by themselves."""
    whitened = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    ragged = Residuals(
        t_ns=stamps([1.0, 1.0, 1.0, 2.0, 2.0]),
        sensor=np.array(["pose"] * 5, dtype=object),
        axis=np.array([0, 1, 2, 0, 1]),
        whitened=whitened,
        weight=np.ones(5),
        used=np.ones(5, dtype=bool),
    )
    rotation = EVALUATION.rotation_error_deg.copy()
    rotation[:5] = np.nan
    followed = np.column_stack([np.linspace(0.0, 0.06, N), np.full(N, np.nan)])
    followed[:3] = np.nan
    changes = {
        "solution": make_solution(residuals=ragged),
        "evaluation": SimpleNamespace(**(vars(EVALUATION) | {"rotation_error_deg": rotation})),
        "summary": {"states": {"gnss_time_offset_s": {"value": 0.06, "sigma": 0.01, "held": False}}},
        "diagnostics": replayed(states={"gnss_time_offset_s": followed}),
        "causal": make_solution(),
    }
    found = write(tmp_path / "a.rrd", **changes)
    write(tmp_path / "b.rrd", **changes)
    command = [str(viewer.executable()), "rrd", "compare", str(tmp_path / "a.rrd"), str(tmp_path / "b.rrd")]
    compared = subprocess.run(command, capture_output=True, text=True)
    assert compared.returncode == 0, compared.stderr[:2000]
    by_axis = [found.values(f"/residuals/pose/{k}", "Scalars:scalars")[:, 0].tolist() for k in range(3)]
    assert by_axis == [[1.0, 4.0], [2.0, 5.0], [3.0]]
    assert len(found.values("/error/rotation", "Scalars:scalars")) == N - 5
    np.testing.assert_array_equal(found.values("/clock/gnss", "Measurements:values")[:, 0], followed[3:, 0])
    np.testing.assert_array_equal(found.values("/clock/gnss", "Measurements:variances"), np.zeros((N - 3, 1)))

"""calibration.toml is merged piece by piece; the report and `show` have what is in it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph import calibrate
from smartnav_graph.calibrate.result import CalibrationResult, Chart, Series
from smartnav_graph.cli import main
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.output.report.calibration import write_calibration_report
from smartnav_graph.session.calibration.model import Calibration, ImuErrors, calibration_toml, load_calibration
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.session.folder import save
from smartnav_graph.session.streams import Imu, Temperature

BIAS = (0.1, 0.0, -0.2)


@dataclass(frozen=True)
class PlainOptions:
    """Nothing."""


def fit(sources, options):
    values = {"accel_bias_x": Value(0.1, 0.01, "m/s^2"), "gravity": Value(9.81, math.nan, "m/s^2")}
    return CalibrationResult(
        values,
        {"accel": Residual(0.01, 12, "m/s^2")},
        {"gyro_scale": "no turns; record turns of 90 deg between rests"},
        change=lambda known: replace(known, imu_errors=replace(known.imu_errors, accel_bias=BIAS)),
        charts=(Chart("Line", "t [s]", "y", (Series("a", np.arange(3.0), np.arange(3.0)),)),),
    )


@pytest.fixture
def plain(monkeypatch):
    monkeypatch.setitem(
        calibrate.KINDS, "plain", calibrate.CalibrationKind("x", "PlainOptions", "nothing", "smartnav calibrate")
    )
    monkeypatch.setattr(calibrate.CalibrationKind, "fit", lambda self: fit)
    monkeypatch.setattr(calibrate.CalibrationKind, "options_class", lambda self: PlainOptions)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    path = tmp_path_factory.mktemp("calibrate") / "walk"
    save(sn.simulate("walk-60s", 1), path)
    return path


@pytest.mark.usefixtures("plain")
def test_a_piece_is_added_and_others_stay(walk, tmp_path, capsys):
    out, other = tmp_path / "calibration.toml", Calibration(device="phone", imu_errors=ImuErrors(gyro_bias=BIAS))
    out.write_text(calibration_toml(other))
    assert main(["calibrate", "plain", str(walk), "--out", str(out), "--report", str(tmp_path / "r.html")]) == 0
    found = load_calibration(out)
    assert found.device == "phone" and found.imu_errors == ImuErrors(gyro_bias=BIAS, accel_bias=BIAS)
    assert found.pieces["plain"].values["accel_bias_x"] == Value(0.1, 0.01, "m/s^2")
    assert found.pieces["plain"].sources == ("walk",)
    assert "accel_bias_x" in (tmp_path / "r.html").read_text()
    assert main(["calibrate", "plain", str(walk), "--out", str(out)]) == 1
    assert "already" in capsys.readouterr().err
    assert main(["calibrate", "show", str(out)]) == 0
    assert "refused: gyro_scale: no turns" in capsys.readouterr().out
    assert main(["calibrate", "compare", str(out), str(out)]) == 0
    assert "+0.0 sigma" in capsys.readouterr().out


def test_a_wrong_kind_is_named(capsys):
    assert main(["calibrate", "stati"]) == 1
    assert "is no kind of calibration" in capsys.readouterr().err


def test_another_schema_is_refused(tmp_path):
    path = tmp_path / "calibration.toml"
    path.write_text("schema = 3\n")
    with pytest.raises(CalibrationError, match="schema = 3; expected 1 or 2"):
        load_calibration(path)


def test_the_report_is_self_contained(tmp_path):
    result = fit([], None)
    write_calibration_report(tmp_path / "r.html", "plain", result.piece("2026-01-01", ["a"]), result.charts)
    text = (tmp_path / "r.html").read_text()
    assert "http:" not in text and "https:" not in text and "<script" not in text
    assert 'data-value-name="accel_bias_x" data-value="0.1" data-sigma="0.01"' in text
    assert 'data-value-name="gravity" data-value="9.81">' in text
    assert "gyro_scale: not determined" in text


def test_a_bias_follows_temperature_within_the_range_only():
    t = np.arange(4) * 10**9
    still = Imu(t_ns=t, gyro=np.zeros((4, 3)), accel=np.zeros((4, 3)))
    errors = ImuErrors(
        gyro_temperature=(0.1, 0.01, 0.0, 0.0, 0.0, 0.0), temperature_c=30.0, temperature_range_c=(20.0, 40.0)
    )
    at_c = Temperature(t_ns=t, temperature_c=np.array([30.0, 35.0, 40.0, 60.0]))
    assert np.allclose(errors.corrected(still, at_c).gyro[:, 0], [0.0, -0.75, -2.0, -2.0])
    assert np.allclose(errors.corrected(still, at_c).gyro[:, 1:], 0.0)
    assert np.allclose(errors.corrected(still).gyro, 0.0)


def test_apply_keeps_or_takes_out(walk, tmp_path):
    file = tmp_path / "calibration.toml"
    file.write_text(calibration_toml(Calibration(imu_errors=ImuErrors(accel_bias=BIAS))))
    before = sn.load(walk)
    for options, shift, left in (([], 0.0, BIAS), (["--correct"], -np.array(BIAS), (0.0, 0.0, 0.0))):
        out = Path(tmp_path / f"out{len(options)}")
        assert main(["calibrate", "apply", str(file), str(walk), "--out", str(out), *options]) == 0
        after = sn.load(out)
        assert np.allclose(after.imu.accel - before.imu.accel, shift)
        assert after.calibration.imu_errors.accel_bias == left

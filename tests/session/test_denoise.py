"""Wavelet approximation of the inertial data: slow motion stays, fast changes go, nothing is done in silence."""

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.cli import main
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.session.denoise import Denoising, denoised
from smartnav_graph.session.folder import save
from smartnav_graph.session.streams import Imu

pytest.importorskip("pywt")
T = np.arange(6000) / 100.0


def moved(hertz, t=T):
    wave = np.sin(2 * np.pi * hertz * t)[:, None] * np.ones(3)
    return sn.Session(imu=Imu(t_ns=np.round(t * 1e9).astype(np.int64), gyro=wave, accel=wave + 9.8))


@pytest.mark.parametrize(("hertz", "low", "high"), [(0.05, 0.98, 1.02), (5.0, 0.0, 0.02)])
def test_the_cut_is_at_rate_over_256(hertz, low, high):
    """.39 Hz at 100 Hz: .05 Hz keeps its amplitude, 5 Hz loses it; a constant stays."""
    imu = denoised(moved(hertz), Denoising()).imu
    inside = slice(1000, 5000)
    assert low <= imu.gyro[inside].std() / np.sqrt(0.5) <= high
    assert imu.accel[inside].mean() == pytest.approx(9.8, abs=0.02)


def test_a_gap_is_no_signal():
    """Each side is smoothed by itself: a jump at the gap stays a jump."""
    t = np.concatenate([T, T + 90.0])
    session = moved(0.0, t)
    gyro = np.where(t[:, None] < 80.0, 0.0, 1.0) * np.ones(3)
    found = denoised(session.replace(imu=replace(session.imu, gyro=gyro)), Denoising())
    assert np.allclose(found.imu.gyro, gyro, atol=1e-9)
    ((reason, count),) = found.dropped["imu"].items()
    assert count == len(t) and "motion faster than 0.39 Hz is removed, too" in reason


def test_wrong_options_are_named():
    with pytest.raises(ConfigError, match="'db4:x'; expected wavelet:level"):
        Denoising.parse("db4:x")
    with pytest.raises(ConfigError, match="wavelet 'daub'; expected a discrete wavelet"):
        Denoising.parse("daub:3")
    assert Denoising.parse("sym5") == Denoising("sym5", 7)
    with pytest.raises(SessionError, match=r"800 inertial samples .*expected at least 896 .*lower the level"):
        denoised(moved(0.1, T[:800]), Denoising())


def test_option_of_import(tmp_path, capsys):
    save(moved(5.0), tmp_path / "log")
    out = tmp_path / "out"
    assert main(["import", str(tmp_path / "log"), "--denoise", "db4:7", "--out", str(out)]) == 0
    assert "repaired: imu: 6000 smoothed by db4 at level 7" in capsys.readouterr().out
    assert sn.load(out).imu.gyro[1000:5000].std() < 0.02

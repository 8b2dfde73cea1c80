"""Faulty sessions: the faults are as many and as large as asked, and loading repairs the declared ones."""

from __future__ import annotations

import numpy as np
import pytest

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.files import read_table
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import GnssFix
from smartnav_graph.simulation.degrade import Degrade, degrade, parse_outliers, parse_pair, spoil_rows, write_degraded
from smartnav_graph.simulation.scenarios import simulate

N = 6000


@pytest.fixture(scope="module")
def walk():
    return simulate("walk-60s", 1)


@pytest.fixture(scope="module")
def drive():
    """Ten minutes of fixes without noise, as a survey receiver gives them, in local metres without origin."""
    s = simulate("car-10min", 1)
    fix = GnssFix(t_ns=s.gnss.t_ns, enu=np.zeros((600, 3)))
    return Session(imu=s.imu, gnss=fix)


def test_white_noise_is_added_and_reported_in_the_sigma(drive):
    noisy = degrade(drive, Degrade(gnss_white=3.0), 0)
    np.testing.assert_allclose(noisy.gnss.enu.std(axis=0), [3, 3, 4.5], rtol=4 / np.sqrt(1200))
    np.testing.assert_array_equal(noisy.gnss.sigma, np.tile([3.0, 3.0, 4.5], (600, 1)))
    again = degrade(noisy, Degrade(gnss_white=4.0), 1)
    np.testing.assert_allclose(again.gnss.sigma[0], [5.0, 5.0, 7.5])
    assert again.gnss.enu.std(axis=0)[0] == pytest.approx(5.0, rel=0.15)


def test_correlated_noise_is_added_and_not_reported(drive):
    noisy = degrade(drive, Degrade(gnss_white=3.0, gnss_gm=(4.0, 60.0)), 0)
    part = noisy.gnss.enu - degrade(drive, Degrade(gnss_white=3.0), 0).gnss.enu
    neighbours = (part[1:] * part[:-1]).sum() / (part**2).sum()
    assert neighbours == pytest.approx(np.exp(-1 / 60), abs=0.02)
    np.testing.assert_array_equal(noisy.gnss.sigma[0], [3.0, 3.0, 4.5])


def test_geodetic_fixes_stay_geodetic_and_other_streams_untouched(walk):
    noisy = degrade(walk, Degrade(gnss_white=3.0), 0)
    assert noisy.gnss.enu is None
    moved = noisy.nav_position(noisy.gnss) - walk.nav_position(walk.gnss)
    np.testing.assert_allclose(moved.std(axis=0), [3, 3, 4.5], rtol=4 / np.sqrt(120))
    assert noisy.reference is walk.reference and noisy.imu is walk.imu


def test_clean_fixes_become_the_reference_of_a_session_without_one(drive):
    noisy = degrade(drive, Degrade(gnss_white=3.0), 0)
    np.testing.assert_array_equal(noisy.reference.t_ns, drive.gnss.t_ns)
    np.testing.assert_array_equal(noisy.reference.enu, drive.gnss.enu)


@pytest.mark.parametrize("kind", ["isolated", "burst"])
def test_five_percent_of_the_fixes_are_outliers_and_marked(drive, kind):
    noisy = degrade(drive, Degrade(outliers=parse_outliers(f"{kind}:0.05:50-200")), 2)
    size = np.linalg.norm(noisy.gnss.enu, axis=1)
    np.testing.assert_array_equal(noisy.gnss.extra["is_outlier"], (size > 0).astype(int))
    assert (size > 0).sum() == 30 and size[size > 0].min() >= 50 and size.max() <= 200
    assert noisy.gnss.sigma is None


def test_dropped_rows_are_those_of_the_gaps(walk):
    gapped = degrade(walk, Degrade(drop_imu=((10.0, 5.0), (30.0, 0.5))), 0)
    t = walk.seconds(walk.imu.t_ns)
    kept = ~((t >= 10) & (t < 15)) & ~((t >= 30) & (t < 30.5))
    np.testing.assert_array_equal(gapped.imu.t_ns, walk.imu.t_ns[kept])
    assert N - len(gapped.imu) == 550


def test_adding_a_fault_leaves_the_others_as_they_were(drive):
    one = degrade(drive, Degrade(outliers=parse_outliers("burst:0.05:50-200")), 4)
    two = degrade(drive, Degrade(outliers=parse_outliers("burst:0.05:50-200"), gnss_white=3.0), 4)
    np.testing.assert_array_equal(one.gnss.extra["is_outlier"], two.gnss.extra["is_outlier"])


def test_row_faults_are_repaired_on_loading_with_exact_counts(walk, tmp_path):
    options = Degrade(duplicates=0.01, swaps=0.005, nan_rows=0.001)
    write_degraded(walk, options, 0, tmp_path / "bad")
    raw = read_table(tmp_path / "bad" / "imu.parquet")
    assert len(raw["t_ns"]) == N + 60 and sum(np.isnan(raw[c]).sum() for c in raw if c != "t_ns") == 6
    back = session_folder.load(tmp_path / "bad")
    assert back.repairs == ("nan", "order")
    assert back.dropped == {
        "imu": {"non-finite rows dropped": 6, "disordered rows sorted": 30, "repeated stamps dropped": 60}
    }
    left = np.isin(walk.imu.t_ns, back.imu.t_ns)
    assert len(back.imu) == left.sum() == N - 6
    np.testing.assert_array_equal(back.imu.gyro, walk.imu.gyro[left])


def test_undeclared_row_faults_are_refused_by_name(walk, tmp_path):
    for options, found in (
        (Degrade(nan_rows=0.001), "is nan at row"),
        (Degrade(swaps=0.001), "t_ns not strictly increasing at row"),
        (Degrade(duplicates=0.001), "step 0 ns; 6 such rows"),
    ):
        with pytest.raises(SessionError, match=found):
            session_folder.build_stream(type(walk.imu), spoil_rows(walk.imu.columns(), options, 0), "imu.parquet")


def errors_ms(back, true):
    """Rebuilt minus true stamp of every row; rows are known by their readings."""
    stamp = {tuple(row): t for row, t in zip(true.gyro, true.t_ns, strict=True)}
    return np.array([t - stamp[tuple(row)] for row, t in zip(back.gyro, back.t_ns, strict=True)]) / 1e6


@pytest.mark.parametrize(
    "others",
    [{}, {"duplicates": 0.01, "nan_rows": 0.001}, {"drop_imu": ((20.0, 5.0),)}, {"swaps": 0.005}],
    ids=["alone", "duplicates", "gap", "swaps"],
)
def test_jittered_stamps_are_rebuilt(walk, tmp_path, others):
    options = Degrade(jitter_ms=30.0, **others)
    valid = write_degraded(walk, options, 0, tmp_path / "bad")
    raw = read_table(tmp_path / "bad" / "imu.parquet")
    if not others:
        assert (raw["t_ns"] - walk.imu.t_ns).std() / 1e6 == pytest.approx(30.0, rel=0.05)
    back = session_folder.load(tmp_path / "bad")
    error = errors_ms(back.imu, walk.imu)
    assert np.sqrt((error**2).mean()) < 5.0  # ms
    rows = len(valid.imu) - round(options.nan_rows * N)
    assert len(back.imu) == rows and back.dropped["imu"]["stamps rebuilt"] == rows
    assert back.dropped["imu"].get("repeated stamps dropped", 0) == round(options.duplicates * N)
    if options.drop_imu:
        step = np.diff(back.imu.t_ns)
        assert step.max() / 1e9 == pytest.approx(5.0, abs=0.1) and np.sort(step)[-2] / 1e6 < 20


def test_stamps_of_other_streams_are_not_rebuilt(walk, tmp_path):
    write_degraded(walk, Degrade(jitter_ms=30.0), 0, tmp_path / "bad")
    back = session_folder.load(tmp_path / "bad")
    for name in ("gnss", "static", "reference", "magnetometer"):
        np.testing.assert_array_equal(getattr(back, name).t_ns, getattr(walk, name).t_ns)
    assert set(back.dropped) == {"imu"}


def test_no_faults_change_nothing(walk, tmp_path):
    write_degraded(walk, Degrade(), 0, tmp_path / "same")
    back = session_folder.load(tmp_path / "same")
    assert back.repairs == () and not back.dropped
    np.testing.assert_array_equal(back.imu.accel, walk.imu.accel)


def test_the_same_seed_gives_the_same_faults(walk):
    table, options = walk.imu.columns(), Degrade(duplicates=0.01, swaps=0.005, nan_rows=0.001, jitter_ms=30)
    one, two, other = (spoil_rows(table, options, seed) for seed in (1, 1, 2))
    for name in table:
        np.testing.assert_array_equal(one[name], two[name])
    assert not np.array_equal(one["t_ns"], other["t_ns"])
    assert np.isfinite(table["gyro_x_rad_s"]).all()


def test_an_existing_folder_stays_unless_forced(walk, tmp_path):
    write_degraded(walk, Degrade(), 0, tmp_path / "s")
    with pytest.raises(SessionError, match="exists already"):
        write_degraded(walk, Degrade(swaps=0.01), 0, tmp_path / "s")
    assert session_folder.load(tmp_path / "s").repairs == ()
    write_degraded(walk, Degrade(swaps=0.01), 0, tmp_path / "s", force=True)
    assert session_folder.load(tmp_path / "s").dropped["imu"] == {"disordered rows sorted": 60}
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_options_are_read_from_text():
    assert parse_pair("4,60", "--gnss-gm") == (4.0, 60.0)
    outliers = parse_outliers("burst:0.05:50-200")
    assert (outliers.kind, outliers.share, outliers.low_m, outliers.high_m) == ("burst", 0.05, 50.0, 200.0)


@pytest.mark.parametrize("text", ["4", "4,60,1", "a,b", ""])
def test_a_wrong_pair_names_its_option(text):
    with pytest.raises(ConfigError) as error:
        parse_pair(text, "--drop-imu")
    assert str(error.value) == f"--drop-imu: {text!r}; expected two numbers separated by a comma, such as 4,60"


@pytest.mark.parametrize("text", ["burst", "burst:0.05", "burst:x:50-200", "burst:0.05:50", "burst:0.05:1-2-3"])
def test_wrong_outliers_say_what_is_expected(text):
    with pytest.raises(ConfigError, match="expected isolated:SHARE:LOW-HIGH or burst:SHARE:LOW-HIGH"):
        parse_outliers(text)


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ({"gnss_white": 0.0}, "--gnss-white: 0.0; expected a number > 0"),
        ({"gnss_gm": (4.0, -60.0)}, "--gnss-gm: -60.0; expected a number > 0"),
        ({"drop_imu": ((-1.0, 5.0),)}, "--drop-imu: start -1.0 s; expected seconds from the session's start, >= 0"),
        ({"drop_imu": ((1.0, float("nan")),)}, "--drop-imu: nan; expected a number > 0"),
        ({"jitter_ms": -1.0}, "--jitter-ms: -1.0 ms; expected a number >= 0"),
        ({"nan_rows": 10.0}, "--nan-rows: share 10.0; expected 0 to 0.25"),
    ],
)
def test_impossible_faults_are_refused(values, found):
    with pytest.raises(ConfigError) as error:
        Degrade(**values)
    assert str(error.value) == found


def test_faults_of_absent_streams_are_refused(walk, drive):
    with pytest.raises(ConfigError, match="degrade: no gnss stream; expected a session with fixes"):
        degrade(walk.replace(gnss=None), Degrade(gnss_white=3.0), 0)
    with pytest.raises(SessionError, match="no imu stream"):
        degrade(walk.replace(imu=None), Degrade(drop_imu=((1.0, 1.0),)), 0)
    with pytest.raises(ConfigError, match=r"--drop-imu: 100.0,5.0 hits no row; expected a gap within 0 .. 59.990 s"):
        degrade(walk, Degrade(drop_imu=((100.0, 5.0),)), 0)

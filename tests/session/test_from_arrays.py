"""Sessions of arrays and DataFrames: times of any type, names, units; what is refused says what to build."""

import datetime

import numpy as np
import pandas as pd
import pytest

import smartnav_graph as sn
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.session.from_arrays import times_ns

N = 200
T_NS = 1_748_772_000_000_000_000 + np.arange(N) * 10_000_000  # 2025-06-01 10:00 UTC, 100 Hz
GYRO = np.tile([0.01, -0.02, 0.03], (N, 1))
ACCEL = np.tile([0.0, 0.0, STANDARD_GRAVITY], (N, 1))
COLUMNS = [*(f"gyro_{a}_rad_s" for a in "xyz"), *(f"accel_{a}_m_s2" for a in "xyz")]


def session(time, **more):
    return sn.Session.from_arrays(imu={"time": time, "gyro": GYRO, "accel": ACCEL}, **more)


def frame(**changes):
    table = pd.DataFrame(np.hstack([GYRO, ACCEL]), columns=COLUMNS)
    return table.assign(time=pd.to_datetime(T_NS, utc=True)).assign(**changes)


def as_python(zone):
    return [datetime.datetime.fromtimestamp(t / 1e9, datetime.UTC).astimezone(zone) for t in T_NS]


@pytest.mark.parametrize(
    "time",
    [
        T_NS.astype("datetime64[ns]"),
        T_NS.astype("datetime64[ns]").astype("datetime64[us]"),
        T_NS.astype("datetime64[ns]").astype("datetime64[ms]"),
        pd.to_datetime(T_NS),
        pd.Series(pd.to_datetime(T_NS, utc=True).tz_convert("Europe/Berlin")),
        pd.to_datetime(T_NS, utc=True).tz_convert("Asia/Kolkata"),
        as_python(datetime.timezone(datetime.timedelta(hours=-8))),
        [t.replace(tzinfo=None) for t in as_python(datetime.UTC)],
    ],
    ids=["ns", "us", "ms", "pandas", "Berlin", "Kolkata", "datetime", "naive"],
)
def test_a_datetime_of_any_unit_and_zone_is_the_same_instant(time):
    found = session(time)
    np.testing.assert_array_equal(found.imu.t_ns, T_NS)
    assert found.clock_epoch == "unix" and "2025-06-01T10:00" in repr(found)


@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin"])
def test_single_nanoseconds_are_kept(zone):
    stamps = pd.Series(pd.to_datetime(T_NS + 123, utc=True).tz_convert(zone))
    for time in (list(stamps), stamps.astype(object), arrow := stamps.convert_dtypes(dtype_backend="pyarrow")):
        np.testing.assert_array_equal(times_ns(time, "imu")[0], T_NS + 123)
    for empty in (stamps[:0], arrow[:0]):
        assert times_ns(empty, "imu")[0].shape == (0,)


NOON = datetime.datetime(2025, 6, 1, 12)


@pytest.mark.parametrize(
    ("time", "text"),
    [
        ([NOON, None], r"no time \(NaT\) at row 1"),
        ([pd.NaT, pd.Timestamp(NOON)], r"no time \(NaT\) at row 0"),
        ([NOON, NOON.replace(tzinfo=datetime.UTC)], "some with, some without time zone"),
        ([NOON.replace(year=4000)] * 2, "do not fit int64 nanoseconds"),
        (NOON, r"one time alone; expected \(n,\)"),
        (5, "one time alone"),
        (np.array([[5]]), r"of shape \(1, 1\)"),
        (np.array([2**63 + 5], dtype=np.uint64), "do not fit int64 nanoseconds"),
        ([NOON, "noon"], "of type object"),
    ],
)
def test_times_that_are_none_are_refused_by_name(time, text):
    with pytest.raises(sn.SmartnavError, match=text):
        times_ns(time, "imu")


def test_timedeltas_and_whole_nanoseconds_are_a_clock_without_date():
    spans = (T_NS - T_NS[0]).astype("timedelta64[ns]").astype("timedelta64[ms]")
    assert session(spans).clock_epoch == "unknown" and session(spans).imu.t_ns[1] == 10_000_000
    assert session(T_NS).clock_epoch == "unknown" and session(T_NS, clock_epoch="gps").clock_epoch == "gps"


def test_seconds_as_floating_numbers_are_refused_with_the_remedy():
    for make in (session, lambda t: sn.Imu(t_ns=t, gyro=GYRO, accel=ACCEL)):
        with pytest.raises(TypeError, match=r"floating numbers; expected (int64|datetime64)"):
            make(np.arange(N) * 0.01)
        with pytest.raises(sn.SmartnavError, match=r"np\.round\(.* \* 1e9\)\.astype\('int64'\)"):
            make(np.arange(N) * 1.0)  # whole seconds are floating numbers, too


@pytest.mark.parametrize(
    ("time", "text"),
    [
        (T_NS // 1_000_000, "whole numbers 10 apart; expected nanoseconds; multiply milliseconds by 1_000_000"),
        (T_NS.astype(str), r"of type .*; expected datetime64 .*pandas\.to_datetime"),
        (np.array(["NaT", *["2025-06-01"] * (N - 1)], dtype="datetime64[s]"), r"no time \(NaT\) at row 0"),
        (np.array(["4000-01-01"] * N, dtype="datetime64[s]"), "do not fit int64 nanoseconds; expected 1678 to 2262"),
        (T_NS[:-1], r"imu.gyro: shape \(200, 3\); expected \(199, 3\), one row per time"),
    ],
)
def test_other_times_are_refused(time, text):
    with pytest.raises(sn.SmartnavError, match=text):
        session(time)


def test_a_stream_itself_takes_no_datetimes_whose_unit_would_be_lost():
    with pytest.raises(TypeError, match=r"Imu\.t_ns: holds datetimes; expected int64; .*from_arrays"):
        sn.Imu(t_ns=T_NS.astype("datetime64[ns]").astype("datetime64[ms]"), gyro=GYRO, accel=ACCEL)


def test_a_frame_gives_what_arrays_give():
    whole = session(T_NS.astype("datetime64[ns]")).imu
    for table in (frame(), frame().set_index("time"), frame().rename(columns={"time": "timestamp"})):
        np.testing.assert_array_equal(sn.Session.from_pandas(imu=table).imu.gyro, whole.gyro)
    missing = frame(gyro_x_rad_s=pd.array([None, *GYRO[1:, 0]], dtype="Float64"))
    with pytest.raises(sn.SmartnavError, match="gyro_x_rad_s is nan at row 0"):
        sn.Session.from_pandas(imu=missing)
    assert len(sn.Session.from_pandas(imu=missing, repairs=["nan"]).imu) == N - 1


def test_the_first_fix_is_the_origin():
    fixes = {"time": T_NS[::100], "lla": [[48.1, 11.5, np.nan], [48.1001, 11.5, 520.0]], "sigma": np.full((2, 3), 3.0)}
    found = session(T_NS, gnss=fixes)
    assert found.origin == sn.Origin(48.1, 11.5, 520.0)
    assert found.nav_position(found.gnss)[1, 1] == pytest.approx(11.1, abs=0.1)  # m a ten-thousandth of a degree


def test_names_that_are_missing_or_unknown(warned):
    with pytest.raises(sn.SmartnavError, match=r"accel_x_m_s2.* missing; .*is accel_x_g meant for accel_x_m_s2"):
        sn.Session.from_pandas(imu=frame().rename(columns={"accel_x_m_s2": "accel_x_g"}))
    with pytest.raises(sn.SmartnavError, match=r"gyro_x_rad_s.* missing; .*; rename wx, wy"):
        sn.Session.from_arrays(imu={"time": T_NS, "wx": GYRO[:, 0], "wy": GYRO[:, 1]})
    with pytest.raises(sn.SmartnavError, match=r"height_m missing; .*NaN where the height is not known"):
        session(T_NS, gnss={"time": T_NS[:1], "lat_deg": [48.0], "lon_deg": [11.0]})
    sn.Session.from_pandas(imu=frame(lux=1.0))
    assert warned() == "imu: unknown column lux; kept, but not used"
    with pytest.raises(TypeError, match="no stream 'gps'; expected some of imu, gnss"):
        sn.Session.from_pandas(imu=frame(), gps=frame())
    with pytest.raises(sn.SmartnavError, match=r"no times: columns .*; expected a column t_ns or time"):
        sn.Session.from_pandas(imu=frame().drop(columns="time"))


def test_a_column_that_is_there_twice_is_named():
    for name in ("time", COLUMNS[0]):
        with pytest.raises(sn.SmartnavError, match=f"imu: several columns {name}; expected one of each name"):
            sn.Session.from_pandas(imu=pd.concat([frame(), frame()[[name]]], axis=1))


def test_repairs_of_an_iterator_serve_every_stream():
    fixes = {"time": T_NS[:3], "enu": [[np.nan] * 3, [0.0] * 3, [1.0] * 3], "sigma": np.full((3, 3), 3.0)}
    assert len(session(T_NS, gnss=fixes, repairs=iter(["nan"])).gnss) == 2


def test_what_is_no_stream_says_what_to_build():
    with pytest.raises(TypeError, match=r"imu: is ndarray; .*build imu=\{'time': datetimes, 'gyro': \.\.\., 'accel'"):
        sn.Session.from_arrays(imu=ACCEL)
    with pytest.raises(TypeError, match="imu: is dict; expected a pandas DataFrame; arrays go to Session"):
        sn.Session.from_pandas(imu={"time": T_NS})
    with pytest.raises(TypeError, match="imu: is GnssFix; expected Imu"):
        sn.Session.from_arrays(imu=sn.GnssFix(t_ns=[1], enu=[[0.0, 0.0, 0.0]]))
    with pytest.raises(TypeError, match=r"session: is DataFrame; expected a Session; .*from_pandas"):
        sn.smooth(frame())
    with pytest.raises(TypeError, match="no streams"):
        sn.Session.from_pandas()


def test_units_are_checked_and_converted_on_request(kitti):
    imu = kitti.imu.take(slice(0, 3000))
    told = {"time": imu.t_ns, "gyro": np.degrees(imu.gyro), "accel": imu.accel}
    for wrong in (told, {"time": imu.t_ns, "gyro": imu.gyro, "accel": imu.accel / STANDARD_GRAVITY}):
        with pytest.raises(sn.SmartnavError, match=r"imu: .*units"):
            sn.Session.from_arrays(imu=wrong, device=kitti.device)
        found = sn.Session.from_arrays(imu=wrong, device=kitti.device, repairs=["units"])
        np.testing.assert_allclose(found.imu.gyro, imu.gyro, rtol=1e-3)
        np.testing.assert_allclose(found.imu.accel, imu.accel, rtol=1e-3)


def test_one_clock_for_all_streams():
    with pytest.raises(sn.SmartnavError, match="imu: datetimes, gnss: other times; expected one clock"):
        session(T_NS.astype("datetime64[ns]"), gnss={"t_ns": [0, 10**9], "enu": np.zeros((2, 3))})
    with pytest.raises(sn.SmartnavError, match="'gps', but the times are datetimes"):
        session(T_NS.astype("datetime64[ns]"), clock_epoch="gps")

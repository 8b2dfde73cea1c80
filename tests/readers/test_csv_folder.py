"""CSV folders with the session's own columns: round trip, optional cells, faults by file, row and value."""

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest
import tomli_w

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import Origin
from smartnav_graph.session.folder import save
from smartnav_graph.session.session import Device, Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import STREAMS, ControlPoint, GnssFix, Imu, Reference

T = np.array([1403715273262142976, 1403715273267142912, 1403715273272142976])


def rows_of(kind: type[Stream]) -> Stream:
    """Three rows of a stream with every column filled with awkward numbers."""
    rng = np.random.default_rng(7)
    table = {}
    for spec in kind.specs():
        if spec.name == "enu" and "lla" in kind.__dataclass_fields__:
            continue
        for i, name in enumerate(spec.metadata["columns"]):
            match spec.metadata["kind"]:
                case "int":
                    table[name] = T + i
                case "text":
                    table[name] = np.array(["a", "b c", 'with "quotes", and comma'], dtype=object)
                case _:
                    table[name] = rng.uniform(0.1, 1.0, 3) / 3.0
    return kind.from_columns(table | {"remark": np.array([1.5, np.nan, 2.5])})


def write_csv(stream: Stream, folder) -> None:
    table = pa.table({name: pa.array(column, from_pandas=True) for name, column in stream.columns().items()})
    pyarrow.csv.write_csv(table, folder / f"{stream.NAME}.csv")


def test_every_stream_survives_the_way_through_csv_exactly(tmp_path):
    original = Session(
        device=Device(name="test", forward="+x", up="-z", vehicle="car"),
        clock_epoch="gps",
        origin=Origin(47.0, 15.0, 400.0),
        **{name: rows_of(kind) for name, kind in STREAMS.items()},
    )
    for stream in original.streams().values():
        write_csv(stream, tmp_path)
    save(original, tmp_path / "saved")
    (tmp_path / "session.toml").write_text((tmp_path / "saved" / "session.toml").read_text())

    assert readers.find(tmp_path).name == "csv"
    (tmp_path / "saved" / "notes.csv").write_text("another table\n")  # beside a session: not looked at
    again, saved = readers.read(tmp_path), readers.load(tmp_path / "saved")
    assert (again.device, again.origin, again.clock_epoch) == (original.device, original.origin, "gps")
    for other in (again, saved):
        assert set(other.streams()) == set(STREAMS)
        for name, stream in original.streams().items():
            for column, values in stream.columns().items():
                np.testing.assert_array_equal(other.streams()[name].columns()[column], values, err_msg=column)


IMU = "t_ns,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2"
IMU_ROWS = f"{IMU}\n10,0,0,0,0,0,9.81\n20,0,0,0,0,0,9.81\n"
GNSS = "t_ns,e_m,n_m,u_m,sigma_e_m,sigma_n_m,sigma_u_m,arrival_ns"


def test_without_session_toml_the_defaults_hold(tmp_path):
    (tmp_path / "imu.csv").write_text(IMU_ROWS)
    session = readers.read(tmp_path)
    assert isinstance(session.imu, Imu) and session.imu.accel[1].tolist() == [0, 0, 9.81]
    assert session.device == Device() and session.clock_epoch == "unknown" and session.origin is None


def test_empty_cells_where_they_are_allowed(tmp_path):
    (tmp_path / "gnss.csv").write_text(f"{GNSS}\n10,1,2,3,,,,\n20,1,2,3,0.5,0.5,1.5,\n")
    gnss = readers.read(tmp_path).gnss
    assert isinstance(gnss, GnssFix)
    np.testing.assert_array_equal(gnss.sigma, [[np.nan] * 3, [0.5, 0.5, 1.5]])
    assert gnss.arrival_ns is None  # a wholly empty optional column says nothing


def test_text_stays_text(tmp_path):
    (tmp_path / "control.csv").write_text("t_ns,point_id,e_m,n_m,u_m,remark\n10,007,1,2,3,wet\n20,P8,1,2,3,\n")
    control = readers.read(tmp_path).control
    assert isinstance(control, ControlPoint) and control.point_id.tolist() == ["007", "P8"]
    assert control.extra["remark"].tolist() == ["wet", ""]


def test_unknown_columns_are_kept_and_reported(tmp_path, warned):
    (tmp_path / "imu.csv").write_text(IMU_ROWS.replace("accel_z_m_s2", "accel_z_m_s2,lux").replace("9.81", "9.81,3"))
    assert readers.read(tmp_path).imu.extra["lux"].tolist() == [3.0, 3.0]
    assert "imu.csv: unknown column lux; kept" in warned()


def test_repairs_are_counted(tmp_path):
    (tmp_path / "imu.csv").write_text(f"{IMU}\n20,0,0,0,0,0,1\n10,0,0,0,0,0,2\n20,0,0,0,0,0,3\n30,0,0,nan,0,0,4\n")
    session = readers.read(tmp_path, repairs=("order", "nan"))
    assert session.imu.t_ns.tolist() == [10, 20] and session.imu.accel[:, 2].tolist() == [2, 1]
    counts = {"non-finite rows dropped": 1, "disordered rows sorted": 1, "repeated stamps dropped": 1}
    assert session.dropped == {"imu": counts} and session.repairs == ()
    (tmp_path / "session.toml").write_text(tomli_w.dumps({"repair": ["order", "nan"]}))
    assert readers.read(tmp_path).dropped == {"imu": counts}  # asked for by the file


@pytest.mark.parametrize(
    ("name", "text", "parts"),
    [
        ("imu.csv", IMU_ROWS.replace("gyro_y", "gyr_y"), ("column gyro_y_rad_s is missing", "the file has t_ns")),
        ("imu.csv", IMU_ROWS.replace("t_ns", "t"), ("column t_ns is missing",)),
        ("imu.csv", IMU, ("has no rows",)),
        ("imu.csv", IMU_ROWS.replace("20,0", "20,zero"), ("gyro_x_rad_s is 'zero' at row 1; expected a number",)),
        ("imu.csv", IMU_ROWS.replace("20,0", "20.5,0"), ("t_ns is '20.5' at row 1; expected a whole number",)),
        ("imu.csv", IMU_ROWS.replace("20,0", "20,"), ("gyro_x_rad_s is nan at row 1", "--repair nan")),
        ("imu.csv", IMU_ROWS.replace("20,0", "20,inf"), ("gyro_x_rad_s is inf at row 1", "finite numbers")),
        (
            "imu.csv",
            IMU_ROWS.replace("20,", "5,"),
            ("t_ns not strictly increasing at row 1 (step -5 ns", "--repair order"),
        ),
        ("imu.csv", IMU_ROWS.replace("20,0,0,0", "20,0,0"), ("no table of 7 columns", "got 6")),
        ("gnss.csv", f"{GNSS}\n10,1,2,3,,,,\n20,1,2,3,,,,25\n", ("arrival_ns is '' at row 0",)),
        ("gnss.csv", "t_ns,e_m,n_m\n10,1,2\n", ("column u_m is missing; expected columns e_m, n_m, u_m",)),
        ("gnss.csv", "t_ns,lat_deg,lon_deg,height_m\n10,47,15,3\n", ("without origin", "[origin] in session.toml")),
        ("gnss.csv", "t_ns,hdop\n10,47\n", ("position columns missing",)),
        ("gnss.csv", f"{GNSS}\n10,1,2,3,0,1,1,\n", ("sigma is 0.0 at row 0; expected standard deviations > 0",)),
    ],
)
def test_faults_name_the_file(tmp_path, name, text, parts):
    (tmp_path / name).write_text(text)
    with pytest.raises(SessionError) as caught:
        readers.read(tmp_path)
    for part in (f"{tmp_path / name}: ", *parts):
        assert part in str(caught.value)


def test_a_csv_that_is_no_stream_is_refused_not_overlooked(tmp_path):
    (tmp_path / "imu.csv").write_text(IMU_ROWS)
    (tmp_path / "gps.csv").write_text("t,x\n1,2\n")
    with pytest.raises(SessionError, match=r"gps.csv: is no stream of a session; expected some of imu.csv, gnss.csv"):
        readers.read(tmp_path)


def test_a_wrong_session_toml_is_reported(tmp_path):
    (tmp_path / "imu.csv").write_text(IMU_ROWS)
    (tmp_path / "session.toml").write_text("[device]\nforwards = '+x'\n")
    with pytest.raises(SessionError, match=r"session.toml: .*forwards"):
        readers.read(tmp_path)


def test_a_reference_comes_along(tmp_path):
    (tmp_path / "imu.csv").write_text(IMU_ROWS)
    (tmp_path / "reference.csv").write_text("t_ns,e_m,n_m,u_m\n10,1,2,3\n")
    assert isinstance(readers.read(tmp_path).reference, Reference)


@pytest.mark.parametrize(
    ("heading", "stamps"),
    [
        ("t_s", ("1.5", "2.25")),
        ("T_MS", ("1500", "2250")),
        ("t_us", ("1500000", "2250000")),
        ("t_ns", ("1.5e9", "2.25E9")),
    ],
)
def test_stamps_in_other_units_and_capital_headings(tmp_path, heading, stamps):
    names = f"{heading},GYRO_X_RAD_S,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n"
    (tmp_path / "imu.csv").write_text(names + "".join(f"{stamp},0.1,0,0,0,0,9.81\n" for stamp in stamps) + "3")
    session = readers.read(tmp_path)
    assert session.imu.t_ns.tolist() == [1_500_000_000, 2_250_000_000] and session.imu.gyro[0, 0] == 0.1
    assert session.dropped == {"imu": {"cut at the end of the file left out": 1}}


def test_dates_as_stamps(tmp_path):
    names = "t_ns,lat_deg,lon_deg,height_m\n"
    (tmp_path / "gnss.csv").write_text(names + "2023-12-31T22:33:02.4Z,48,11,500\n2023-12-31T22:33:03.4Z,48,11,500\n")
    (tmp_path / "session.toml").write_text("[origin]\nlat_deg = 48.0\nlon_deg = 11.0\nheight_m = 500.0\n")
    assert readers.read(tmp_path).gnss.t_ns[0] == 1704061982_400_000_000

"""The session folder: exact round trip, atomic saving, and errors that name file, row, value and remedy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from filled import example
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from smartnav_graph.core.errors import ConfigError, SessionError, SmartnavError
from smartnav_graph.core.files import read_table, write_table
from smartnav_graph.core.frames import Origin
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, Calibration
from smartnav_graph.session.folder import load, save
from smartnav_graph.session.session import Device, Mount, Session
from smartnav_graph.session.stream import Positioned
from smartnav_graph.session.streams import STREAMS, GnssFix, Imu

ORIGIN = Origin(52.0, 11.0, 100.0)


def full() -> Session:
    """Everything a session can hold."""
    noise = dataclasses.replace(DEVICE_CLASSES["mems"], accel_noise_density=0.0123456789)
    return Session(
        device=Device('Galaxy "S5"', "+x", "-z", "car"),
        clock_epoch="gps",
        origin=Origin(52.123456789012345, -11.1, 99.9),
        gravity_m_s2=9.8123,
        sensors={"gnss": Mount((0.1, -0.6, 0.9), ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)), "msl")},
        calibration=Calibration(device="S5", imu_noise=noise),
        repairs=("nan", "order"),
        **{name: example(kind) for name, kind in STREAMS.items()},
    )


def assert_same_stream(one, other):
    assert type(one) is type(other)
    a, b = one.columns(), other.columns()
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype or a[name].dtype.kind == "O"
        np.testing.assert_array_equal(a[name], b[name])


@pytest.fixture
def saved(tmp_path):
    """A plain session on disk."""
    save(Session(origin=ORIGIN, imu=example(Imu), gnss=example(GnssFix, geodetic=True)), tmp_path / "s")
    return tmp_path / "s"


# --- round trip -------------------------------------------------------------------------------------------------------


def test_what_is_saved_is_what_is_loaded(tmp_path):
    one = full()
    save(one, tmp_path / "s")
    other = load(tmp_path / "s")
    for field in ("device", "clock_epoch", "origin", "gravity_m_s2", "sensors", "calibration", "repairs"):
        assert getattr(other, field) == getattr(one, field), field
    assert other.path == tmp_path / "s" and other.dropped == {}
    assert list(other.streams()) == list(STREAMS)
    for name, stream in one.streams().items():
        assert_same_stream(stream, getattr(other, name))


POSITIONED = [name for name, kind in STREAMS.items() if issubclass(kind, Positioned)]


@pytest.mark.parametrize(("name", "geodetic"), [*((n, False) for n in STREAMS), *((n, True) for n in POSITIONED)])
@pytest.mark.parametrize("optional", [False, True])
def test_every_stream_survives_alone(name, geodetic, optional, tmp_path):
    stream = dataclasses.replace(
        example(STREAMS[name], optional=optional, geodetic=geodetic),
        extra={"satellites": np.arange(6), "hdop": np.linspace(0, 1, 6)},
    )
    save(Session(origin=ORIGIN, **{name: stream}), tmp_path / "s")
    assert {p.name for p in (tmp_path / "s").iterdir()} == {f"{name}.parquet", "session.toml"}
    back = getattr(load(tmp_path / "s"), name)
    assert_same_stream(stream, back)
    assert list(back.extra) == ["satellites", "hdop"]


readings = st.floats(-1e4, 1e4)
DAY_NS = 86_400 * 10**9


@given(
    first=st.integers(-(2**61), 2**61),
    steps=st.lists(st.integers(1, 29 * DAY_NS), min_size=1, max_size=4),
    values=hnp.arrays(np.float64, (5, 6), elements=readings),
)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_bit_survives(first, steps, values, tmp_path):
    stamps, n = first + np.cumsum([0, *steps]), 1 + len(steps)
    imu = Imu(t_ns=stamps, gyro=values[:n, :3], accel=values[:n, 3:])
    save(Session(imu=imu), tmp_path / "s", force=True)
    back = load(tmp_path / "s").imu
    assert back.t_ns.tobytes() == imu.t_ns.tobytes()
    assert back.gyro.tobytes() == imu.gyro.tobytes() and back.accel.tobytes() == imu.accel.tobytes()


def test_an_empty_cell_of_a_sigma_column_is_an_unknown_sigma(saved):
    table = pq.read_table(saved / "gnss.parquet")
    for axis in "enu":
        column = pa.array([None, 1.0, 2.0, 3.0, None, 5.0])
        name = f"sigma_{axis}_m"
        table = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, saved / "gnss.parquet")
    np.testing.assert_array_equal(np.isnan(load(saved).gnss.sigma[:, 0]), [True, False, False, False, True, False])


# --- saving -----------------------------------------------------------------------------------------------------------


def test_saving_refuses_to_overwrite(saved):
    before = {p.name: p.read_bytes() for p in saved.iterdir()}
    with pytest.raises(SessionError, match=r"exists already; expected a new name; .*--force"):
        save(full(), saved)
    assert {p.name: p.read_bytes() for p in saved.iterdir()} == before
    save(full(), saved, force=True)
    assert load(saved).device.forward == "+x"


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), OSError(28, "No space left on device")])
@pytest.mark.parametrize("at_file", ["imu.parquet", "reference.parquet"])
def test_a_save_that_breaks_off_leaves_the_old_session(saved, fault, at_file, monkeypatch):
    before = {p.name: p.read_bytes() for p in saved.iterdir()}
    write = write_table

    def broken(columns, path):
        if path.name == at_file:
            path.write_bytes(b"PAR1")
            raise fault
        write(columns, path)

    monkeypatch.setattr(session_folder, "write_table", broken)
    expected = KeyboardInterrupt if isinstance(fault, KeyboardInterrupt) else SessionError
    with pytest.raises(expected) as e:
        save(full(), saved, force=True)
    if expected is SessionError:
        assert "No space left on device" in str(e.value) and "nothing was changed" in str(e.value)
    assert {p.name: p.read_bytes() for p in saved.iterdir()} == before
    assert [p.name for p in saved.parent.iterdir()] == ["s"]


# --- bad folders and files --------------------------------------------------------------------------------------------


def refused(path, *parts: str, row: int | None = None, **options) -> SmartnavError:
    with pytest.raises(SmartnavError) as e:
        load(path, **options)
    text = str(e.value)
    for part in parts:
        assert part in text, text
    assert getattr(e.value, "row", None) == row
    assert text.count("; expected ") == 1
    return e.value


def test_no_folder(tmp_path):
    refused(tmp_path / "none", "none: is no folder", "make one with `smartnav import`")
    (tmp_path / "file").write_text("")
    refused(tmp_path / "file", "is no folder")


def test_no_session_toml(tmp_path):
    refused(tmp_path, "holds no session.toml", "expected a session folder")


@pytest.mark.parametrize("content", [b"device = [", b"\xff\xfe", b"a = 1\na = 2"])
def test_session_toml_that_is_no_toml(saved, content):
    (saved / "session.toml").write_bytes(content)
    refused(saved, "session.toml: is no TOML (", "expected a session.toml")


def test_a_missing_table(tmp_path):
    with pytest.raises(SessionError, match=r"imu\.parquet: is missing; expected a Parquet file; check the path"):
        read_table(tmp_path / "imu.parquet")


@pytest.mark.parametrize("content", [b"", b"no parquet", b"PAR1 cut off"])
def test_an_unreadable_table(saved, content):
    (saved / "imu.parquet").write_bytes(content)
    refused(saved, "imu.parquet: cannot be read (", "expected a Parquet file; import the log again")


def test_a_table_cut_short(saved):
    whole = (saved / "imu.parquet").read_bytes()
    (saved / "imu.parquet").write_bytes(whole[: len(whole) // 2])
    refused(saved, "imu.parquet: cannot be read (")


def rewrite(path, **columns):
    table = {name: np.array(column) for name, column in read_table(path).items()}
    table = {k: v for k, v in {**table, **columns}.items() if v is not None}
    write_table(table, path)
    return table


def test_an_empty_table(saved):
    pq.write_table(pq.read_table(saved / "gnss.parquet").slice(0, 0), saved / "gnss.parquet")
    refused(saved, "gnss.parquet: has no rows; expected at least one row; delete the file if there was no such sensor")


def test_a_wrong_column(saved):
    rewrite(saved / "imu.parquet", gyro_x_rad_s=None, gyro_x_deg_s=np.zeros(6))
    refused(saved, "imu.parquet: column gyro_x_rad_s is missing", "the file has t_ns", "rename or add the column")


def test_a_column_of_text(saved):
    rewrite(saved / "imu.parquet", gyro_x_rad_s=np.array(list("abcdef"), dtype=object))
    refused(saved, "imu.parquet: a column holds no numbers", "expected numbers")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_value_that_is_no_number(saved, bad):
    values = read_table(saved / "imu.parquet")["accel_x_m_s2"].copy()
    values[4] = bad
    rewrite(saved / "imu.parquet", accel_x_m_s2=values)
    refused(saved, f"imu.parquet: accel_x_m_s2 is {bad} at row 4", "expected finite numbers", "--repair nan", row=4)
    repaired = load(saved, repairs=["nan"])
    assert len(repaired.imu) == 5 and repaired.dropped == {"imu": {"non-finite rows dropped": 1}}
    assert repaired.repairs == ("nan",)


@pytest.mark.parametrize(
    ("order", "row", "message", "counts"),
    [
        ([0, 1, 2, 2, 3, 4], 3, "step 0 ns", {"repeated stamps dropped": 1}),
        ([0, 2, 1, 3, 4, 5], 2, "step -10000001 ns", {"disordered rows sorted": 1}),
    ],
)
def test_duplicated_and_disordered_rows(saved, order, row, message, counts):
    table = read_table(saved / "imu.parquet")
    write_table({k: v[order] for k, v in table.items()}, saved / "imu.parquet")
    refused(
        saved,
        f"imu.parquet: t_ns not strictly increasing at row {row} ({message}",
        "expected > 0",
        "--repair order",
        row=row,
    )
    assert load(saved, repairs=["order"]).dropped == {"imu": counts}


def test_repairs_that_the_session_asks_for_itself(saved):
    table = read_table(saved / "imu.parquet")
    write_table({k: v[[0, 2, 1, 3, 4, 5]] for k, v in table.items()}, saved / "imu.parquet")
    text = (saved / "session.toml").read_text()
    (saved / "session.toml").write_text('repair = ["order"]\n' + text)
    assert load(saved).dropped == {"imu": {"disordered rows sorted": 1}}
    (saved / "session.toml").write_text('repair = ["magic"]\n' + text)
    with pytest.raises(ConfigError, match="unknown repair magic"):
        load(saved)


@pytest.mark.parametrize("low", [0.0, -2.5])
def test_a_sigma_that_is_not_positive(saved, low):
    rewrite(saved / "gnss.parquet", sigma_n_m=np.array([1, 1, low, 1, 1, 1.0]))
    refused(
        saved,
        f"gnss.parquet: sigma is {low} at row 2",
        "expected standard deviations > 0",
        "leave unknown values",
        row=2,
    )


def test_both_geodetic_and_local(saved):
    rewrite(saved / "gnss.parquet", e_m=np.zeros(6), n_m=np.zeros(6), u_m=np.zeros(6))
    refused(saved, "gnss.parquet: both geodetic and local position columns", "either lat_deg, lon_deg, height_m or e_m")


def test_geodetic_without_origin(saved):
    text = (saved / "session.toml").read_text()
    (saved / "session.toml").write_text(text[: text.index("[origin]")])
    refused(
        saved,
        "gnss.parquet: lat_deg, lon_deg, height_m in a session without origin",
        "expected [origin] in session.toml, or local e_m, n_m, u_m; give lat_deg, lon_deg and height_m of the origin",
    )


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("colour = 1", ("unknown key colour", "one of schema, device, clock")),
        ("schema = 99", ("schema = 99; expected 1", "import the log again")),
        ("gravity_m_s2 = 1.0", ("gravity_m_s2 = 1.0; expected 9.0 to 10.5 m/s^2; give SI units",)),
        ("gravity_m_s2 = -9.81", ("gravity_m_s2 = -9.81",)),
        ('[clock]\nepoch = "tai"', ("epoch = 'tai'", "one of unix, gps, boot, unknown")),
        ('[device]\nforward = "up"', ("axis 'up'; expected one of +x, -x, +y, -y, +z, -z",)),
        ('[device]\nforward = "+z"\nup = "-z"', ("forward '+z' and up '-z'; expected two different axes",)),
        ('[device]\nvehicle = "ship"', ("vehicle = 'ship'; expected one of none, car, trolley, foot",)),
        ('[device]\ncolour = "red"', ("colour", "one of name, forward, up")),
        ("[origin]\nlat_deg = 95.0\nlon_deg = 0.0\nheight_m = 0.0", ("lat_deg 95.0", "latitude in [-90, 90]")),
        ("[origin]\nlat_deg = 5.0", ("lon_deg", "is missing")),
        ("[sensors.gnss]\nlever = [0.0, 0.0, 0.0]", ("lever", "one of body_t, body_R, frame")),
    ],
)
def test_bad_keys_and_values_of_session_toml(text, parts, tmp_path):
    (tmp_path / "session.toml").write_text(text)
    error = refused(tmp_path, *parts)
    assert "session.toml" in str(error) or "epoch" in str(error)


def test_a_calibration_that_is_named_but_missing(tmp_path):
    (tmp_path / "session.toml").write_text('calibration = "calibration.toml"')
    refused(tmp_path, "calibration.toml: cannot be read (No such file or directory)")

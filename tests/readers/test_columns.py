"""Files by a description of their columns, kept descriptions, and what is seen in a file of no known format."""

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.cli import main
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.columns import parse_columns, profiles_file, read_columns, save_profile
from smartnav_graph.readers.join import join
from smartnav_graph.readers.unknown import describe_unknown

SPEC = "time=t_ms:ms, ax=a one:g, ay=a two:g, az=-a three:g, gx=r1:deg/s, gy=r2:deg/s, gz=r3:deg/s"


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))


def log(path, rows=200, heading="t_ms,a one,a two,a three,r1,r2,r3,p"):
    """At rest, lying on its face in a unit of its own: -1 g where up is, 100 Hz."""
    lines = [f"{1_748_779_200_000 + 10 * i},0.01,0.02,-1.0,{0.5 + i % 3},0.1,-90,101325" for i in range(rows)]
    path.write_text("\n".join([heading, *lines, ""]))
    return str(path)


def test_units_and_signs(tmp_path):
    session = read_columns([log(tmp_path / "a.csv")], parse_columns(f"{SPEC}, pressure=p:pa, device=box, up=+z"))
    assert session.clock_epoch == "unix" and session.device.name == "box" and session.device.up == "+z"
    assert session.imu.t_ns[:2].tolist() == [1_748_779_200_000_000_000, 1_748_779_200_010_000_000]
    np.testing.assert_allclose(session.imu.accel[0], [0.0980665, 0.196133, 9.80665])
    np.testing.assert_allclose(session.imu.gyro[0], np.radians([0.5, 0.1, -90.0]))
    assert session.barometer.pressure_hpa[0] == pytest.approx(1013.25)


def test_columns_by_number(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("\n".join(f"{i / 100} 0 0 9.81 0 0 0.1" for i in range(100)))
    spec = "time=#1, ax=#2, ay=#3, az=#4, gx=#5, gy=#6, gz=#7"
    session = read_columns([str(path)], parse_columns(spec))
    assert session.imu.t_ns[1] == NS // 100 and session.imu.accel[0].tolist() == [0.0, 0.0, 9.81]


def test_several_files_share_one_description(tmp_path):
    force, rate, fixes = (tmp_path / name for name in ("acc.csv", "gyr.csv", "gps.csv"))
    force.write_text("\n".join(["t,x,y,z", *(f"{i / 100},0,0,9.81" for i in range(500))]))
    rate.write_text("\n".join(["t,p,q,r", *(f"{i / 100 + 0.005},0,0,{i}" for i in range(500))]))
    fixes.write_text("\n".join(["gps time,latitude,longitude,kmh", *(f"{i},52.5,11.{i + 1},36" for i in range(5))]))
    spec = "time=t:s, time=gps time:s, ax=x, ay=y, az=z, gx=p, gy=q, gz=r, lat=latitude, lon=longitude"
    session = join(list(map(str, (force, rate, fixes))), columns=parse_columns(spec)).session
    assert len(session.imu) == 499 and len(session.gnss) == 5  # the last rate lies behind the last force
    assert session.imu.gyro[7, 2] == 7.0 and session.imu.accel[7, 2] == pytest.approx(9.81)


def test_described_and_known_files_together(tmp_path):
    points = tmp_path / "points.csv"
    points.write_text("id,time,lat,lon,h\nA,2025-06-01T12:00:01Z,52.5,11.5,10\n")
    session = join([log(tmp_path / "a.csv"), str(points)], columns=parse_columns(SPEC)).session
    assert session.control.t_ns[0] - session.imu.t_ns[0] == NS


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("ax=a", "no time"),
        ("time=t, ax", "'ax'; expected QUANTITY=COLUMN"),
        ("time=t, foo=b", "'foo=b'"),
        ("time=t, epoch=utc", "epoch=utc; expected one of unix"),
        ("nothing", "no profile 'nothing'"),
    ],
)
def test_faulty_descriptions(text, found):
    with pytest.raises(ConfigError) as caught:
        parse_columns(text)
    assert found in str(caught.value)


@pytest.mark.parametrize(
    ("spec", "found"),
    [
        (
            SPEC.replace("r3", "r4"),
            "has no column 'r4' for gz; expected a heading of the file; the headings are a",
        ),
        (SPEC.replace(", gx=r1:deg/s, gy=r2:deg/s, gz=r3:deg/s", ""), "has a accelerometer alone"),
        (SPEC.replace("t_ms", "time"), "has no column of times"),
    ],
)
def test_faulty_files(tmp_path, spec, found):
    with pytest.raises(SessionError) as caught:
        read_columns([log(tmp_path / "a.csv")], parse_columns(spec))
    assert found in str(caught.value)


def test_a_unit_of_the_heading_that_is_not_known(tmp_path):
    source = log(tmp_path / "a.csv", heading="t_ms,a one (furlong),a two,a three,r1,r2,r3,p")
    spec = SPEC.replace("a one:g", "a one (furlong)")
    with pytest.raises(SessionError, match=r"a one \(furlong\) is in 'furlong'; expected one of m/s2"):
        read_columns([source], parse_columns(spec))


def test_a_description_is_kept_and_used_again(tmp_path, capsys):
    source, out = log(tmp_path / "a.csv"), str(tmp_path / "S")
    assert main(["import", source, "--out", out, "--columns", SPEC, "--save-columns", "mine", "--quiet"]) == 0
    assert f"columns: {profiles_file()}" in capsys.readouterr().out
    assert main(["import", source, "--out", out, "--force", "--columns", "mine", "--quiet"]) == 0
    assert parse_columns("mine") == parse_columns(SPEC)
    save_profile("other", "time=t, ax=b")
    assert parse_columns("mine") == parse_columns(SPEC)
    with pytest.raises(ConfigError, match=r"no profile 'yours' in .*; expected one of mine, other"):
        parse_columns("yours")


def test_what_is_seen_can_be_used(tmp_path):
    """The description that the error proposes imports the file."""
    head = "stamp;acc x;acc y;acc z;gyro_x (deg/s);gyro_y (deg/s);gyro_z (deg/s);mx;my;mz;lat;lon"
    rows = [f"{20 * i};0.02;0.01;0.99;0.5;0.1;{i % 7};20.5;1.2;-43.1;52.5{i};11.5{i}" for i in range(200)]
    (tmp_path / "log.csv").write_text("\n".join([head, *rows]))
    with pytest.raises(SessionError) as caught:
        readers.read(tmp_path / "log.csv")
    text = str(caught.value)
    for part in ("semicolon separated text with 12 columns", "stamp may be the time in ms: 50 Hz", "size 0.9", "in g"):
        assert part in text
    assert "smartnav formats --columns" in text
    proposed = text.split('--columns "')[1].split('"')[0]
    session = read_columns([str(tmp_path / "log.csv")], parse_columns(proposed))
    assert session.imu.accel[0, 2] == pytest.approx(0.99 * 9.80665)
    np.testing.assert_allclose(session.imu.gyro[1], np.radians([0.5, 0.1, 1.0]))
    np.testing.assert_allclose(session.magnetometer.field_ut[0], [20.5, 1.2, -43.1])
    assert len(session.gnss) == 200


@pytest.mark.parametrize(
    ("content", "seen"),
    [
        (b"", "an empty file"),
        (b"SQLite format 3\0...", "an SQLite database"),
        (b"\x00\x01\x02\x03" * 10, "a binary file"),
        (b"a,b\n1,2\n", "without a table of at least three rows"),
        (b'{"a": 1}', "JSON"),
        (b"time,ax,ay,az\n0,0,0,.1\n1,0,0,.2\n2,0,0,.1\n", "without gravity"),
        (b"timestamp,a,b\n3,1,1\n2,1,1\n1,1,1\n", "no column that grows like a time"),
    ],
)
def test_what_is_seen(tmp_path, content, seen):
    (tmp_path / "log.dat").write_bytes(content)
    assert seen in describe_unknown(tmp_path / "log.dat").one_line()


def test_rows_amid_other_text(tmp_path):
    path = tmp_path / "x.txt"
    path.write_text("logger v3\nrate  25\nstart\n" + "".join(f"1,{i * 20},{i % 3},5\n" for i in range(20)))
    seen = describe_unknown(path).one_line()
    assert "rows of 4 cells without headings, among lines of other text" in seen and "#2 may be the time in ms" in seen


def test_folders(tmp_path):
    assert describe_unknown(tmp_path).seen == ("an empty folder",)
    (tmp_path / "a.dat").write_bytes(b"ULog\x01")
    assert describe_unknown(tmp_path).seen == ("a folder of 1 files: a.dat (a PX4 ulog)",)

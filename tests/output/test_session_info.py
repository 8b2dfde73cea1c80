"""What `info` shows of a session, as text and as JSON, and of a file before import."""

import json
from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.cli import main
from smartnav_graph.core.timebase import gps_from_utc
from smartnav_graph.output.session_info import SessionInfo
from smartnav_graph.session.health import inspect
from smartnav_graph.session.streams import Images


@pytest.fixture(scope="module")
def session():
    return sn.simulate("figure-eight-60s", 1)


def info(session):
    return SessionInfo(session, inspect(session))


def test_when_and_where(session):
    text = info(session).to_text()
    for part in (
        "time: 2025-06-01T10:00:00.000Z to 2025-06-01T10:00:59.990Z, 60.0 s",
        "clock: unix, time zero 1748772000000000000 ns",
        "place: 52.0",
        "imu        6000    0.000",
        "gaps: 0",
        "missing: nothing",
    ):
        assert part in text, text
    assert len(text.splitlines()) < 25  # one screen


def test_gps_time_has_dates_and_an_unknown_clock_none(session):
    imu = replace(session.imu, t_ns=gps_from_utc(session.imu.t_ns))
    alone = session.replace(imu=imu, gnss=None, static=None, reference=None, clock_epoch="gps")
    assert info(alone).to_dict()["start"] == "2025-06-01T10:00:00.000Z"
    text = info(alone.replace(clock_epoch="unknown")).to_text()
    assert "time: 60.0 s, without dates" in text and "place: not known: no positions" in text


def test_figures(session):
    found = info(session).to_dict()
    json.dumps(found)
    assert found["duration_s"] == pytest.approx(59.99) and found["streams"][0]["rows"] == 6000
    truth = np.linalg.norm(np.diff(session.nav_position(session.gnss)[:, :2], axis=0), axis=1).sum()
    assert found["place"]["path_m"] == pytest.approx(truth, rel=0.01)
    assert abs(found["place"]["lat_deg"] - 52.0) < 0.01


def test_pictures_are_counted(session, tmp_path):
    (tmp_path / "a.png").touch()
    files = np.array(["a.png", "b.png", "c.png"], dtype=object)
    camera = np.array(["cam"] * 3, dtype=object)
    images = Images(t_ns=session.imu.t_ns[:3], image_id=np.arange(3), file=files, camera=camera)
    found = info(session.replace(images=images, pictures=tmp_path))
    assert "pictures: 1 of 3" in found.to_text() and found.to_dict()["pictures"] == {"listed": 3, "there": 1}


def test_many_gaps_stay_on_one_screen(session):
    rows = np.ones(len(session.imu), dtype=bool)
    for i in range(1, 30):
        rows[200 * i : 200 * i + 20 + i] = False
    text = info(session.replace(imu=session.imu.take(rows))).to_text()
    assert "gaps: 29, " in text and "  and 24 shorter ones" in text and len(text.splitlines()) < 30


def test_the_command(session, tmp_path, capsys):
    sn.save(session, tmp_path / "S")
    assert main(["info", str(tmp_path / "S"), "--json", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out)["start"] == "2025-06-01T10:00:00.000Z"
    (tmp_path / "a.csv").write_text("\n".join(["t,ax,ay,az", *(f"{i / 50},0,0,9.81" for i in range(100))]))
    assert main(["info", str(tmp_path / "a.csv")]) == 1
    out = capsys.readouterr().out
    assert "of no known format" in out and "t may be the time in s: 50 Hz" in out and "smartnav import" in out
    assert main(["info", str(tmp_path / "a.csv"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["columns"].startswith("time=t:s, ax=ax:m/s2")
    (tmp_path / "b.csv").write_text("time,lat,lon\n1748772000,52.0,11.0\n1748772001,52.00001,11.0\n")
    assert main(["info", str(tmp_path / "b.csv"), "--quiet"]) == 0
    assert "gnss" in capsys.readouterr().out

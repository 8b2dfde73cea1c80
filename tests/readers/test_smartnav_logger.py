"""The SmartNav logger of 2012: a made up folder with exact values, and sessions that are written and read back."""

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph import readers
from smartnav_graph.cli import main
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.output.export.smartnav_logger import write_smartnav
from smartnav_graph.readers.smartnav_logger import fit_sensor_clock
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.streams import Images, Matches
from smartnav_graph.simulation.scenarios import PHONE_CAMERA

START_MS, BOOT_NS = 1_336_816_800_000, 50_000_000_000_000  # 2012-05-12 10:00 UTC


def write(folder, **changes):
    """Two seconds of a phone lying flat: the sensors' clock is 50 000 s since the start of the phone."""
    stamps = [BOOT_NS + 10_000_000 * i for i in range(200)]
    files = {
        "IMU.txt": [f"{t} 0.001 -0.002 0.003 0.1 0.2 9.8" for t in stamps],
        "Sync.txt": [f"{START_MS + 10 * i} {stamps[i]}" for i in range(0, 200, 50)],
        "Compass.txt": [f"{t + 3_000_000} 20.5 1.25 -43.0" for t in stamps[::10]],
        # received 300 ms late, but for the last one
        "GPS.txt": [f"{START_MS + 1000 * i + 300} {START_MS + 1000 * i} 52.5 11.{i}1 60.5 15.1" for i in range(2)],
        "Camera.txt": [f"{n} {START_MS + 400 * n}" for n in range(1, 4)],
    }
    folder.mkdir()
    for name, lines in {**files, **changes}.items():
        if lines:
            (folder / name).write_text("\n".join(lines) + "\n")
    for n in range(1, 3):
        (folder / f"Image_{n}_{START_MS + 400 * n}.jpg").touch()
    (folder / f"ImageUndistorted_1_{START_MS + 400}.jpg").touch()
    return folder


def test_every_file(tmp_path):
    session = readers.read(write(tmp_path / "log"))
    assert session.clock_epoch == "unix" and session.device.up == "+z"
    assert session.imu.t_ns[[0, 100]].tolist() == [START_MS * 10**6, (START_MS + 1000) * 10**6]
    np.testing.assert_allclose(session.imu.gyro[0], [0.001, -0.002, 0.003])
    np.testing.assert_allclose(session.imu.accel[0], [0.1, 0.2, 9.8])
    assert session.magnetometer.t_ns[0] == START_MS * 10**6 + 3_000_000
    np.testing.assert_allclose(session.magnetometer.field_ut[0], [20.5, 1.25, -43.0])
    assert session.gnss.t_ns.tolist() == [(START_MS + 300) * 10**6, (START_MS + 1300) * 10**6]
    np.testing.assert_allclose(session.gnss.lla[1], [52.5, 11.11, 60.5])
    assert session.gnss.sigma[0, 0] == pytest.approx(10.0, rel=1e-3)  # radius of 68 %
    assert session.images.image_id.tolist() == [1, 2, 3]
    assert session.images.file.tolist() == [f"Image_{n}_{START_MS + 400 * n}.jpg" for n in (1, 2, 3)]
    assert session.dropped["images"] == {"undistorted copies of pictures left out": 1}
    assert "pictures: 2 of 3" in _info(session)


def _info(session):
    from smartnav_graph.output.session_info import SessionInfo
    from smartnav_graph.session.health import inspect

    return SessionInfo(session, inspect(session)).to_text()


def test_pictures_give_their_times_without_a_camera_file(tmp_path):
    session = readers.read(write(tmp_path / "log", **{"Camera.txt": []}))
    assert session.images.t_ns.tolist() == [(START_MS + 400 * n) * 10**6 for n in (1, 2)]


def test_headings_and_semicolons(tmp_path):
    lines = ["Time;GX;GY;GZ;AX;AY;AZ", *(f"{BOOT_NS + 10_000_000 * i};0;0;0;0;0;9.8" for i in range(200))]
    session = readers.read(write(tmp_path / "log", **{"IMU.txt": lines}))
    assert len(session.imu) == 200 and session.imu.accel[0, 2] == 9.8


def test_the_line_through_the_pairs():
    """20 ppm of drift over ten minutes, readings rounded to ms, three of them a second late: within .1 ms."""
    rng = np.random.default_rng(0)
    sensor = BOOT_NS + np.arange(600, dtype=np.int64) * NS
    true = START_MS * 10**6 + np.rint((sensor - BOOT_NS) * (1.0 + 20e-6)).astype(np.int64)
    read = (true + rng.integers(0, 200_000, 600) + 500_000) // 10**6 * 10**6
    read[[50, 200, 400]] += NS
    clock = fit_sensor_clock(read, sensor)
    assert clock.left_out == 3 and clock.rate == pytest.approx(20e-6, abs=0.3e-6)
    assert np.abs(clock.to_processor(sensor) - true).max() < 300_000  # the delay of writing is .1 ms in the mean


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"Sync.txt": []}, "GPS and IMU have no time in common, and there is no Sync file"),
        ({"GPS.txt": ["1 2 3"]}, "GPS.txt: is no table of 6 columns"),
        ({"IMU.txt": [f"{i} 0 0 0 0 0 9.8" for i in range(0, 10**6, 5000)]}, "timestamp grows by 5000"),
        ({"IMU.txt": [f"{BOOT_NS + 10_000_000 * i} 0 0 x 0 0 9.8" for i in range(20)]}, "gyro_z is 'x' at row 0"),
    ],
)
def test_faults_are_named(tmp_path, changes, text):
    if "timestamp grows" in text:  # 5 us, or 5 s
        changes["IMU.txt"] = [f"{i} 0 0 0 0 0 9.8" for i in range(0, 5 * 10**11, 5 * 10**9)]
        text = "timestamp grows by 5e+09"
    with pytest.raises(SessionError) as caught:
        readers.read(write(tmp_path / "log", **changes))
    assert text in str(caught.value)


def test_a_session_written_and_read_again(tmp_path):
    """Equal within the digits of the format: ms for fixes and images, 1e-8 rad/s, 1e-7 m/s^2."""
    session = sn.simulate("walk-60s", 4)
    left_out = write_smartnav(session, tmp_path / "log")
    assert set(left_out) == {"barometer", "reference", "static"} or set(left_out) == {"barometer", "reference"}
    again = readers.read(tmp_path / "log")
    assert np.abs(again.imu.t_ns - session.imu.t_ns).max() <= 500_000
    np.testing.assert_allclose(again.imu.gyro, session.imu.gyro, atol=1e-8)
    np.testing.assert_allclose(again.imu.accel, session.imu.accel, atol=1e-7)
    np.testing.assert_allclose(again.magnetometer.field_ut, session.magnetometer.field_ut, atol=1e-5)
    assert np.abs(again.gnss.t_ns - session.gnss.t_ns).max() <= 500_000
    apart = session.frame.nav_from_lla(again.gnss.lla) - session.nav_position(session.gnss)
    assert np.abs(apart).max() < 1e-4  # m
    np.testing.assert_allclose(again.gnss.sigma[:, 0], session.gnss.sigma[:, 0], atol=1e-3)
    assert again.device == session.device and again.origin == session.origin
    assert again.calibration == session.calibration and again.sensors == session.sensors


def test_pictures_and_matches_come_back(tmp_path):
    """Pictures become JPEG under the logger's names; matches to a hundredth of a pixel."""
    from PIL import Image

    session = sn.simulate("figure-eight-60s", 1)
    stamps = session.imu.t_ns[[100, 200, 300]]
    (tmp_path / "pictures").mkdir()
    for i in range(3):
        Image.new("L", (64, 48), 40 * i).save(tmp_path / "pictures" / f"{i}.png")
    files = np.array([f"{i}.png" for i in range(3)], dtype=object)
    images = Images(t_ns=stamps, image_id=np.arange(3), file=files, camera=np.full(3, "back", dtype=object))
    rng = np.random.default_rng(0)
    first = np.repeat([0, 1], 20)
    xy0, xy1 = rng.uniform(-0.3, 0.3, (2, 40, 2))
    matches = Matches(
        t_ns=stamps[first], t_1_ns=stamps[first + 1], image_id_0=first, image_id_1=first + 1, xy0_n=xy0, xy1_n=xy1
    )
    calibration = replace(session.calibration or Calibration(), cameras={"back": PHONE_CAMERA})
    session = session.replace(images=images, matches=matches, calibration=calibration, pictures=tmp_path / "pictures")
    beyond = replace(matches, xy0_n=np.where(np.arange(40)[:, None] == 7, 0.9, xy0))
    left_out = write_smartnav(session.replace(matches=beyond), tmp_path / "log")
    assert left_out["matches beyond the edge of the sensor"] == 1
    write_smartnav(session, tmp_path / "log", force=True)
    again = readers.read(tmp_path / "log")
    assert again.images.image_id.tolist() == [0, 1, 2] and set(again.images.camera) == {"back"}
    assert np.abs(again.images.t_ns - stamps).max() <= 500_000
    assert all((tmp_path / "log" / file).is_file() for file in again.images.file)
    assert again.matches.image_id_1.tolist() == (first + 1).tolist()
    for one, other in ((again.matches.xy0_n, xy0), (again.matches.xy1_n, xy1)):
        np.testing.assert_allclose(np.sort(one[:, 0]), np.sort(other[:, 0]), atol=0.01 / PHONE_CAMERA.fx)
    (tmp_path / "log" / "calibration.toml").unlink()
    header = tmp_path / "log" / "smartnav.toml"
    header.write_text("\n".join(line for line in header.read_text().splitlines() if "calibration" not in line))
    assert list(readers.read(tmp_path / "log").dropped["matches"].values()) == [40]


def test_control_points_come_back_with_their_stops(tmp_path):
    session = sn.simulate("trolley-loop", 1)
    write_smartnav(session, tmp_path / "log")
    again = readers.read(tmp_path / "log")
    np.testing.assert_array_equal(again.control.t_ns, session.control.t_ns)
    np.testing.assert_allclose(again.control.lla, session.control.lla, atol=1e-9)
    assert len(again.static) == len(session.control) and (again.static.t_end_ns > again.static.t_ns).all()


def test_the_command(tmp_path, capsys):
    sn.save(sn.simulate("figure-eight-60s", 1), tmp_path / "S")
    out = str(tmp_path / "log")
    assert main(["export", str(tmp_path / "S"), "--format", "smartnav", "--out", out]) == 0
    assert "without static 1, reference" in capsys.readouterr().out
    assert main(["import", out, "--out", str(tmp_path / "S2"), "--quiet"]) == 0
    assert main(["export", str(tmp_path / "S"), "--format", "smartnav", "--out", out]) == 1


def test_local_fixes_without_an_origin_are_refused(tmp_path):
    session = sn.simulate("figure-eight-60s", 1)
    gnss = replace(session.gnss, lla=None, enu=session.nav_position(session.gnss))
    with pytest.raises(SessionError, match="local positions without an origin"):
        write_smartnav(session.replace(origin=None, gnss=gnss), tmp_path / "log")
